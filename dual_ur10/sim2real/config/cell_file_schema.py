"""What may stand in a cell file: every table and key, what it means, and what is allowed.

This is the one list of them: the reader checks against it, the template takes its comments from it, and
`docs/reference/cell-file.md` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, Literal, get_args

from dual_ur10.kinematics import ur10
from dual_ur10.kinematics.ur10 import ARMS, DH_A_M, DH_ALPHA_RAD, DH_D_M
from dual_ur10.sim2real.config.cell_file_keys import Key, Table
from dual_ur10.sim2real.control.servoj import GAIN_RANGE, LOOKAHEAD_RANGE_S, MEASURED_LOOKAHEAD_S, Family, ServojProfile

Kind = Literal["real", "emulated"]

NAME: Final = "[A-Za-z0-9_-]{1,64}"
"""Names of cells and obstacles: they become parts of messages and of file names."""

MOST_OBSTACLES: Final = 64
ROBOTIQ_PORT: Final = 63352  # Robotiq's URCap
LEAST_SPEED_FACTOR: Final = 0.05
MOST_LATENCY_S: Final = 0.3
_TURN: Final = 2 * math.pi
_ROOM_M: Final = 20.0
_ARM_M: Final = 3.0  # as far from the cell's origin as `ArmMount` lets a base stand


def _pose(what: str, room_m: float, **more: Any) -> tuple[Key, Key]:
    """Keys of a position and a rotation vector. Defaults of zero, unless they are required."""
    default = None if more.get("required") else (0.0, 0.0, 0.0)
    common: dict[str, Any] = {"count": 3, "default": default, "example": (0.0, 0.0, 0.0), **more}
    return (
        Key("position_m", f"position of {what}", low=-room_m, high=room_m, **common),
        Key("rotation_rad", "its orientation, a rotation vector", low=-_TURN, high=_TURN, **common),
    )


def _kinds(meaning: str, kinds: Mapping[str, Any], default: str | None = None) -> Key:
    return Key("kind", meaning, "text", choices=tuple(kinds), required="" if default else "always", default=default)


_GRIPPERS: Final[dict[str, tuple[Key, ...]]] = {
    "none": (),
    "robotiq": (Key("port", "TCP port of Robotiq's URCap", "integer", 1, 65535, default=ROBOTIQ_PORT),),
    "digital_output": (
        Key(
            "output",
            "digital output that drives the gripper",
            "integer",
            0,
            17,
            required="always",
            note="0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool",
            example=0,
        ),
        Key("open_level", "level of the output that opens the gripper", "switch", default=False),
    ),
}

_OBSTACLES: Final[dict[str, tuple[Key, ...]]] = {
    "box": (
        *_pose("the centre", _ROOM_M, required="always")[:1],
        Key("size_m", "length of its edges", count=3, low=0.001, high=_ROOM_M, required="always", example=(1, 1, 1)),
        *_pose("the centre", _ROOM_M)[1:],
    ),
    "capsule": (
        Key("from_m", "one end of its axis", count=3, low=-_ROOM_M, high=_ROOM_M, required="always", example=(0, 0, 0)),
        Key("to_m", "the other end", count=3, low=-_ROOM_M, high=_ROOM_M, required="always", example=(0, 0, 1)),
        Key("radius_m", "its radius", low=0.001, high=_ROOM_M / 2, required="always", example=0.1),
    ),
    "plane": (
        Key("point_m", "a point of it", count=3, low=-_ROOM_M, high=_ROOM_M, required="always", example=(1, 0, 0)),
        Key(
            "normal",
            "direction in which the arms are",
            count=3,
            low=-1.001,
            high=1.001,
            required="always",
            note="of length 1",
            example=(-1, 0, 0),
        ),
    ),
}

_TRACKERS: Final[dict[str, tuple[Key, ...]]] = {
    "attached": (
        Key("arm", "whose gripper holds the object", "text", choices=ARMS, default=ARMS[0]),
        *_pose("the object in the frame of that flange", 1.0),
    ),
    "given": _pose("the object in the cell frame", _ARM_M, required="always"),
    "emulated": (
        Key("noise_m", "standard deviation of measured positions", low=0, high=0.1, default=0.0),
        Key("noise_rad", "standard deviation of measured orientations", low=0, high=0.5, default=0.0),
        Key("delay_s", "age of a measured pose", low=0, high=0.499, default=0.0),
    ),
}

_SERVOJ: Final = ServojProfile()

ARM_TABLES: Final = (
    Table(
        "gripper",
        "What is on the flange.",
        (_kinds("how the gripper is driven", _GRIPPERS, "none"),),
        variants=_GRIPPERS,
    ),
    Table(
        "servoj",
        "How servoj is called.",
        (
            Key(
                "lookahead_s",
                "lookahead time",
                low=LOOKAHEAD_RANGE_S[0],
                high=LOOKAHEAD_RANGE_S[1],
                default=_SERVOJ.lookahead_s,
            ),
            Key("gain", "gain, in 1/s²", low=GAIN_RANGE[0], high=GAIN_RANGE[1], default=_SERVOJ.gain),
        ),
    ),
    Table(
        "measured",
        "What `fit` has found of this arm in a recorded run; where a key is missing, nothing was measured.",
        (
            Key(
                "lookahead_s",
                "lookahead with which the law of servoj moves as the arm does",
                low=MEASURED_LOOKAHEAD_S[0],
                high=MEASURED_LOOKAHEAD_S[1],
                example=0.03,
            ),
            Key(
                "latency_s",
                "time from the sending of a target until it acts",
                low=0,
                high=MOST_LATENCY_S,
                example=0.004,
            ),
        ),
    ),
    Table(
        "limits",
        "What no target of this arm may exceed; where a key is missing, the hard limit holds.",
        (
            Key(
                "speed_rad_s",
                "joint speed",
                low=0.01,
                high=float(ur10.HARD_SPEED_RAD_S.min()),
                note="the hard limit of joints 1 and 2; that of the others is "
                f"{ur10.HARD_SPEED_RAD_S.max():g} and holds if the key is missing",
                example=0.5,
            ),
            Key(
                "acceleration_rad_s2",
                "joint acceleration",
                low=0.1,
                high=ur10.HARD_ACCELERATION_RAD_S2,
                note="the hard limit",
                example=4.0,
            ),
            Key(
                "jerk_rad_s3",
                "joint jerk",
                low=1.0,
                high=ur10.HARD_JERK_RAD_S3,
                note="the hard limit",
                example=200.0,
            ),
            Key(
                "tcp_speed_m_s",
                "speed of flange, elbow and tool centre point",
                low=0.01,
                high=ur10.HARD_TCP_SPEED_M_S,
                note="the hard limit",
                example=0.25,
            ),
        ),
    ),
    Table(
        "calibration",
        "Kinematics as the controller's calibration has them; the nominal UR10 where a key is missing.",
        (
            Key("a_m", "DH link lengths", count=6, low=-2, high=2, default=tuple(DH_A_M.tolist())),
            Key(
                "d_m",
                "DH link offsets",
                count=6,
                low=-1000,  # those of parallel joints shift freely against each other
                high=1000,
                default=tuple(DH_D_M.tolist()),
            ),
            Key("alpha_rad", "DH link twists", count=6, low=-_TURN, high=_TURN, default=tuple(DH_ALPHA_RAD.tolist())),
            Key("theta_rad", "DH joint offsets", count=6, low=-_TURN, high=_TURN, default=(0.0,) * 6),
            Key(
                "checksum",
                "the controller's checksum of each joint, to refuse another calibration",
                "integer",
                0,
                2**32 - 1,
                count=6,
                example=(0, 0, 0, 0, 0, 0),
            ),
        ),
    ),
)

ARM_KEYS: Final = (
    Key(
        "host",
        "address of the controller",
        "text",
        pattern=("", "an IPv4 address; names are not looked up"),
        required="always",
        example="192.168.1.10",
    ),
    Key("family", "controller", "text", choices=get_args(Family), required="real", default="cb3"),
    Key(
        "base_position_m",
        "position of the base in the cell frame",
        count=3,
        low=-_ARM_M,
        high=_ARM_M,
        required="real",
        example=(-0.75, 0.6, 0.0),
    ),
    Key(
        "base_yaw_rad",
        "turn of the base about the vertical; 0 looks along +x",
        low=-_TURN,
        high=_TURN,
        required="real",
        default=0.0,
    ),
    Key("base_uncertainty_m", "how far the base may stand from there", low=0, high=0.1, default=0.0),
    Key("base_uncertainty_rad", "by how much it may be turned from there", low=0, high=0.2, default=0.0),
    Key(
        "tcp_position_m",
        "tool centre point in the flange frame, as set on the controller",
        count=3,
        low=-1,
        high=1,
        required="real",
        example=(0.0, 0.0, 0.0),
    ),
    Key(
        "tcp_rotation_rad",
        "its orientation, a rotation vector",
        count=3,
        low=-_TURN,
        high=_TURN,
        required="real",
        example=(0.0, 0.0, 0.0),
    ),
    Key(
        "payload_kg",
        "payload, as set on the controller",
        low=0,
        high=ur10.PAYLOAD_KG,
        required="real",
        example=0.0,
    ),
    Key(
        "payload_cog_m",
        "its centre of gravity in the flange frame",
        count=3,
        low=-1,
        high=1,
        required="real",
        example=(0.0, 0.0, 0.0),
    ),
    Key(
        "serial_number",
        "of the robot, to refuse another",
        "text",
        pattern=("[A-Za-z0-9-]{1,32}", "up to 32 letters, digits and hyphens, in quotes"),
        example="2010300001",
    ),
    Key(
        "safety_checksum",
        "of the safety settings, to refuse others",
        "integer",
        0,
        2**32 - 1,
        note="the number that `doctor` shows, not what the pendant shows",
        example=0x57F4285B,
    ),
)

CELL: Final = Table(
    "",
    "The cell.",
    (
        Key("kind", "whether arms are real or emulated", "text", choices=get_args(Kind), required="always"),
        Key(
            "name",
            "what the cell is called",
            "text",
            pattern=(NAME, "up to 64 letters, digits, _ and -, in quotes"),
            default="cell",
        ),
        Key(
            "task",
            "id of the environment that it is set up for",
            "text",
            pattern=("", "the id of an environment"),
            example="DualUR10/SineTracking-v0",
        ),
        Key(
            "speed_factor",
            "how fast the clock of a task runs",
            low=LEAST_SPEED_FACTOR,
            high=1,
            required="real",
            default=1.0,
            example=0.25,
        ),
        Key(
            "commissioned",
            "whether the checklist of a real cell was signed; until then, its arms are as slow as in first runs",
            "switch",
            default=False,
        ),
        Key(
            "allow_reduced_mode",
            "whether both arms go on, at half their speed, where a controller is in reduced mode",
            "switch",
            default=False,
        ),
        Key("rt_priority", "real-time priority of the senders; 0 is off", "integer", 0, 90, default=0),
    ),
    tables=(
        *(Table(arm, f"The {arm} arm.", ARM_KEYS, tables=ARM_TABLES, required=True) for arm in ARMS),
        Table(
            "emulator",
            "The process that emulates the cell; it writes this table.",
            (
                Key("port", "of its fault injection", "integer", 1, 65535, required="always", example=40000),
                Key(
                    "task",
                    "whose scene it simulates",
                    "text",
                    pattern=("", "the id of an environment"),
                    example="DualUR10/SineTracking-v0",
                ),
                Key("pid", "its process id", "integer", 1, 2**31 - 1, example=1234),
            ),
            optional=True,
        ),
        Table(
            "tracker",
            "Where the poses of objects come from.",
            (_kinds("which", _TRACKERS),),
            variants=_TRACKERS,
            optional=True,
        ),
        Table(
            "obstacle",
            "What stands in the workspace, in the cell frame.",
            (
                Key(
                    "name",
                    "what it is called",
                    "text",
                    pattern=(NAME, "up to 64 letters, digits, _ and -, in quotes"),
                    required="always",
                    example="wall",
                ),
                _kinds("its shape", _OBSTACLES),
            ),
            variants=_OBSTACLES,
            optional=True,
            many=True,
        ),
    ),
)


def rows(table: Table = CELL, path: str = "") -> list[tuple[str, Key]]:
    """Every key of the file with its path; `ARM` stands for either arm, a variant's name in brackets for its kind."""
    found = [(f"{path}{key.name}", key) for key in table.keys]
    for kind, keys in table.variants.items():
        found += [(f"{path}{key.name} ({kind})", key) for key in keys]
    for inner in table.tables:
        if inner.name == ARMS[1]:
            continue
        name = "ARM" if inner.name in ARMS else inner.name
        found += rows(inner, f"{path}{name}.")
    return found
