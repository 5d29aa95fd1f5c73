"""Power, brakes and safety state of one controller.

A state machine in controller time. It does not control motion: it states what the program has to do (`Demand`).
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from ur_core.errors import OperationRefusedError
from ur_core.protocol.modes import RobotMode, SafetyBits, SafetyMode
from ur_emulator.profile import Assumptions

UNLOCK_TOO_EARLY: Final = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)


class Demand(Enum):
    """Demand of the safety state on the program: go on, pause on the path, or end with the arm held by its brakes."""

    NONE = "none"
    PAUSE = "pause"
    STOP = "stop"


_STOP_BITS: Final = {
    SafetyMode.PROTECTIVE_STOP: SafetyBits.PROTECTIVE_STOPPED,
    SafetyMode.RECOVERY: SafetyBits.RECOVERY,
    SafetyMode.SAFEGUARD_STOP: SafetyBits.SAFEGUARD_STOPPED,
    SafetyMode.SYSTEM_EMERGENCY_STOP: SafetyBits.SYSTEM_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyBits.ROBOT_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED,
    SafetyMode.VIOLATION: SafetyBits.VIOLATION,
    SafetyMode.FAULT: SafetyBits.FAULT,
}

_POWERLESS: Final = (
    SafetyMode.SYSTEM_EMERGENCY_STOP,
    SafetyMode.ROBOT_EMERGENCY_STOP,
    SafetyMode.VIOLATION,
    SafetyMode.FAULT,
)
"""Modes in which a stopped arm has no power."""


class Safety:
    """Safety state of one controller.

    Args:
        assumptions: Behaviour that no document specifies.
        powered: Whether the arm is powered, with its brakes released, from the start.

    Attributes:
        robot_mode: State of power and brakes.
        reason: Code and text of the last stop, or "".
    """

    def __init__(self, assumptions: Assumptions, *, powered: bool = True) -> None:
        self.assumptions = assumptions
        self.robot_mode = RobotMode.RUNNING if powered else RobotMode.POWER_OFF
        self.reason = ""
        self._now_s = 0.0
        self._stopped: dict[int, float] = {}  # active stop modes, and their start times
        self._reduced = False
        self._next: list[tuple[float, RobotMode]] = []  # steps of powering up, and their times
        self._restarting_until: float | None = None
        self._loses_power = False

    @property
    def safety_mode(self) -> int:
        """RTDE's `safety_mode`: the gravest active condition."""
        if self._stopped:
            return max(self._stopped, key=_severity)
        return SafetyMode.REDUCED if self._reduced else SafetyMode.NORMAL

    @property
    def safety_bits(self) -> SafetyBits:
        """RTDE's `safety_status_bits`."""
        if not self._stopped:  # without operations on flags, which are slow
            return SafetyBits.REDUCED if self._reduced else SafetyBits.NORMAL
        bits = SafetyBits(0)
        for mode in self._stopped:
            known = _STOP_BITS.get(SafetyMode(mode)) if mode in _KNOWN else None
            bits |= (known or SafetyBits(0)) | SafetyBits.STOPPED_DUE_TO_SAFETY
        return bits | SafetyBits.REDUCED if self._reduced else bits

    @property
    def reduced(self) -> bool:
        """True while the reduced limits apply."""
        return self._reduced

    @property
    def demand(self) -> Demand:
        """Demand on the program."""
        if not self._stopped and self.robot_mode is RobotMode.RUNNING and not self._loses_power:
            return Demand.NONE
        pauses = {
            SafetyMode.PROTECTIVE_STOP: self.assumptions.protective_stop_pauses,
            SafetyMode.ROBOT_EMERGENCY_STOP: self.assumptions.emergency_stop_pauses,
            SafetyMode.SYSTEM_EMERGENCY_STOP: self.assumptions.emergency_stop_pauses,
            SafetyMode.VIOLATION: False,
            SafetyMode.FAULT: False,
        }
        if not all(pauses.get(SafetyMode(mode), True) for mode in self._stopped if mode in _KNOWN):
            return Demand.STOP
        if self.robot_mode != RobotMode.RUNNING or self._loses_power:
            return Demand.PAUSE if self.assumptions.emergency_stop_pauses else Demand.STOP
        return Demand.PAUSE

    @property
    def resumes(self) -> bool:
        """True if a program that pauses now resumes by itself after the stop."""
        return self.assumptions.safeguard_resumes and self._stopped.keys() <= _SAFEGUARD

    @property
    def may_move(self) -> bool:
        """True if the arm may move."""
        return self.robot_mode == RobotMode.RUNNING and not self._stopped and not self._loses_power

    def tick(self, dt_s: float, *, at_rest: bool) -> None:
        """Advance by `dt_s`. `at_rest`: whether the arm stands."""
        self._now_s += dt_s
        while self._next and self._next[0][0] <= self._now_s:
            self.robot_mode = self._next.pop(0)[1]
        if at_rest and self._loses_power:
            # Even if the button has been released meanwhile.
            self._loses_power = False
            if self.robot_mode > RobotMode.POWER_OFF:
                self.power_off()
        if self._restarting_until is not None and self._now_s >= self._restarting_until:
            self._restarting_until = None
            for mode in (SafetyMode.VIOLATION, SafetyMode.FAULT):
                self._stopped.pop(mode, None)

    # Conditions.

    def stop(self, mode: int, reason: str = "") -> None:
        """Raise a stop condition: any number that RTDE's `safety_mode` may have.

        Raises:
            OperationRefusedError: The number stands for normal operation.
        """
        if mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            raise OperationRefusedError(f"safety mode {int(mode)} is no stop: release the active conditions instead")
        if mode not in self._stopped:
            self._stopped[int(mode)] = self._now_s
            self.reason = reason
            self._loses_power = self._loses_power or mode in _POWERLESS

    def release(self, mode: int) -> None:
        """Clear a condition: an emergency stop button is released, a safeguard closed."""
        self._stopped.pop(int(mode), None)

    def reduce(self, reduced: bool) -> None:
        """Switch the reduced limits."""
        self._reduced = reduced

    # Operator actions.

    def power_on(self) -> None:
        """Switch the arm's power on.

        Raises:
            OperationRefusedError: An active stop forbids power.
        """
        self._check_power()
        if self.robot_mode == RobotMode.POWER_OFF and not self._next:
            self.robot_mode = RobotMode.POWER_ON
            self._next = [(self._now_s + self.assumptions.power_on_s, RobotMode.IDLE)]

    def release_brakes(self) -> None:
        """Release the brakes, and power up first if necessary.

        Raises:
            OperationRefusedError: An active stop forbids power.
        """
        self._check_power()
        if self.robot_mode == RobotMode.POWER_OFF and not self._next:
            self.power_on()
        if self.robot_mode == RobotMode.RUNNING or any(mode == RobotMode.RUNNING for _, mode in self._next):
            return
        begin = self._next[-1][0] if self._next else self._now_s
        self._next.append((begin + self.assumptions.brake_release_s, RobotMode.RUNNING))

    def power_off(self) -> None:
        """Switch the arm's power off."""
        self._next.clear()
        if self.robot_mode != RobotMode.DISCONNECTED:
            self.robot_mode = RobotMode.POWER_OFF

    def unlock_protective_stop(self, *, primary: bool = False) -> None:
        """Release a protective stop, if there is one.

        Args:
            primary: Whether the request came on the primary interface, not from the dashboard or the pendant.

        Raises:
            OperationRefusedError: It is too early: its cause is to be inspected first.
        """
        since = self._stopped.get(SafetyMode.PROTECTIVE_STOP)
        if since is None:
            return
        waits = self.assumptions.primary_unlock_waits or not primary
        if waits and self._now_s - since < self.assumptions.unlock_wait_s:
            raise OperationRefusedError(UNLOCK_TOO_EARLY)
        self.release(SafetyMode.PROTECTIVE_STOP)

    def restart(self) -> None:
        """Restart the safety system after a violation or a fault. The arm has no power then."""
        self.power_off()
        self._restarting_until = self._now_s + self.assumptions.restart_safety_s

    def _check_power(self) -> None:
        if self.robot_mode == RobotMode.DISCONNECTED:
            raise OperationRefusedError("the controller is shut down")
        for mode in self._stopped:
            if mode in _POWERLESS:
                raise OperationRefusedError(f"the arm gets no power while its safety mode is {SafetyMode(mode).name}")
        if self._loses_power:
            raise OperationRefusedError("the arm gets no power while it stops after an emergency stop: wait")


_KNOWN: Final = frozenset(int(mode) for mode in SafetyMode)
_SAFEGUARD: Final = frozenset((int(SafetyMode.SAFEGUARD_STOP),))

_BY_SEVERITY: Final = (
    SafetyMode.RECOVERY,
    SafetyMode.SAFEGUARD_STOP,
    SafetyMode.PROTECTIVE_STOP,
    SafetyMode.SYSTEM_EMERGENCY_STOP,
    SafetyMode.ROBOT_EMERGENCY_STOP,
    SafetyMode.VIOLATION,
    SafetyMode.FAULT,
)


def _severity(mode: int) -> int:
    """Rank simultaneous modes. An unknown number is graver than all known ones."""
    return _BY_SEVERITY.index(SafetyMode(mode)) if mode in _BY_SEVERITY else len(_BY_SEVERITY)
