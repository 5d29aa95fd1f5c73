"""Rows of a run as messages of its channels, with their numbers and times. It knows of no file."""

from __future__ import annotations

import json
import zlib
from collections import Counter
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.run import Event, Header
from dual_ur10.sim2real.recording.schemas import (
    EVENT,
    EVENT_TOPIC,
    SENT_COLUMNS,
    TOPICS,
    Columns,
    FlatRows,
    JointRows,
    joints_topic,
    schema_of,
    sent_topic,
    single_record,
    state_topic,
)
from dual_ur10.types import Array

FORMAT: Final = "1"
METADATA_NAME: Final = "dual_ur10"
NUMBERS: Final = {topic: number for number, topic in enumerate(TOPICS, 1)}
"""Of channels and of their schemas."""


class Messages(NamedTuple):
    """Messages of one channel, of one size each.

    Attributes:
        channel: Its number.
        log_ns: Their times since 1970, in order.
        records: Theirs, one behind the other.
    """

    channel: int
    log_ns: NDArray[np.uint64]
    records: bytes


class Encoder:
    """Makes messages of rows.

    Args:
        header: Of the run.
        columns: Of the rows of states.

    Attributes:
        preamble: What a file begins with.
        head: Place and length of the metadata in it.

    Raises:
        RecordingError: The header holds what JSON cannot, or says no time when the run began.
    """

    def __init__(self, header: Header, columns: Columns) -> None:
        self._begin_ns = _nanoseconds(header.started_utc)
        self._columns = columns
        offsets = dict(zip((name for name, _ in columns), np.cumsum([0, *(size for _, size in columns)]), strict=False))
        try:
            self._q, self._qd = (slice(int(at), int(at) + 6) for at in (offsets["q_rad"], offsets["qd_rad_s"]))
        except KeyError as error:
            raise RecordingError(f"states without {error} cannot be recorded") from None
        size = sum(size for _, size in columns)
        self._states = [FlatRows(NUMBERS[state_topic(arm)], size) for arm in ARMS]
        self._joints = [JointRows(NUMBERS[joints_topic(arm)], arm) for arm in ARMS]
        self._sent = [FlatRows(NUMBERS[sent_topic(arm)], sum(size for _, size in SENT_COLUMNS)) for arm in ARMS]
        self.counts: Counter[int] = Counter()
        values = _metadata(header)
        start = mcap.MAGIC + mcap.header("dual_ur10")
        described = mcap.metadata(METADATA_NAME, values)
        self.head = len(start), len(described)
        self.preamble = start + described + self.schemas + self.channels

    @property
    def schemas(self) -> bytes:
        """Definitions of all messages."""
        return b"".join(mcap.schema(number, *schema_of(topic, self._columns)) for topic, number in NUMBERS.items())

    @property
    def channels(self) -> bytes:
        """All channels."""
        return b"".join(mcap.channel(number, topic) for topic, number in NUMBERS.items())

    def states(self, arm: int, rows: Array) -> list[Messages]:
        """States, (k, numbers), whose first column is the time of the run."""
        log = self._log(rows[:, 0])
        if not len(log):
            return []
        number = NUMBERS[joints_topic(ARMS[arm])]
        joints = self._joints[arm](self._count(number, len(log)), log, rows[:, self._q], rows[:, self._qd])
        return [Messages(number, log, joints), self._flat(self._states[arm], state_topic(ARMS[arm]), log, rows)]

    def sent(self, arm: int, rows: Array) -> list[Messages]:
        """Targets, (k, 10) as `SENT_COLUMNS` says, with times of the run."""
        log = self._log(rows[:, 2])
        return [self._flat(self._sent[arm], sent_topic(ARMS[arm]), log, rows)] if len(log) else []

    def single(self, topic: str, time_s: float, data: bytes) -> list[Messages]:
        """One message of a channel, as it is."""
        log, number = self._log(np.array([time_s])), NUMBERS[topic]
        record = single_record(number, self._count(number, 1), int(log[0]), data)
        return [Messages(number, log, record)]

    def event(self, event: Event) -> list[Messages]:
        """An event."""
        return self.single(EVENT_TOPIC, event.time_s, EVENT.encode(vars(event)))

    def _flat(self, rows: FlatRows, topic: str, log: NDArray[np.uint64], values: Array) -> Messages:
        number = NUMBERS[topic]
        return Messages(number, log, rows(self._count(number, len(log)), log, values))

    def _count(self, number: int, more: int) -> int:
        first = self.counts[number]
        self.counts[number] += more
        return first

    def _log(self, time_s: Array) -> NDArray[np.uint64]:
        """Times since 1970, for those who read the file with other programs."""
        whole = np.rint(np.nan_to_num(time_s, posinf=0.0, neginf=0.0).clip(-1e6, 1e8) * 1e9).astype(np.int64)
        return (whole + self._begin_ns).astype(np.uint64)


def _nanoseconds(started_utc: str) -> int:
    try:
        moment = datetime.fromisoformat(started_utc)
    except (TypeError, ValueError):
        raise RecordingError(
            f"started_utc is {started_utc!r}: it must be a time such as 2026-01-31T12:00:00Z"
        ) from None
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    return max(0, int(moment.timestamp() * 1e6) * 1000)


def _metadata(header: Header) -> dict[str, str]:
    try:
        line = json.dumps(asdict(header), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"the run cannot be described in JSON: {error}") from error
    return {"format": FORMAT, "header": line, "crc32": str(zlib.crc32(line.encode()))}
