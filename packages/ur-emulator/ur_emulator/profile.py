"""Profile of an emulated controller: version, control rate, and assumptions about undocumented behaviour."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import TICK_S
from ur_core.protocol.primary_messages import ControllerIdentity


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """Behaviour of a controller that no public document specifies.

    Each is a switch, so that code can be tested both ways, and corrected after a measurement on a real controller or
    URSim. `docs/reference/emulator.md` lists them with the test that would settle each.

    Attributes:
        unlock_wait_s: Time after a protective stop for which the dashboard refuses to unlock it.
        primary_unlock_waits: Whether the primary interface refuses it for as long, too.
        protective_stop_pauses: Whether a protective stop pauses the program, or else stops it.
        emergency_stop_pauses: The same for emergency stops.
        safeguard_resumes: Whether a program resumes by itself when a safeguard stop is released.
        output_registers_persist: Whether output registers keep their values when a program ends.
        watchdog_counts_unchanged: Whether writing an unchanged value feeds a program's RTDE watchdog.
        power_on_s: Time from "power on" to idle.
        brake_release_s: Time from "brake release" to running.
        restart_safety_s: Time from "restart safety" to power off.
        stopping_s: Duration of a stop on the path from full speed.
        program_stop_rad_s2: Deceleration of the joints when a program ends while the arm moves.
        servoj_jump_factor: A servoj target is a sudden change if it is farther from the arm than this many times the
            distance at the joint's greatest speed in lookahead time and `t`.
        starved_ticks: Control periods without a motion command after which an arm that still moves stops protectively,
            while its program goes on.
        infinite_loop_steps: Statements that a program may run in one control period before they count as an infinite
            loop. A solution of the inverse kinematics counts for 50.
        deviation_rad: Deviation of a joint from its path that causes a protective stop
        deviation_ticks: after so many control periods.
    """

    unlock_wait_s: float = 5.0
    primary_unlock_waits: bool = False
    protective_stop_pauses: bool = True
    emergency_stop_pauses: bool = False
    safeguard_resumes: bool = True
    output_registers_persist: bool = True
    watchdog_counts_unchanged: bool = True
    power_on_s: float = 0.8
    brake_release_s: float = 0.4
    restart_safety_s: float = 1.0
    stopping_s: float = 0.15
    program_stop_rad_s2: float = 8.0
    servoj_jump_factor: float = 1.5
    starved_ticks: int = 3
    infinite_loop_steps: int = 5_000
    deviation_rad: float = 0.1
    deviation_ticks: int = 3


@dataclass(frozen=True, kw_only=True)
class ControllerProfile(ControllerIdentity):
    """One version of a UR controller, and the model of its arm.

    Attributes:
        serial_number: Digits.
        model: Model name, as the dashboard reports it.
        assumptions: Behaviour that no document specifies.
    """

    serial_number: str
    model: str = "UR10"
    assumptions: Assumptions = field(default_factory=Assumptions)

    @property
    def tick_s(self) -> float:
        """Control period, s."""
        return TICK_S[self.family]

    @property
    def has_remote_control(self) -> bool:
        """True if the version has a remote control mode: since PolyScope 5.6, never on a CB3."""
        return self.at_least((5, 6))

    def at_least(self, e_series: tuple[int, ...], cb3: tuple[int, ...] | None = None) -> bool:
        """Return True from version `e_series` (5.x) on, or on a CB3 from version `cb3` (3.x) on; None: never there."""
        if self.version[0] < 5:
            return cb3 is not None and self.version >= cb3
        return self.version >= e_series


PROFILES: Final = {
    "cb3": ControllerProfile(
        family="cb3", version=(3, 15, 8, 106339), released="Nov 30 2021", serial_number="2010300001"
    ),
    "e-series": ControllerProfile(
        family="e-series",
        version=(5, 12, 5, 1101),
        released="Nov 20 2023",
        serial_number="2021500001",
        model="UR10e",
    ),
}
"""Tested profiles, by family."""

POLYSCOPES: Final = {
    "3.15": PROFILES["cb3"],
    "5.12": PROFILES["e-series"],
    **{
        f"{version[0]}.{version[1]}": replace(PROFILES["e-series"], version=version, released="unknown")
        for version in ((5, 21, 0, 0), (5, 22, 0, 0), (5, 23, 0, 0), (5, 25, 1, 0), (5, 26, 0, 0))
    },
}
"""Profiles by PolyScope version. Build number and date of releases after 5.12 are unknown here, and reported so: 0 and
"unknown". 5.21 has `optimovej`, 5.23 and 5.25.1 the first and second `direct_torque`, and from 5.26 on `ur_rtde` 1.6.5
uses it."""


def profile_for(robot: str, polyscope: str | None = None) -> ControllerProfile:
    """Return the profile of the controller of a model.

    Args:
        robot: Name of the model.
        polyscope: PolyScope version, a key of `POLYSCOPES`; None: that of `PROFILES`.

    Raises:
        UnknownNameError: There is no such model or version.
        SettingsError: The version is that of another family.
    """
    facts = robot_model(robot)
    profile = PROFILES[facts.family] if polyscope is None else profile_of_version(polyscope)
    if profile.family != facts.family:
        known = ", ".join(name for name, each in POLYSCOPES.items() if each.family == facts.family)
        raise SettingsError(
            f"PolyScope {polyscope} does not run on a {facts.title}, whose family is {facts.family}: use {known}"
        )
    return replace(profile, model=facts.title, robot_type=facts.robot_type)


def profile_of_version(polyscope: str) -> ControllerProfile:
    """Return the profile of a PolyScope version.

    Raises:
        UnknownNameError: There is no such version.
    """
    if polyscope not in POLYSCOPES:
        raise UnknownNameError("PolyScope version", polyscope, tuple(POLYSCOPES))
    return POLYSCOPES[polyscope]


def profile_of(family: str) -> ControllerProfile:
    """Return the profile of a controller family.

    Raises:
        UnknownNameError: There is no such family.
    """
    if family not in PROFILES:
        raise UnknownNameError("controller family", family, tuple(PROFILES))
    return PROFILES[family]
