"""Dashboard server (port 29999): one command per line, one answer per line.

Commands and answers: UR's articles "Dashboard Server CB-Series" and "Dashboard Server e-Series", and the answers that
Universal Robots' client library accepts. "Assumption" marks behaviour that none of them specifies.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ur_core.errors import OperationRefusedError, UnknownNameError
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyMode
from ur_emulator.controller.pendant import Pendant
from ur_emulator.profile import ControllerProfile

log = logging.getLogger(__name__)

GREETING: Final = "Connected: Universal Robots Dashboard Server"

LOCAL_MODE: Final = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and reconnect to port "
    "29999"
)
"""Answer of an e-Series controller in local mode, as users of UR's drivers have quoted it."""

USER_ROLES: Final = ("programmer", "operator", "none", "locked", "restricted")
"""User roles of a CB3 (UR's article "Dashboard Server CB-Series")."""

_LONGEST_NAME: Final = 4  # words

# `safetymode` is older than `safetystatus` and has one kind of safeguard stop. Assumption: it still has.
_AS_SAFEGUARD: Final = (
    SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP,
    SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP,
    SafetyMode.TEACH_PENDANT_THREE_POSITION_ENABLING_STOP,
)

_PROGRAM_STATES: Final = {
    RuntimeState.PLAYING: "PLAYING",
    RuntimeState.RESUMING: "PLAYING",
    RuntimeState.PAUSING: "PAUSED",
    RuntimeState.PAUSED: "PAUSED",
}


@dataclass(frozen=True)
class _Command:
    """Dashboard command: its answer and the versions that have it.

    Attributes:
        answer: Function from the argument to the answer.
        e_series: First PolyScope 5 that has it, if any.
        cb3: First PolyScope 3 that has it, if any.
        argument: Whether text may follow the name.
        remote: Whether an e-Series controller allows it only in remote control.
        refusal: Answer if the robot refuses; `{}` stands for the argument. If empty, the refusal's own text.
    """

    answer: Callable[[str], str]
    e_series: tuple[int, int] | None = (5, 0)
    cb3: tuple[int, int] | None = (3, 0)
    argument: bool = False
    remote: bool = False
    refusal: str = ""


