"""Power and brake release of both arms: the only functions here that change the state of a controller.

The operator requests it and confirms it. Nothing else is corrected: a controller in a stop, with a running program or
in local mode is left as it is, and so is the other one. Nothing here unlocks a stop or restarts a safety system.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from dual_ur10.errors import LinkError, OperationRefusedError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.dashboard_link import DashboardLink
from ur_core.processes.clock import Clock
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.modes import RobotMode, SafetyMode

POWER_S: Final = 60.0
"""Time limit of powering an arm."""

BRAKES_S: Final = 30.0
"""Time limit of releasing its brakes, after that."""

_POLL_S: Final = 0.1
_OFF, _IDLE, _RUNNING = (each.name for each in (RobotMode.POWER_OFF, RobotMode.IDLE, RobotMode.RUNNING))
_BEFORE: Final = (_OFF, RobotMode.POWER_ON.name, _IDLE, _RUNNING)
_MEANWHILE: Final = (*_BEFORE, RobotMode.BOOTING.name)  # joints boot when they get power
_NORMAL: Final = SafetyMode.NORMAL.name
_STOPPED: Final = "STOPPED"  # of the program


class _DashboardArm:
    """Arm with the connection to its dashboard."""

    def __init__(self, name: str, link: DashboardLink) -> None:
        self.name, self.link = name, link
        self.mode = ""

    def faults(self, modes: Sequence[str] = _BEFORE) -> list[str]:
        """Return its faults other than missing power, and store its mode, which must be one of `modes`."""
        found = []
        self.mode = self.link.robot_mode()
        if self.mode not in modes:
            found.append(
                f"{self.link.where}: robot mode {self.mode}, expected are {_OFF}, {_IDLE} or {_RUNNING}: bring it "
                "there at the pendant"
            )
        safety = self.link.safety()
        if safety != _NORMAL:
            found.append(
                f"{self.link.where}: safety {safety}, expected is {_NORMAL}: find the cause, and clear it at the "
                "pendant"
            )
        state = self.link.program_state()
        if state.split()[:1] != [_STOPPED]:
            found.append(f"{self.link.where}: program {state}, expected is {_STOPPED}: stop it at the pendant")
        if self.link.remote_control() is False:
            found.append(f"{self.link.where}: local mode, expected is remote: switch to Remote Control on the pendant")
        return found

    def do(self, command: str, expected: str) -> None:
        """Send a command.

        Raises:
            OperationRefusedError: It is refused.
        """
        answer = self.link.ask(command)
        if answer != expected:
            raise OperationRefusedError(
                f"{self.link.where}: answers {answer[:120]!r} to {command!r}, expected is {expected!r}: check "
                "the message on the pendant, and do it there"
            )


def power_on(cell_file: CellFile, confirm: Callable[[str], bool], *, system: System = LOCAL) -> bool:
    """Power both arms and release their brakes, with the operator's confirmation. It waits until both are ready.

    Args:
        cell_file: Cell file.
        confirm: Asks the operator, and returns True for yes. It is not called if both arms are ready.
        system: Clock and network.

    Returns:
        True if anything had to be done.

    Raises:
        LinkError: A controller cannot be reached, or is not ready in time.
        OperationRefusedError: An arm has another fault, and nothing was sent to either; or the operator did not confirm
            it; or a controller refuses, or a fault came up meanwhile: an arm that has power then keeps it.
    """
    with _connected(cell_file, system) as arms:
        _check(arms)
        waiting = [arm for arm in arms if arm.mode != _RUNNING]
        if not waiting:
            return False
        states = " and ".join(f"the {arm.name} arm ({arm.mode})" for arm in waiting)
        entries = dict(zip(ARMS, cell_file.arms, strict=True))
        payloads = ", ".join(
            f"{arm.name} {'not said' if (kg := entries[arm.name].payload_kg) is None else f'{kg:g} kg'}"
            for arm in waiting
        )
        question = (
            f"Switch on {states} and release the brakes? Arms may sink a little then. Keep out of their reach, and see "
            f"that mounting and payload are set on the pendant as they are (cell file: {payloads})."
        )
    if confirm(question) is not True:
        raise OperationRefusedError(
            "power was not confirmed: nothing was switched. Confirm it, or do it at the pendant"
        )
    # The answer may have taken minutes, so both arms are checked again.
    with _connected(cell_file, system) as arms:
        _check(arms)
        asked = [arm.name for arm in waiting]
        for arm in arms:
            if arm.mode != _RUNNING and arm.name not in asked:
                raise OperationRefusedError(
                    f"{arm.link.where}: robot mode {arm.mode}, and {_RUNNING} before the question: nothing was "
                    "switched. Find the cause, and start again"
                )
        for arm in arms:
            if arm.mode == _OFF:
                arm.do("power on", "Powering on")
        _wait(arms, (_IDLE, _RUNNING), POWER_S, system.clock)
        for arm in arms:
            if arm.mode == _IDLE:
                arm.do("brake release", "Brake releasing")
        _wait(arms, (_RUNNING,), BRAKES_S, system.clock)
    return True


@contextlib.contextmanager
def _connected(cell_file: CellFile, system: System) -> Iterator[list[_DashboardArm]]:
    """Connect to the dashboards of both arms."""
    with contextlib.ExitStack() as stack:
        yield [
            _DashboardArm(name, stack.enter_context(DashboardLink(arm.host, name=name, system=system)))
            for name, arm in zip(ARMS, cell_file.arms, strict=True)
        ]


def _check(arms: Sequence[_DashboardArm]) -> None:
    found = [text for arm in arms for text in arm.faults()]
    if found:
        raise OperationRefusedError("no arm was given power: " + "; ".join(found))


def _wait(arms: Sequence[_DashboardArm], modes: Sequence[str], within_s: float, clock: Clock) -> None:
    """Wait until both are in one of the modes.

    Raises:
        LinkError: They are not in time, or a connection was lost.
        OperationRefusedError: Another fault came up.
    """
    end_s = clock.now_s() + within_s
    while True:
        found = [text for arm in arms for text in arm.faults(_MEANWHILE)]
        if found:
            raise OperationRefusedError("; ".join(found))
        late = [arm for arm in arms if arm.mode not in modes]
        if not late:
            return
        if clock.now_s() >= end_s:
            raise LinkError(
                f"{late[0].link.where}: robot mode {late[0].mode} after {within_s:g} s, expected is {modes[0]}: check "
                "the message on the pendant"
            )
        clock.sleep(_POLL_S)
