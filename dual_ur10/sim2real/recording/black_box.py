"""Black box: the last seconds of a run, written at a stop."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.schemas import BEGIN, EPISODE_TOPIC, STATE_COLUMNS, STEP, STEP_TOPIC, Columns
from dual_ur10.sim2real.recording.writer import RunWriter
from ur_core.types import Array

KEPT_S: Final = 10.0
_MOST_BOXES: Final = 1000
_LEAST_FREE: Final = 32 * 2**20


@dataclass(frozen=True)
class _KeptEntry:
    """An entry that can be written later.

    Attributes:
        time_s: Time of the entry.
        write: Pass the entry to a writer.
        topic: Topic of a single message.
        data: Data of a single message.
    """

    time_s: float
    write: Callable[[RunWriter], None]
    topic: str = ""
    data: bytes = b""


class BlackBox:
    """Buffer of the last `KEPT_S` seconds of a run, to be written on demand.

    Args:
        folder: Existing folder of the files.
        header: Header of the run.
        columns: Columns of the states.
    """

    def __init__(self, folder: Path, header: Header, *, columns: Columns = STATE_COLUMNS) -> None:
        self.folder = folder
        self._header = replace(header, extra={**header.extra, "black_box": True})
        self._columns = columns
        self._kept: deque[_KeptEntry] = deque()
        self._begin: bytes = b""  # of the episode whose first steps were dropped

    def states(self, arm: int, rows: Array) -> None:
        """Keep the arguments of `RunWriter.states`."""
        if len(rows):
            self._kept.append(_KeptEntry(float(rows[-1, 0]), lambda writer: writer.states(arm, rows)))

    def sent(self, arm: int, rows: Array) -> None:
        """Keep the arguments of `RunWriter.sent`."""
        if len(rows):
            self._kept.append(_KeptEntry(float(rows[-1, 2]), lambda writer: writer.sent(arm, rows)))

    def single(self, topic: str, time_s: float, data: bytes) -> None:
        """Keep the arguments of `RunWriter.single`."""
        self._kept.append(_KeptEntry(time_s, lambda writer: writer.single(topic, time_s, data), topic, data))

    def forget(self, now_s: float) -> None:
        """Drop entries older than `KEPT_S`."""
        while self._kept and self._kept[0].time_s < now_s - KEPT_S:
            old = self._kept.popleft()
            if old.topic == EPISODE_TOPIC:
                self._begin = old.data
            elif old.topic == STEP_TOPIC and self._begin:
                self._begin = _after(self._begin, old.data)

    def write(self, now_s: float, reason: str) -> Path:
        """Write all kept entries to `blackbox-<n>.mcap`, with the first free number.

        Raises:
            RecordingError: It cannot be written.
        """
        with self._new() as writer:
            if self._begin:
                writer.single(EPISODE_TOPIC, self._kept[0].time_s if self._kept else now_s, self._begin)
            for each in self._kept:
                each.write(writer)
            writer.event(RunEvent(now_s, "stop", reason))
        return writer.path

    def _new(self) -> RunWriter:
        for number in range(1, _MOST_BOXES + 1):
            name = f"blackbox-{number}.mcap"
            if not os.path.lexists(self.folder / name):
                return RunWriter(
                    self.folder, self._header, name=name, columns=self._columns, least_free_bytes=_LEAST_FREE
                )
        raise RecordingError(f"there are {_MOST_BOXES} black boxes in {self.folder}: move them away")


def _after(begin: bytes, step: bytes) -> bytes:
    """Return the beginning of an episode that starts after one of its steps."""
    head, done = BEGIN.decode(begin), STEP.decode(step)
    head |= {name: done[name] for name in ("q_rad", "flange_m", "observation")}
    head["first_step"], head["initial_state"] = done["step"] + 1, b""
    return BEGIN.encode(head)
