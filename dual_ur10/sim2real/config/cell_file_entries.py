"""What the tables of a cell file stand for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final

from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.sim2real.config.cell_file_schema import ROBOTIQ_PORT
from dual_ur10.sim2real.control.servoj import Family, ServojProfile

Three = tuple[float, float, float]
ZERO: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class NoGripper:
    """Nothing on the flange that opens and closes."""

    kind: ClassVar[str] = "none"


@dataclass(frozen=True, kw_only=True)
class RobotiqSocket:
    """A Robotiq gripper behind the text protocol of its URCap, at `port` of the arm's controller."""

    kind: ClassVar[str] = "robotiq"
    port: int = ROBOTIQ_PORT


@dataclass(frozen=True, kw_only=True)
class DigitalGripper:
    """A gripper that opens when digital output `output` (8 to 15 configurable, 16 and 17 tool) is `open_level`."""

    kind: ClassVar[str] = "digital_output"
    output: int
    open_level: bool = False


@dataclass(frozen=True, kw_only=True)
class ArmLimits:
    """What no target of an arm may exceed, in the units of `MotionLimits`; None: the hard limit."""

    speed_rad_s: float | None = None
    acceleration_rad_s2: float | None = None
    jerk_rad_s3: float | None = None
    tcp_speed_m_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What was measured of an arm that moved; None: nothing was.

    Attributes:
        lookahead_s: Lookahead with which the law of `servoj` moves as the arm does.
        latency_s: Time from the sending of a target until it acts.
    """

    lookahead_s: float | None = None
    latency_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class ArmEntry:
    """One arm and its controller.

    Attributes:
        host: IPv4 address of the controller.
        servoj: Controller family and servoj settings.
        mount: Where the base stands, and its kinematics.
        base_uncertainty_m, base_uncertainty_rad: How far it may stand, or be turned, from there.
        tcp_position_m, tcp_rotation_rad: Tool centre point in the flange frame, as the controller should have it,
            and its rotation vector; None: not said.
        payload_kg, payload_cog_m: Payload as the controller should have it; None: not said.
        serial_number: Of the robot; None: not said.
        safety_checksum: Of the safety settings, as `doctor` shows it; None: not said.
        checksum: The controller's six checksums of its kinematics; None: not said.
        gripper: What is on the flange.
        limits: What its targets may not exceed.
        measured: What was measured of it.
    """

    host: str
    servoj: ServojProfile
    mount: ArmMount
    base_uncertainty_m: float = 0.0
    base_uncertainty_rad: float = 0.0
    tcp_position_m: Three | None = None
    tcp_rotation_rad: Three | None = None
    payload_kg: float | None = None
    payload_cog_m: Three | None = None
    serial_number: str | None = None
    safety_checksum: int | None = None
    checksum: tuple[int, ...] | None = None
    gripper: NoGripper | RobotiqSocket | DigitalGripper = NoGripper()
    limits: ArmLimits = ArmLimits()
    measured: Measured = Measured()

    @property
    def family(self) -> Family:
        """Of the controller."""
        return self.servoj.family

    @property
    def tcp(self) -> tuple[float, ...] | None:
        """(6,) tool centre point as UR's controllers have it: x, y, z in m, rotation vector in rad; None: not said."""
        if self.tcp_position_m is None and self.tcp_rotation_rad is None:
            return None
        return (*(self.tcp_position_m or ZERO), *(self.tcp_rotation_rad or ZERO))

    def mapping(self) -> dict[str, Any]:
        """The table of the file."""
        dh = self.mount.dh
        calibration = {"a_m": dh.a_m, "d_m": dh.d_m, "alpha_rad": dh.alpha_rad, "theta_rad": dh.theta_rad}
        return said(
            {
                "host": self.host,
                "family": self.family,
                "base_position_m": self.mount.position_m,
                "base_yaw_rad": self.mount.yaw_rad,
                **{name: getattr(self, name) for name in PLAIN},
                "gripper": with_kind(self.gripper),
                "servoj": {"lookahead_s": self.servoj.lookahead_s, "gain": self.servoj.gain},
                "measured": plain(self.measured),
                "limits": plain(self.limits),
                "calibration": {**calibration, "checksum": self.checksum},
            }
        )


PLAIN: Final = (
    "base_uncertainty_m",
    "base_uncertainty_rad",
    "tcp_position_m",
    "tcp_rotation_rad",
    "payload_kg",
    "payload_cog_m",
    "serial_number",
    "safety_checksum",
)
"""Attributes of an arm that are keys of its table, as they are."""


@dataclass(frozen=True, kw_only=True)
class AttachedTracker:
    """The object is held by an arm, at this pose in the frame of its flange."""

    kind: ClassVar[str] = "attached"
    arm: str = "left"
    position_m: Three = ZERO
    rotation_rad: Three = ZERO


@dataclass(frozen=True, kw_only=True)
class GivenTracker:
    """The object stands at this pose in the cell frame."""

    kind: ClassVar[str] = "given"
    position_m: Three
    rotation_rad: Three


@dataclass(frozen=True, kw_only=True)
class EmulatedTracker:
    """The emulated cell's camera: standard deviations of its noise, and the age of its poses."""

    kind: ClassVar[str] = "emulated"
    noise_m: float = 0.0
    noise_rad: float = 0.0
    delay_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class EmulatorEntry:
    """The process that emulates the cell: fault-injection port at the left host, task whose scene it simulates, pid."""

    port: int
    task: str | None = None
    pid: int | None = None


Tracker = AttachedTracker | GivenTracker | EmulatedTracker


def _by_kind(*kinds: type[Any]) -> dict[str, type[Any]]:
    return {each.kind: each for each in kinds}


GRIPPERS: Final = _by_kind(NoGripper, RobotiqSocket, DigitalGripper)
OBSTACLES: Final = _by_kind(Box, Capsule, Plane)
TRACKERS: Final = _by_kind(AttachedTracker, GivenTracker, EmulatedTracker)


def of_kind(kinds: Mapping[str, type[Any]], values: Mapping[str, Any]) -> Any:
    """The entry of the class that `kind` names."""
    return kinds[values["kind"]](**{name: value for name, value in values.items() if name != "kind"})


def plain(entry: Any) -> dict[str, Any]:
    """An entry as a table."""
    return said({each.name: getattr(entry, each.name) for each in fields(entry)})


def with_kind(entry: Any) -> dict[str, Any]:
    """An entry as a table that names its kind."""
    return {"kind": entry.kind, **plain(entry)}


def said(values: Mapping[str, Any]) -> dict[str, Any]:
    """Without what is not said: without None and empty tables."""
    kept: dict[str, Any] = {}
    for name, value in values.items():
        inner = said(value) if isinstance(value, Mapping) else value
        if inner is not None and inner != {}:
            kept[name] = inner
    return kept
