"""Encoding of rows as MCAP messages, numbered and timed. Rows of one rate are encoded many at once."""

from __future__ import annotations

import struct
from collections import Counter
from datetime import UTC, datetime
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.cdr import HEAD
from dual_ur10.sim2real.recording.header import METADATA_NAME, to_metadata
from dual_ur10.sim2real.recording.run import Header, RunEvent
from dual_ur10.sim2real.recording.schemas import (
    EVENT,
    EVENT_TOPIC,
    SENT_COLUMNS,
    TOPICS,
    Columns,
    joints_topic,
    schema_of,
    sent_topic,
    state_topic,
)
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

NUMBERS: Final = {topic: number for number, topic in enumerate(TOPICS, 1)}
"""Number of each topic's channel and schema."""


class Messages(NamedTuple):
    """Messages of one channel, all of one size.

    Attributes:
        channel: Number of the channel.
        log_ns: Times since 1970, in order.
        records: Records of the messages, one after the other.
    """

    channel: int
    log_ns: NDArray[np.uint64]
    records: bytes


class Encoder:
    """Encoder of the rows of a run.

    Args:
        header: Header of the run.
        columns: Columns of the states.

    Attributes:
        preamble: First bytes of a file: magic, header, metadata, schemas and channels.
        head: Offset and length of the metadata in it.

    Raises:
        RecordingError: The header holds values that JSON cannot hold, or an illegal time of the start.
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
        values = to_metadata(header)
        start = mcap.MAGIC + mcap.header("dual_ur10")
        described = mcap.metadata(METADATA_NAME, values)
        self.head = len(start), len(described)
        self.preamble = start + described + self.schemas + self.channels

    @property
    def schemas(self) -> bytes:
        """Records that define all messages."""
        return b"".join(mcap.schema(number, *schema_of(topic, self._columns)) for topic, number in NUMBERS.items())

    @property
    def channels(self) -> bytes:
        """Records that define all channels."""
        return b"".join(mcap.channel(number, topic) for topic, number in NUMBERS.items())

    def states(self, arm: int, rows: Array) -> list[Messages]:
        """Encode states, (k, numbers), whose first column is the time of the run."""
        log = self._log(rows[:, 0])
        if not len(log):
            return []
        number = NUMBERS[joints_topic(ARMS[arm])]
        joints = self._joints[arm](self._count(number, len(log)), log, rows[:, self._q], rows[:, self._qd])
        return [Messages(number, log, joints), self._flat(self._states[arm], state_topic(ARMS[arm]), log, rows)]

    def sent(self, arm: int, rows: Array) -> list[Messages]:
        """Encode targets, (k, 10) in `SENT_COLUMNS`, with times of the run."""
        log = self._log(rows[:, 2])
        return [self._flat(self._sent[arm], sent_topic(ARMS[arm]), log, rows)] if len(log) else []

    def single(self, topic: str, time_s: float, data: bytes) -> list[Messages]:
        """Encode one message whose data are encoded."""
        log, number = self._log(np.array([time_s])), NUMBERS[topic]
        record = single_record(number, self._count(number, 1), int(log[0]), data)
        return [Messages(number, log, record)]

    def event(self, event: RunEvent) -> list[Messages]:
        """Encode an event."""
        return self.single(EVENT_TOPIC, event.time_s, EVENT.encode(vars(event)))

    def _flat(self, rows: FlatRows, topic: str, log: NDArray[np.uint64], values: Array) -> Messages:
        number = NUMBERS[topic]
        return Messages(number, log, rows(self._count(number, len(log)), log, values))

    def _count(self, number: int, more: int) -> int:
        first = self.counts[number]
        self.counts[number] += more
        return first

    def _log(self, time_s: Array) -> NDArray[np.uint64]:
        """Return times since 1970, for other programs that read the file."""
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


# Head of a message's record.
_RECORD: Final = [
    ("op", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log", "<u8"),
    ("at", "<u8"),
]
_MESSAGE: Final = 0x05


class FlatRows:
    """Encoder of messages that are rows of float64 and nothing else.

    Args:
        channel: Number of the channel.
        size: Numbers per row.
    """

    def __init__(self, channel: int, size: int) -> None:
        body = [("head", "<u4"), ("row", "<f8", (size,))]
        self._dtype = np.dtype([*_RECORD, *body])
        self._channel = channel

    def __call__(self, sequence: int, log_ns: NDArray[np.uint64], rows: Array) -> bytes:
        """Return the records of rows (k, size), numbered from `sequence` on."""
        records = _records(self._dtype, self._channel, sequence, log_ns)
        records["head"] = int.from_bytes(HEAD, "little")
        records["row"] = rows
        return records.tobytes()


class JointRows:
    """Encoder of the joint states of one arm.

    Args:
        channel: Number of the channel.
        arm: "left" or "right".
    """

    def __init__(self, channel: int, arm: str) -> None:
        # The bytes between the numbers are the same in every message.
        names = bytearray(struct.pack("<I", 1) + b"\0")  # empty frame_id
        names += bytes(-len(names) % 4) + struct.pack("<I", len(JOINTS))
        for joint in JOINTS:
            names += bytes(-len(names) % 4)
            line = f"{arm}/{joint}".encode() + b"\0"
            names += struct.pack("<I", len(line)) + line
        names += bytes(-len(names) % 4) + struct.pack("<I", 6)
        names += bytes(-(8 + len(names)) % 8)  # after the time, which has eight bytes
        self._names = np.frombuffer(bytes(names), np.uint8)
        body = [
            ("head", "<u4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("names", "u1", (len(names),)),
            ("position", "<f8", (6,)),
            ("count", "<u4"),
            ("gap", "<u4"),
            ("velocity", "<f8", (6,)),
            ("effort", "<u4"),
        ]
        self._dtype = np.dtype([*_RECORD, *body])
        self._channel = channel

    def __call__(self, sequence: int, log_ns: NDArray[np.uint64], q_rad: Array, qd_rad_s: Array) -> bytes:
        """Return the records of positions and speeds, (k, 6) each, numbered from `sequence` on."""
        records = _records(self._dtype, self._channel, sequence, log_ns)
        records["head"] = int.from_bytes(HEAD, "little")
        records["sec"], records["nanosec"] = np.divmod(log_ns, 10**9)
        records["names"] = self._names
        records["position"], records["velocity"], records["count"] = q_rad, qd_rad_s, 6
        return records.tobytes()


def single_record(channel: int, sequence: int, log_ns: int, data: bytes) -> bytes:
    """Return the record of one message."""
    return struct.pack("<BQHIQQ", _MESSAGE, 22 + len(data), channel, sequence, log_ns, log_ns) + data


def _records(dtype: np.dtype[np.void], channel: int, sequence: int, log_ns: NDArray[np.uint64]) -> NDArray[np.void]:
    records = np.zeros(len(log_ns), dtype)
    records["op"], records["length"], records["channel"] = _MESSAGE, dtype.itemsize - 9, channel
    records["sequence"] = np.arange(sequence, sequence + len(log_ns))
    records["log"] = records["at"] = log_ns
    return records
