"""Channels of a record and the definitions of their messages.

Joint states are `sensor_msgs/msg/JointState`, which viewers know. All other messages are flat and of this package;
their definitions are in the file.
"""

from __future__ import annotations

from typing import Final

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.cdr import CdrField, Schema
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import ROW

Columns = tuple[tuple[str, int], ...]

STATE_COLUMNS: Final[Columns] = ROW
"""Columns of a state as a controller reports it: names and lengths."""

SIMULATED_COLUMNS: Final[Columns] = (
    ("arrival_s", 1),
    ("timestamp_s", 1),
    ("q_rad", 6),
    ("qd_rad_s", 6),
    ("target_q_rad", 6),
    ("tcp_pose", 6),
)
"""Columns of a simulated state."""

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
    return Schema(f"dual_ur10_msgs/msg/{name}", tuple(CdrField(each, kind) for kind, each in pairs))


def flat_schema(name: str, columns: Columns) -> Schema:
    """Return the definition of messages that are rows with these columns."""
    return Schema(
        f"dual_ur10_msgs/msg/{name}",
        tuple(CdrField(each, "float64" if size == 1 else f"float64[{size}]") for each, size in columns),
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
"""Beginning of an episode. An observation, state or seed that was not given is empty."""

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
    "bool left_by_person",
    "bool right_by_person",
)
"""Step of an episode: `time_s` on the task's clock; success -1: not known; first_target -1: missed its deadline."""

EVENT: Final = _schema("Event", "float64 time_s", "string kind", "string text", "string arm")

EPISODE_TOPIC, STEP_TOPIC, EVENT_TOPIC = "/episode", "/step", "/event"
SINGLE: Final = {EPISODE_TOPIC: BEGIN, STEP_TOPIC: STEP, EVENT_TOPIC: EVENT}
"""Channels whose messages are written one by one."""


def joints_topic(arm: str) -> str:
    """Return the topic of an arm's joint states."""
    return f"/{arm}/joint_states"


def state_topic(arm: str) -> str:
    """Return the topic of an arm's whole state."""
    return f"/{arm}/state"


def sent_topic(arm: str) -> str:
    """Return the topic of the targets sent to an arm."""
    return f"/{arm}/target"


TOPICS: Final = (
    *(make(arm) for arm in ARMS for make in (joints_topic, state_topic, sent_topic)),
    *SINGLE,
)
"""All topics in the order of their channel numbers, from 1 on."""


def columns_of(text: str, known: Columns, what: str) -> Columns:
    """Return the columns that the definition of a flat message names.

    Raises:
        RecordingError: It does not name some of the known columns, in any order and each once.
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


def schema_of(topic: str, columns: Columns) -> tuple[str, str]:
    """Return name and text of the definition of a topic's messages; `columns` are those of the states."""
    if topic in SINGLE:
        return SINGLE[topic].name, SINGLE[topic].text
    if topic.endswith("/joint_states"):
        return _JOINT_STATE, JOINT_STATE_TEXT
    schema = flat_schema("ArmState", columns) if topic.endswith("/state") else flat_schema("ArmTarget", SENT_COLUMNS)
    return schema.name, schema.text
