"""Operator actions on one controller, at its teach pendant or through its dashboard server."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final

from ur_core.errors import OperationRefusedError, ScriptError, UnknownNameError
from ur_core.protocol.modes import RobotMode, RuntimeState
from ur_emulator.controller.controller import Controller
from ur_emulator.controller.program_files import ProgramFiles
from ur_emulator.script import Program, parse

log = logging.getLogger(__name__)

_MAX_PROGRAMS = 64

FLIGHT_REPORTS: Final = ("", "controller", "software", "system")
"""Kinds of flight reports (UR's article "Dashboard Server e-Series")."""


class Pendant:
    """Operator actions on one controller.

    Methods raise [OperationRefusedError][ur_core.errors.OperationRefusedError] where a controller would refuse.

    Args:
        controller: The controller.
        off: Called when the controller is shut down.
        texts: Texts of its program files, by path.

    Attributes:
        programs: Programs stored on the controller since its start, by their names.
        files: Program files that it had at its start.
    """

    def __init__(self, controller: Controller, off: Callable[[], None], texts: Mapping[str, str] | None = None) -> None:
        self._controller, self._off = controller, off
        self.programs: dict[str, Program] = {}
        self.files = ProgramFiles(texts or {}, controller.program.builtins)
        self._loaded: Program | None = None
        self._flight_reports = 0
        self.operational_mode = "NONE"
        self.user_role = "programmer"
        self._file = ""

    @property
    def robot_mode(self) -> int:
        """RTDE's `robot_mode`, as reported."""
        return int(self._controller.overrides.get("robot_mode", self._controller.safety.robot_mode))

    @property
    def safety_mode(self) -> int:
        """RTDE's `safety_mode`, as reported."""
        return int(self._controller.overrides.get("safety_mode", self._controller.safety.safety_mode))

    @property
    def runtime_state(self) -> int:
        """RTDE's `runtime_state`, as reported."""
        return int(self._controller.overrides.get("runtime_state", self._controller.program.state))

    @property
    def remote_control(self) -> bool | None:
        """True in remote control, False in local control, None if the controller's settings have switched both off."""
        return self._controller.remote_control

    @property
    def loaded_program(self) -> str:
        """Program that `play` starts: the loaded file, or the name of a program that a client has sent since."""
        return self._file if self.program_saved else self._controller.program.name

    @property
    def program_saved(self) -> bool:
        """True if `play` starts a file."""
        return self._loaded is not None and self._controller.program.last is self._loaded

    def keep(self, name: str, text: str) -> None:
        """Store a program on the controller.

        Raises:
            ScriptError: It is no valid program.
        """
        program = parse(text, self._controller.program.builtins)
        self.programs.pop(name, None)
        self.programs[name] = program
        while len(self.programs) > _MAX_PROGRAMS:
            del self.programs[next(iter(self.programs))]

    def power_on(self) -> None:
        """Switch the arm's power on."""
        self._controller.safety.power_on()

    def power_off(self) -> None:
        """End the program and switch the arm's power off."""
        self._controller.program.stop("the arm's power was switched off")
        self._controller.safety.power_off()

    def release_brakes(self) -> None:
        """Release the brakes."""
        self._controller.safety.release_brakes()

    def unlock_protective_stop(self, *, primary: bool = False) -> None:
        """End a protective stop. `primary`: whether the primary interface asks for it."""
        self._controller.safety.unlock_protective_stop(primary=primary)

    def close_safety_popup(self) -> None:
        """Do nothing: this pendant has no screen."""

    def restart_safety(self) -> None:
        """Restart after a violation or a fault."""
        self._controller.program.stop("the safety system is restarted")
        self._controller.safety.restart()

    def play(self) -> None:
        """Start the loaded program, or resume a paused one."""
        self._controller.play()

    def resume(self) -> None:
        """Resume a paused program. Unlike `play`, this starts none.

        Raises:
            OperationRefusedError: The arm must not move, or no program is paused.
        """
        if self._controller.program.state not in (RuntimeState.PAUSED, RuntimeState.PAUSING):
            raise OperationRefusedError("no program is paused")
        self._controller.play()

    def pause(self) -> None:
        """Pause the program."""
        self._controller.program.pause()

    def stop(self) -> None:
        """Stop the program."""
        self._controller.program.stop("the operator stopped it")

    def load(self, name: str) -> None:
        """Load a stored program.

        Raises:
            UnknownNameError: There is no such program.
            OperationRefusedError: It is no valid program.
        """
        program = self.programs.get(name) or self.files.find(name)
        if program is None:
            # A list, not `allowed`: the search for the nearest of many names takes longer than a control period.
            known = ", ".join(map(repr, (*self.programs, *self.files.names)))
            raise UnknownNameError("program", name, (), f"one of {known}" if known else "")
        if isinstance(program, ScriptError):
            raise OperationRefusedError(f"{name} is no valid program: {program}")
        self._controller.program.prepare(program)
        self._file, self._loaded = name, program

    def load_installation(self, name: str) -> None:
        """Load an installation.

        Raises:
            UnknownNameError: It is not the only one.
        """
        if name != "default.installation":
            raise UnknownNameError("installation", name, ("default.installation",))

    def popup(self, text: str) -> None:
        """Show a message."""
        self._controller.open_popup("Popup", text)

    def close_popup(self) -> None:
        """Close the message."""
        self._controller.popup = ""

    def add_to_log(self, text: str) -> None:
        """Write to the log."""
        log.info("%s: %s", self._controller.name, text)

    def flight_report(self, kind: str) -> int:
        """Return the number of a flight report. No file is written.

        Raises:
            UnknownNameError: There is no such kind.
        """
        if kind not in FLIGHT_REPORTS:
            raise UnknownNameError("flight report", kind, FLIGHT_REPORTS)
        self._flight_reports += 1
        log.info("%s: flight report %d is not written: it is not emulated", self._controller.name, self._flight_reports)
        return self._flight_reports

    def shutdown(self) -> None:
        """Switch the controller off."""
        self.power_off()
        self._controller.safety.robot_mode = RobotMode.DISCONNECTED
        self._off()

    def set_operational_mode(self, mode: str) -> None:
        """Switch to "MANUAL" or "AUTOMATIC"."""
        self.operational_mode = mode

    def clear_operational_mode(self) -> None:
        """Let the pendant switch the operational mode again."""
        self.operational_mode = "NONE"

    def set_user_role(self, role: str) -> None:
        """Switch the user role of a CB3."""
        self.user_role = role
