"""What is on which channel of a record, and the messages that go at the rate of the control periods, many at once.

Joint states are `sensor_msgs/msg/JointState`, so that viewers know them; all else are flat messages of our own, whose
definitions are in the file.
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.kinematics.ur10 import ARMS, JOINTS
from dual_ur10.sim2real.links.arm_status import ROW
from dual_ur10.sim2real.recording.cdr import HEAD, Field, Schema
from dual_ur10.types import Array

Columns = tuple[tuple[str, int], ...]

STATE_COLUMNS: Final[Columns] = ROW
"""Columns of a state as a controller tells it: names, and how many numbers each is."""

SIMULATED_COLUMNS: Final[Columns] = (
    ("arrival_s", 1),
    ("timestamp_s", 1),
    ("q_rad", 6),
    ("qd_rad_s", 6),
    ("target_q_rad", 6),
    ("tcp_pose", 6),
)
"""Columns of a state that the simulation knows."""

SENT_COLUMNS: Final[Columns] = (("period", 1), ("index", 1), ("sent_s", 1), ("late_s", 1), ("target_rad", 6))

_JOINT_STATE: Final = "sensor_msgs/msg/JointState"

JOINT_STATE_TEXT: Final = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
"""ROS 2's sensor_msgs, std_msgs and builtin_interfaces."""


def _schema(name: str, *fields: str) -> Schema:
    pairs = (field.split() for field in fields)
    return Schema(f"dual_ur10_msgs/msg/{name}", tuple(Field(each, kind) for kind, each in pairs))


def flat_schema(name: str, columns: Columns) -> Schema:
    """The message of rows with these columns."""
    return Schema(
        f"dual_ur10_msgs/msg/{name}",
        tuple(Field(each, "float64" if size == 1 else f"float64[{size}]") for each, size in columns),
    )


BEGIN: Final = _schema(
    "EpisodeBegin",
    "float64 begin_s",
    "int64 number",
    "int64 first_step",
    "float64[12] q_rad",
    "float64[6] flange_m",
    "float64[] observation",
    "uint8[] initial_state",
    "string seed",
)
"""An empty observation or state: there is none. An empty seed: none was given."""

STEP: Final = _schema(
    "Step",
    "float64 time_s",
    "int64 episode",
    "int64 step",
    "float64 reward",
    "float64[12] q_rad",
    "float64[6] flange_m",
    "bool gated",
    "bool terminated",
    "bool truncated",
    "int8 success",
    "string ended_by",
    "float64[] action",
    "float64[] targets_rad",
    "float64[] gripper_m",
    "float64[] observation",
    "int64 first_target",
)
"""`time_s` is the task's; success -1: not known; first_target -1: the action missed its deadline."""

EVENT: Final = _schema("Event", "float64 time_s", "string kind", "string text", "string arm")

EPISODE_TOPIC, STEP_TOPIC, EVENT_TOPIC = "/episode", "/step", "/event"
SINGLE: Final = {EPISODE_TOPIC: BEGIN, STEP_TOPIC: STEP, EVENT_TOPIC: EVENT}
"""Channels whose messages come one by one."""


def joints_topic(arm: str) -> str:
    """Where an arm's joint states are."""
    return f"/{arm}/joint_states"


def state_topic(arm: str) -> str:
    """Where all of an arm's state is."""
    return f"/{arm}/state"


def sent_topic(arm: str) -> str:
    """Where the targets are that were sent to an arm."""
    return f"/{arm}/target"


TOPICS: Final = (
    *(make(arm) for arm in ARMS for make in (joints_topic, state_topic, sent_topic)),
    *SINGLE,
)
"""All channels, in the order of their numbers, from 1 on."""