class Dashboard:
    """One connection to the dashboard server.

    Make one for each connection: after a switch to remote control, a client that connected in local mode has to connect
    again, as on a real controller.

    Args:
        profile: Profile of the controller.
        robot: Operations behind the commands.

    Attributes:
        greeting: First line for a new client.
        closed: Whether to close the connection after the last answer.
    """

    greeting = GREETING

    def __init__(self, profile: ControllerProfile, robot: Pendant) -> None:
        self.closed = False
        self._profile, self._robot = profile, robot
        self._connected_locally = self._is_local()
        self._commands = {name: command for name, command in self._all_commands().items() if _exists(command, profile)}

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of all commands that this controller has."""
        return tuple(self._commands)

    def answer(self, line: str) -> str:
        """Answer one line, without an end of line. No input raises."""
        found = self._find(line.strip())
        if found is None:
            return f"could not understand: '{line.strip()}'"
        command, argument = found
        if command.remote and (self._is_local() or self._connected_locally):
            return LOCAL_MODE
        try:
            return command.answer(argument)
        except UnknownNameError as reason:
            log.info("dashboard, %r: %s", line, reason)
            return f"File not found: {argument}"
        except OperationRefusedError as reason:
            log.info("dashboard, %r is refused: %s", line, reason)
            return command.refusal.replace("{}", argument) or " ".join(str(reason).split())

    def _find(self, line: str) -> tuple[_Command, str] | None:
        """Return the command of a line with its argument: the longest matching name, in any case (assumed for CB3)."""
        words = line.split(" ")
        for count in range(min(len(words), _LONGEST_NAME), 0, -1):
            command = self._commands.get(" ".join(words[:count]).lower())
            argument = " ".join(words[count:]).strip()
            if command is not None and (command.argument or not argument):
                return command, argument
        return None

    def _is_local(self) -> bool:
        return self._profile.has_remote_control and self._robot.remote_control is False

    def _all_commands(self) -> dict[str, _Command]:
        robot, profile = self._robot, self._profile
        version = ".".join(map(str, profile.version))

        def done(text: str, act: Callable[[], None]) -> Callable[[str], str]:
            def answer(_: str) -> str:
                act()
                return text

            return answer

        def asked(text: Callable[[], str]) -> Callable[[str], str]:
            return lambda _: text()

        def switch(name: str, text: str, act: Callable[[], None]) -> dict[str, _Command]:
            # UR documents the refusals of play, stop and pause. Assumption: the others refuse in the same words.
            return {name: _Command(done(text, act), remote=True, refusal=f"Failed to execute: {name}")}

        return {
            "load": _Command(self._load, argument=True, remote=True, refusal="Error while loading program: {}"),
            **switch("play", "Starting program", robot.play),
            **switch("stop", "Stopped", robot.stop),
            **switch("pause", "Pausing program", robot.pause),
            "quit": _Command(done("Disconnected", self._close)),
            "shutdown": _Command(done("Shutting down", self._shutdown), remote=True),
            "running": _Command(asked(lambda: f"Program running: {str(self._plays()).lower()}")),
            "robotmode": _Command(asked(lambda: f"Robotmode: {_name(RobotMode, robot.robot_mode)}")),
            "get loaded program": _Command(asked(self._loaded)),
            "popup": _Command(self._popup, argument=True),
            "close popup": _Command(done("closing popup", robot.close_popup)),
            "addtolog": _Command(self._add_to_log, argument=True),
            "isprogramsaved": _Command(asked(lambda: f"{str(robot.program_saved).lower()} {self._program()}")),
            "programstate": _Command(asked(self._program_state)),
            "polyscopeversion": _Command(asked(lambda: f"URSoftware {version} ({profile.released})")),
            "version": _Command(asked(lambda: version), cb3=None),
            "setuserrole": _Command(
                self._set_user_role, e_series=None, cb3=(3, 1), argument=True, refusal="Failed setting user role: {}"
            ),
            "getuserrole": _Command(asked(lambda: robot.user_role.upper()), e_series=None, cb3=(3, 1)),
            "set operational mode": _Command(
                self._set_operational_mode, cb3=None, argument=True, refusal="Failed setting operational mode: {}"
            ),
            "get operational mode": _Command(asked(lambda: robot.operational_mode), e_series=(5, 6), cb3=None),
            "clear operational mode": _Command(asked(self._clear_operational_mode), cb3=None),
            **switch("power on", "Powering on", robot.power_on),
            **switch("power off", "Powering off", robot.power_off),
            **switch("brake release", "Brake releasing", robot.release_brakes),
            "safetymode": _Command(asked(self._safety_mode)),
            "safetystatus": _Command(
                asked(lambda: f"Safetystatus: {_name(SafetyMode, robot.safety_mode)}"), e_series=(5, 4), cb3=(3, 11)
            ),
            "unlock protective stop": _Command(
                done("Protective stop releasing", robot.unlock_protective_stop), cb3=(3, 1), remote=True
            ),
            "close safety popup": _Command(done("closing safety popup", robot.close_safety_popup), cb3=(3, 1)),
            "load installation": _Command(
                self._load_installation,
                cb3=(3, 2),
                argument=True,
                remote=True,
                refusal="Failed to load installation: {}",
            ),
            "restart safety": _Command(
                done("Restarting safety", robot.restart_safety),
                e_series=(5, 1),
                cb3=(3, 7),
                remote=True,
                refusal="Failed to execute: restart safety",
            ),
            "is in remote control": _Command(
                asked(lambda: str(bool(robot.remote_control)).lower()), e_series=(5, 6), cb3=None
            ),
            "get serial number": _Command(asked(lambda: profile.serial_number), e_series=(5, 6), cb3=(3, 12)),
            "get robot model": _Command(asked(lambda: profile.model), e_series=(5, 6), cb3=(3, 12)),
            "generate flight report": _Command(self._flight_report, e_series=(5, 8), cb3=(3, 13), argument=True),
            "generate support file": _Command(self._support_file, e_series=(5, 8), cb3=(3, 13), argument=True),
            "savelog": _Command(asked(lambda: "Log saved to disk"), e_series=(5, 8), cb3=(3, 13)),
        }

    def _plays(self) -> bool:
        return self._robot.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING)

    def _program(self) -> str:
        """Return the loaded program without its folder, as PolyScope names it."""
        return self._robot.loaded_program.rsplit("/", 1)[-1] or "<unnamed>"

    def _loaded(self) -> str:
        path = self._robot.loaded_program
        return f"Loaded program: {path}" if path else "No program loaded"

    def _program_state(self) -> str:
        state = self._robot.runtime_state
        known = RuntimeState(state) if state in set(RuntimeState) else RuntimeState.STOPPED
        return f"{_PROGRAM_STATES.get(known, 'STOPPED')} {self._program()}"

    def _safety_mode(self) -> str:
        mode = self._robot.safety_mode
        return f"Safetymode: {_name(SafetyMode, SafetyMode.SAFEGUARD_STOP if mode in _AS_SAFEGUARD else mode)}"

    def _load(self, name: str) -> str:
        self._robot.load(name)
        return f"Loading program: {name}"

    def _load_installation(self, name: str) -> str:
        self._robot.load_installation(name)
        return f"Loading installation: {name}"

    def _popup(self, text: str) -> str:
        self._robot.popup(text)
        return "showing popup"

    def _add_to_log(self, text: str) -> str:
        if not text:
            return "No log message to add"
        self._robot.add_to_log(text)
        return "Added log message"

    def _set_user_role(self, argument: str) -> str:
        role = argument.split(" ")[0].lower()  # "restricted" takes a key, too
        if role not in USER_ROLES:
            return f"Failed setting user role: {argument}"
        self._robot.set_user_role(role)
        return f"Setting user role: {argument.split(' ')[0]}"

    def _set_operational_mode(self, argument: str) -> str:
        if argument.lower() not in ("manual", "automatic"):
            return f"Failed setting operational mode: {argument}"
        self._robot.set_operational_mode(argument.upper())
        return f"Operational mode {argument.upper()} is set"

    def _clear_operational_mode(self) -> str:
        self._robot.clear_operational_mode()
        mode = self._robot.operational_mode
        return f"No longer controlling the operational mode. Current operational mode: '{mode}'."

    def _flight_report(self, kind: str) -> str:
        try:
            return f"Flight Report generated with id:{self._robot.flight_report(kind.lower())}"
        except UnknownNameError as error:
            return f"Error: {' '.join(str(error).split())}"

    def _support_file(self, folder: str) -> str:
        # In the words of a success, although nothing is written: clients wait for them.
        return f"Completed successfully: {folder.rstrip('/') or '.'}/ursupport.zip"

    def _close(self) -> None:
        self.closed = True

    def _shutdown(self) -> None:
        self._robot.shutdown()
        self.closed = True


def _exists(command: _Command, profile: ControllerProfile) -> bool:
    never = (99, 0)
    return profile.at_least(command.e_series or never, command.cb3)


def _name(kind: type[RobotMode] | type[SafetyMode], number: int) -> str:
    """Return UR's word for a mode, or the number itself if it has none."""
    return kind(number).name if number in set(kind) else str(number)
