"""What is expected of an arm, and what was found of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from dual_ur10.errors import LinkError, SettingsError, UnknownNameError
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.sim2real.config.cell_file_entries import ArmEntry
from dual_ur10.sim2real.control.servoj import Family
from dual_ur10.sim2real.links.link_socket import checked_host

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        arm: "left", "right", or "cell" for both.
        name: What it is.
        level: "ok"; "warn", which a person is to look at; "fail", with which nothing may start.
        found: What was found.
        expected: What should have been.
        remedy: What to do about it; empty if it is in order.
    """

    arm: str
    name: str
    level: Level
    found: str
    expected: str = ""
    remedy: str = ""

    @property
    def message(self) -> str:
        """All of it in a line."""
        expected = f", expected: {self.expected}" if self.expected else ""
        return f"{self.arm}, {self.name}: {self.found}{expected}" + (f"; {self.remedy}" if self.remedy else "")


def judged(
    arm: str, name: str, good: bool, found: str, expected: str, remedy: str, *, otherwise: Level = "fail"
) -> Finding:
    """A finding that is in order, or else has a remedy."""
    return Finding(arm, name, "ok", found, expected) if good else Finding(arm, name, otherwise, found, expected, remedy)


def failed(arm: str, name: str, error: LinkError) -> Finding:
    """A finding about a link that failed. Messages of links end with their remedy."""
    found, _, remedy = str(error).rpartition("; ")
    return Finding(arm, name, "fail", found or remedy, "an answer", remedy)


def any_fails(findings: Iterable[Finding]) -> bool:
    """Whether nothing may start."""
    return any(each.level == "fail" for each in findings)


@dataclass(frozen=True, kw_only=True)
class ExpectedArm:
    """What an arm should be. What is None is told, and compared with nothing.

    Attributes:
        host: IPv4 address of its controller.
        family: "cb3" or "e-series".
        dh: Its kinematics, as calibrated.
        checksums: (6,) of the calibration.
        safety_checksum: Of the safety settings.
        tcp: (6,) tool centre point from the flange: x, y, z in m, rotation vector in rad.
        payload_kg: Mass at the flange.
        payload_cog_m: (3,) its centre of mass from the flange.
        serial_number: Of the robot, as its dashboard says it.

    Raises:
        SettingsError: The address or a length is not legal.
        UnknownNameError: There is no such family.
    """

    host: str
    family: Family = "cb3"
    dh: DHParameters | None = None
    checksums: tuple[int, ...] | None = None
    safety_checksum: int | None = None
    tcp: tuple[float, ...] | None = None
    payload_kg: float | None = None
    payload_cog_m: tuple[float, ...] | None = None
    serial_number: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "host", checked_host(self.host))
        if self.family not in get_args(Family):
            raise UnknownNameError("controller family", str(self.family), get_args(Family))
        for name, value, count in (
            ("checksums", self.checksums, 6),
            ("tcp", self.tcp, 6),
            ("payload_cog_m", self.payload_cog_m, 3),
        ):
            if value is not None and len(value) != count:
                raise SettingsError(f"expected {name} is {value!r}: it has {count} numbers")


def expected_of(arm: ArmEntry) -> ExpectedArm:
    """What a cell file says of an arm."""
    return ExpectedArm(
        host=arm.host,
        family=arm.family,
        dh=arm.mount.dh,
        checksums=arm.checksum,
        safety_checksum=arm.safety_checksum,
        tcp=arm.tcp,
        payload_kg=arm.payload_kg,
        payload_cog_m=arm.payload_cog_m,
        serial_number=arm.serial_number,
    )
