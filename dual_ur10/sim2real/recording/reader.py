"""Reader of records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.cdr import HEAD
from dual_ur10.sim2real.recording.episodes import read_episodes
from dual_ur10.sim2real.recording.header import METADATA_NAME, from_metadata
from dual_ur10.sim2real.recording.run import ArmLog, Run, RunEvent
from dual_ur10.sim2real.recording.run_folder import RUN_FILE
from dual_ur10.sim2real.recording.scan import MOST_BYTES, Scanned, scan
from dual_ur10.sim2real.recording.schemas import (
    EPISODE_TOPIC,
    EVENT,
    EVENT_TOPIC,
    SENT_COLUMNS,
    SINGLE,
    STATE_COLUMNS,
    STEP_TOPIC,
    Columns,
    columns_of,
    flat_schema,
    sent_topic,
    state_topic,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

_WANTED: Final = frozenset({*SINGLE, *map(state_topic, ARMS), *map(sent_topic, ARMS)})
_MOST_NAMED: Final = 5
_MUST_BE_FINITE: Final = ("arrival_s", "timestamp_s", "q_rad", "qd_rad_s", "target_q_rad")


def read_run(path: str | Path, *, allow_partial: bool = False, most_bytes: int = MOST_BYTES) -> Run:
    """Read a record.

    Args:
        path: The file, or the folder of the run.
        allow_partial: Also read what a kill or a fault left: a file without its end as far as it goes, and states that
            a controller reported as NaN.
        most_bytes: Largest size of the file.

    Raises:
        RecordingError: There is none, or it is cut off, damaged or hostile. The message names the row and the reason.
    """
    path = file_of(path)
    found = scan(path, wanted=_WANTED, most_bytes=most_bytes)
    try:
        if not found.complete and not allow_partial:
            raise RecordingError(f"{found.reason}. What is whole of it can be read: --allow-partial")
        return _run(found, allow_partial)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def file_of(path: str | Path) -> Path:
    """Return the file of a record, given the file or the folder of its run.

    Raises:
        RecordingError: It is a link, or a folder without a run of its own.
    """
    path = Path(path)
    if path.is_symlink():
        raise RecordingError(f"cannot read {path}: links are not followed. Name what it points to: {path.resolve()}")
    if not path.is_dir() or (path / RUN_FILE).exists() or (path / RUN_FILE).is_symlink():
        return path / RUN_FILE if path.is_dir() else path
    runs = sorted((each.parent for each in path.glob(f"*/{RUN_FILE}")), reverse=True)  # their names begin with a time
    if not runs:
        raise RecordingError(f"cannot read {path}: there is no {RUN_FILE} in it. Name the folder of a run")
    more = f", and {len(runs) - _MOST_NAMED} more" if len(runs) > _MOST_NAMED else ""
    raise RecordingError(
        f"cannot read {path}: it is a folder of runs, without a {RUN_FILE} of its own. Name one of them: "
        f"{', '.join(map(str, runs[:_MOST_NAMED]))}{more}"
    )


def _run(found: Scanned, allow_partial: bool) -> Run:
    if METADATA_NAME not in found.metadata:
        raise RecordingError(
            found.reason if found.reason else "it holds no run of this package: its metadata name none"
        )
    header = from_metadata(found.metadata[METADATA_NAME])
    for topic in _WANTED - found.schemas.keys():
        raise RecordingError(found.reason or f"it has no channel {topic}")
    for topic, schema in SINGLE.items():
        if found.schemas[topic] != (schema.name, schema.text):
            raise RecordingError(f"{topic} is defined otherwise than this version does")
    left, right = (_arm(found, arm, finite=not allow_partial) for arm in ARMS)
    black_box = bool(header.extra.get("black_box"))
    episodes = read_episodes(
        found.messages[EPISODE_TOPIC],
        found.messages[STEP_TOPIC],
        header.period_ticks,
        from_within=black_box,
    )
    if header.seed is None and episodes and not black_box:
        header = replace(header, seed=episodes[0].seed)  # a file's header is written before its first reset
    events = [_event(row, data) for row, data in enumerate(found.messages[EVENT_TOPIC])]
    return Run(header, (left, right), episodes, events, found.complete)


def _arm(found: Scanned, arm: str, *, finite: bool) -> ArmLog:
    topic = state_topic(arm)
    columns = columns_of(found.schemas[topic][1], STATE_COLUMNS, topic)
    missing = [name for name in ("q_rad", "qd_rad_s") if name not in dict(columns)]
    if missing:
        raise RecordingError(f"{topic} has no {missing[0]}")
    state = _table(found.messages[topic], columns, topic)
    times = ("arrival_s",)
    _check_finite(state, _MUST_BE_FINITE if finite else times, topic)
    _check_sorted(state["arrival_s"], topic, "arrival_s")
    topic = sent_topic(arm)
    if found.schemas[topic][1] != flat_schema("ArmTarget", SENT_COLUMNS).text:
        raise RecordingError(f"{topic} is defined otherwise than this version does")
    sent = _table(found.messages[topic], SENT_COLUMNS, topic)
    _check_finite(sent, sent, topic)
    _check_sorted(sent["sent_s"], topic, "sent_s")
    return ArmLog(state, sent)


def _table(messages: list[bytes], columns: Columns, topic: str) -> dict[str, Array]:
    size = sum(size for _, size in columns)
    whole = len(HEAD) + 8 * size
    for row, data in enumerate(messages):
        if len(data) != whole or data[:4] != HEAD:
            raise RecordingError(f"{topic}, row {row}: a message of {len(data)} bytes is not one of {whole}")
    table = np.frombuffer(b"".join(messages), np.dtype([("head", "V4"), ("row", "<f8", (size,))]))["row"]
    found, at = {}, 0
    for name, count in columns:
        found[name] = table[:, at].copy() if count == 1 else table[:, at : at + count].copy()
        at += count
    return found


def _check_finite(table: Mapping[str, Array], names: Any, topic: str) -> None:
    for name in names:
        if name not in table or not len(table[name]):
            continue
        bad = ~np.isfinite(table[name].reshape(len(table[name]), -1)).all(axis=1)
        if bad.any():
            row = int(bad.argmax())
            raise RecordingError(f"{topic}, row {row}: {name} is {table[name][row]}, which is not finite")


def _check_sorted(times: Array, topic: str, name: str) -> None:
    back = np.diff(times) < 0
    if back.any():
        row = int(back.argmax()) + 1
        raise RecordingError(f"{topic}, row {row}: {name} goes back from {times[row - 1]:.6f} to {times[row]:.6f}")


def _event(row: int, data: bytes) -> RunEvent:
    event = RunEvent(**EVENT.decode(data))
    if not np.isfinite(event.time_s) or event.arm not in ("", *ARMS):
        raise RecordingError(f"{EVENT_TOPIC}, row {row}: time {event.time_s} or arm {event.arm!r:.40} is not legal")
    return event
