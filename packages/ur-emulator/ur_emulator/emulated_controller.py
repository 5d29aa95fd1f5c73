"""Emulated controllers in a process of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import IO, Any, ClassVar, Final

from ur_core import errors
from ur_core.errors import EmulatorError, URError
from ur_core.links.json_link import JsonLink
from ur_core.processes.system import LOCAL
from ur_emulator.injection.cell_requests import CellRequests

_START_S: Final = 30.0
_END_S: Final = 5.0


class EmulatorProcess(CellRequests):
    """Process of emulated controllers and their simulated arms, for the duration of a `with` block.

    They have a process of their own, because constructors of `ur_rtde` hold Python's global lock while they wait for
    answers: a controller in the same process could not answer them.

    Args:
        log: Log file; None keeps the log until the process is closed.
        options: Plain values for the main module, as JSON.

    Attributes:
        module: Main module of the process.
        errors: Module of the errors that the process may answer with.
        process: The process.
        hosts: Address of each controller, by its name.
        port: Fault-injection port, at the first controller's address.
        description: Tables that `Emulator.description` returns.

    Raises:
        AddressError: An address cannot be used.
        EmulatorError: The process did not start.
        URError: An option is invalid.
    """

    module: ClassVar[str] = "ur_emulator.emulator"
    errors: ClassVar[ModuleType] = errors

    def __init__(self, log: str | Path | None, options: Mapping[str, Any]) -> None:
        try:
            text = json.dumps(options)
        except (TypeError, ValueError) as error:
            kind: type[Exception] = self.errors.SettingsError
            raise kind(
                f"options of emulated controllers are {options!r:.200}: they must be values that JSON holds ({error}). "
                "Name an object of your own as module:NAME, and convert NumPy's numbers"
            ) from error
        # The other process writes and this one reads. Appending keeps the write position independent of reads.
        if log is None:
            self._log: IO[str] = tempfile.TemporaryFile("a+")  # noqa: SIM115  # closed with the cell
        else:
            Path(log).write_text("")
            self._log = Path(log).open("a+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", self.module, text],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            # It imports from the same places. Ctrl-C reaches this program alone.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        self.clock = LOCAL.clock
        with self.closed_on_error():
            self.description = self._started()
            self.hosts: dict[str, str] = {
                name: each["host"] for name, each in self.description.items() if "host" in each
            }
            self.port: int = self.description["emulator"]["port"]
            self._injection = JsonLink("fault injection", next(iter(self.hosts.values())), self.port)

    def _started(self) -> dict[str, Any]:
        stdout = self.process.stdout
        ready = [] if stdout is None else self.clock.wait((stdout.fileno(),), self.clock.now_s() + _START_S)[0]
        line = stdout.readline() if stdout is not None and ready else b""
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            code = self.process.poll()
            what = f"gave no answer within {_START_S:g} s" if code is None else f"ended with code {code}"
            raise EmulatorError(
                f"the process of the emulated controllers {what}; its log ends: {self.log_tail()}"
            ) from None
        if "error" in answer:
            kind = getattr(self.errors, answer["error"], EmulatorError)
            if not issubclass(kind, URError) or kind is errors.UnknownNameError:
                kind = errors.SettingsError
            raise kind(answer["text"])
        return answer

    def log_tail(self, characters: int = 2000) -> str:
        """Return the end of the log."""
        self._log.seek(0)
        return self._log.read()[-characters:].strip()

    def close(self) -> None:
        """End the process. May be called twice."""
        self._closed = True
        if self._injection is not None:
            self._injection.close()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._log.close()


class EmulatedController(EmulatorProcess):
    """One emulated controller, whose arm stands by itself, for the duration of a `with` block.

        with EmulatedController("ur5e") as controller:
            rtde = rtde_receive.RTDEReceiveInterface(controller.host)
            controller.ask("stop", mode=3)

    Args:
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.
        host: Loopback address; None finds a free one.
        log: Log file; None keeps the log until the controller is closed.
        options: Others of `ur_emulator.emulator.ControllerOptions`, such as `plant`, `seed` and `polyscope`.

    Attributes:
        host: Its address.

    Raises:
        URError: See `EmulatorProcess`.
    """

    def __init__(
        self, robot: str = "ur5e", *, host: str | None = None, log: str | Path | None = None, **options: Any
    ) -> None:
        super().__init__(log, {**options, "robot": robot, "host": host})
        ((self.robot, self.host),) = self.hosts.items()

    def wait_for(self, name: str, value: Any, within_s: float = 10.0) -> None:
        """Wait until the controller reports this value of a variable, by RTDE name.

        Raises:
            EmulatorError: It did not in time.
        """
        self.wait_until(self.robot, name, value, within_s)
