"""Which controller is emulated: its version, its rate, and what no document settles of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.control.servoj import TICK_S, Family


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """Behaviour of a controller that no public document settles.

    Each is a switch, so that what depends on it can be tried both ways, and set right once a real controller or URSim
    has been asked. `docs/reference/emulator.md` lists them with the test that would settle each.

    Attributes:
        unlock_wait_s: For how long after a protective stop the dashboard refuses to unlock it.
        protective_stop_pauses: Whether a protective stop pauses the program; else it stops it.
        emergency_stop_pauses: The same of emergency stops.
        safeguard_resumes: Whether a program goes on by itself when a safeguard stop is released.
        output_registers_persist: Whether output registers keep their values when a program ends.
        watchdog_counts_unchanged: Whether writing an unchanged value feeds a program's RTDE watchdog.
        power_on_s: From "power on" to idle.
        brake_release_s: From "brake release" to running.
        restart_safety_s: From "restart safety" to power off.
        stopping_s: How long an emulated brake takes from full speed, in all stops that hold the path.
        program_stop_rad_s2: Deceleration of the joints when a program ends while the arm moves.
        servoj_jump_factor: A servoj target is a sudden change if it is farther from where the arm is than this many
            times the way at the joint's greatest speed in lookahead time and `t`.
        starved_ticks: Control periods without a motion command after which an arm that still moves is protectively
            stopped, while its program goes on.
        infinite_loop_steps: Statements that a program may run in one control period before they count as an infinite
            loop. A solution of the inverse kinematics counts for 50.
        deviation_rad: How far a joint may be from where it should be,
        deviation_ticks: and for how many control periods, before a protective stop.
    """

    unlock_wait_s: float = 5.0
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
class ControllerProfile:
    """One version of a UR controller with a UR10.

    Attributes:
        family: "cb3" or "e-series".
        version: Major, minor, bugfix and build.
        released: Date of the software, as the dashboard says it.
        serial_number: Digits.
        model: As the dashboard says it.
        robot_type: As the primary interface says it; 2 is the UR10.
        safety_checksum: Of its safety settings, as the primary interface says it; 0 to 2**32 - 1.
        assumptions: What no document settles.
    """

    family: Family
    version: tuple[int, int, int, int]
    released: str
    serial_number: str
    model: str = "UR10"
    robot_type: int = 2
    safety_checksum: int = 0x57F4285B
    assumptions: Assumptions = field(default_factory=Assumptions)

    @property
    def tick_s(self) -> float:
        """Control period, s."""
        return TICK_S[self.family]

    @property
    def has_remote_control(self) -> bool:
        """Whether there is a remote control mode: since PolyScope 5.6, never on a CB3."""
        return self.at_least((5, 6))

    def at_least(self, e_series: tuple[int, int], cb3: tuple[int, int] | None = None) -> bool:
        """Whether the version has what came with `e_series` (5.x) and, if it came there at all, with `cb3` (3.x)."""
        mine = self.version[:2]
        if mine[0] < 5:
            return cb3 is not None and mine >= cb3
        return mine >= e_series


PROFILES: Final = {
    "cb3": ControllerProfile(
        family="cb3", version=(3, 15, 8, 106339), released="Nov 30 2021", serial_number="2010300001"
    ),
    "e-series": ControllerProfile(
        family="e-series", version=(5, 12, 5, 1101), released="Nov 20 2023", serial_number="2021500001"
    ),
}
"""The profiles that are tested, by family."""


def profile_of(family: str) -> ControllerProfile:
    """The profile of a controller family.

    Raises:
        UnknownNameError: There is no such family.
    """
    if family not in PROFILES:
        raise UnknownNameError("controller family", family, tuple(PROFILES))
    return PROFILES[family]