def columns_of(text: str, known: Columns, what: str) -> Columns:
    """The columns that a flat message's definition names.

    Raises:
        RecordingError: It is no definition of some of the known columns, in any order and each once.
    """
    sizes = dict(known)
    found: list[tuple[str, int]] = []
    for line in text.splitlines():
        kind, _, name = line.partition(" ")
        if name not in sizes or kind != ("float64" if sizes[name] == 1 else f"float64[{sizes[name]}]"):
            raise RecordingError(f"{what}: {line[:80]!r} is no field of it")
        if any(name == each for each, _ in found):
            raise RecordingError(f"{what}: the field {name} comes twice")
        found.append((name, sizes[name]))
    if not found or found[0][0] != known[0][0]:
        raise RecordingError(f"{what}: its first field must be {known[0][0]}")
    return tuple(found)


# A message's record, before its data: opcode, length, channel, sequence, time of the log and of the message.
_RECORD: Final = [
    ("op", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log", "<u8"),
    ("at", "<u8"),
]
_MESSAGE: Final = 0x05
RECORD_SIZE: Final = 31


class FlatRows:
    """Records of messages that are rows of float64 and nothing else.

    Args:
        channel: Its number.
        size: Numbers of a row.
    """

    def __init__(self, channel: int, size: int) -> None:
        body = [("head", "<u4"), ("row", "<f8", (size,))]
        self._dtype = np.dtype([*_RECORD, *body])
        self._channel = channel

    def __call__(self, sequence: int, log_ns: NDArray[np.uint64], rows: Array) -> bytes:
        """The records of rows (k, size), numbered from `sequence` on."""
        records = _records(self._dtype, self._channel, sequence, log_ns)
        records["head"] = int.from_bytes(HEAD, "little")
        records["row"] = rows
        return records.tobytes()


class JointRows:
    """Records of joint states of one arm.

    Args:
        channel: Its number.
        arm: "left" or "right".
    """

    def __init__(self, channel: int, arm: str) -> None:
        # Names do not change: what stands between the numbers is the same in every message.
        names = bytearray(struct.pack("<I", 1) + b"\0")  # no frame
        names += bytes(-len(names) % 4) + struct.pack("<I", len(JOINTS))
        for joint in JOINTS:
            names += bytes(-len(names) % 4)
            line = f"{arm}/{joint}".encode() + b"\0"
            names += struct.pack("<I", len(line)) + line
        names += bytes(-len(names) % 4) + struct.pack("<I", 6)
        names += bytes(-(8 + len(names)) % 8)  # behind the time, which is of eight bytes
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
        """The records of positions and speeds, (k, 6) each, numbered from `sequence` on."""
        records = _records(self._dtype, self._channel, sequence, log_ns)
        records["head"] = int.from_bytes(HEAD, "little")
        records["sec"], records["nanosec"] = np.divmod(log_ns, 10**9)
        records["names"] = self._names
        records["position"], records["velocity"], records["count"] = q_rad, qd_rad_s, 6
        return records.tobytes()


def single_record(channel: int, sequence: int, log_ns: int, data: bytes) -> bytes:
    """The record of one message."""
    return struct.pack("<BQHIQQ", _MESSAGE, 22 + len(data), channel, sequence, log_ns, log_ns) + data


def _records(dtype: np.dtype[np.void], channel: int, sequence: int, log_ns: NDArray[np.uint64]) -> NDArray[np.void]:
    records = np.zeros(len(log_ns), dtype)
    records["op"], records["length"], records["channel"] = _MESSAGE, dtype.itemsize - 9, channel
    records["sequence"] = np.arange(sequence, sequence + len(log_ns))
    records["log"] = records["at"] = log_ns
    return records


def schema_of(topic: str, columns: Columns) -> tuple[str, str]:
    """Name and text of the definition of a channel's messages; `columns` are those of the states."""
    if topic in SINGLE:
        return SINGLE[topic].name, SINGLE[topic].text
    if topic.endswith("/joint_states"):
        return _JOINT_STATE, JOINT_STATE_TEXT
    schema = flat_schema("ArmState", columns) if topic.endswith("/state") else flat_schema("ArmTarget", SENT_COLUMNS)
    return schema.name, schema.text
