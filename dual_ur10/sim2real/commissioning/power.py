"""Power for both arms, and their brakes released: the only things here that change the state of a controller.

A person has to have asked for it, and confirms it. Nothing else is put right: a controller in a stop, with a program
running or in local mode is left as it is, and so is the other one. Nothing here unlocks a stop or restarts a safety
system.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from dual_ur10.errors import LinkError, OperationRefusedError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.links.dashboard_link import DashboardLink
from dual_ur10.sim2real.protocol.modes import RobotMode, SafetyMode

POWER_S: Final = 60.0
"""Within how long an arm must have power."""

BRAKES_S: Final = 30.0
"""And its brakes be released, after that."""

_POLL_S: Final = 0.1
_OFF, _IDLE, _RUNNING = (each.name for each in (RobotMode.POWER_OFF, RobotMode.IDLE, RobotMode.RUNNING))
_STANDING: Final = (_OFF, RobotMode.POWER_ON.name, _IDLE, _RUNNING)
_ON_THE_WAY: Final = (*_STANDING, RobotMode.BOOTING.name)  # joints boot when they get power
_NORMAL: Final = SafetyMode.NORMAL.name
_STOPPED: Final = "STOPPED"  # of the program


class _Arm:
    """One arm, and the connection to its dashboard."""

    def __init__(self, name: str, link: DashboardLink) -> None:
        self.name, self.link = name, link
        self.mode = ""

    def look(self, modes: Sequence[str] = _STANDING) -> list[str]:
        """What is wrong with it, but that it has no power. Sets its mode, which is to be one of these."""
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
                f"{self.link.where}: safety {safety}, expected is {_NORMAL}: look at the cause, and clear it at the "
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
                f"{self.link.where}: answers {answer[:120]!r} to {command!r}, expected is {expected!r}: see what the "
                "pendant says, and do it there"
            )


def power_on(cell_file: CellFile, confirm: Callable[[str], bool]) -> bool:
    """Give both arms power and release their brakes, if a person agrees. It waits until both are ready.

    Args:
        cell_file: Of the cell.
        confirm: Shows the question to a person, and says whether the answer was yes. It is not called if both arms are
            ready already.

    Returns:
        Whether anything had to be done.

    Raises:
        LinkError: A controller cannot be reached, or does not get there in time.
        OperationRefusedError: Something else is wrong with an arm, and nothing was sent to either; or the person did
            not agree; or a controller refuses, or something went wrong meanwhile: what has power then keeps it.
    """
    with _connected(cell_file) as arms:
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
    # A person may have taken minutes: what was true then need not be true now.
    with _connected(cell_file) as arms:
        _check(arms)
        asked = [arm.name for arm in waiting]
        for arm in arms:
            if arm.mode != _RUNNING and arm.name not in asked:
                raise OperationRefusedError(
                    f"{arm.link.where}: robot mode {arm.mode}, and {_RUNNING} when a person was asked: nothing was "
                    "switched. See why, and ask again"
                )
        for arm in arms:
            if arm.mode == _OFF:
                arm.do("power on", "Powering on")
        _wait(arms, (_IDLE, _RUNNING), POWER_S)
        for arm in arms:
            if arm.mode == _IDLE:
                arm.do("brake release", "Brake releasing")
        _wait(arms, (_RUNNING,), BRAKES_S)
    return True


@contextlib.contextmanager
def _connected(cell_file: CellFile) -> Iterator[list[_Arm]]:
    """Both arms' dashboards, as long as the `with` block lasts."""
    with contextlib.ExitStack() as stack:
        yield [
            _Arm(name, stack.enter_context(DashboardLink(arm.host, name=name)))
            for name, arm in zip(ARMS, cell_file.arms, strict=True)
        ]


def _check(arms: Sequence[_Arm]) -> None:
    found = [text for arm in arms for text in arm.look()]
    if found:
        raise OperationRefusedError("no arm was given power: " + "; ".join(found))


def _wait(arms: Sequence[_Arm], modes: Sequence[str], within_s: float) -> None:
    """Wait until both are in one of the modes.

    Raises:
        LinkError: They are not within the time, or a connection was lost.
        OperationRefusedError: Something else is wrong meanwhile.
    """
    end_s = time.monotonic() + within_s
    while True:
        found = [text for arm in arms for text in arm.look(_ON_THE_WAY)]
        if found:
            raise OperationRefusedError("; ".join(found))
        late = [arm for arm in arms if arm.mode not in modes]
        if not late:
            return
        if time.monotonic() >= end_s:
            raise LinkError(
                f"{late[0].link.where}: robot mode {late[0].mode} after {within_s:g} s, expected is {modes[0]}: see "
                "what the pendant says"
            )
        time.sleep(_POLL_S)
