"""Emulated cell in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any, Final

from dual_ur10 import errors
from dual_ur10.errors import DualUR10Error, EmulatorError
from dual_ur10.sim2real.links.json_link import JsonLink
from dual_ur10.sim2real.processes.system import LOCAL
from ur_emulator.cell_requests import CellRequests

MODULE: Final = "ur_emulator.emulator"
"""Main program of an emulated cell."""

_START_S: Final = 30.0
_END_S: Final = 5.0


class EmulatedCell(CellRequests):
    """Two emulated controllers and their simulated arms, for the duration of a `with` block.

    They run in a process of their own, because constructors of `ur_rtde` hold Python's global lock while they wait for
    answers: a controller in the same process could not answer them.

    Args:
        log: Log file of the cell; None keeps the log until the cell is closed.
        options: See `ur_emulator.emulator.EmulatorOptions`.

    Attributes:
        left, right: Addresses of the controllers.
        port: Fault-injection port, at the left controller's address.
        description: Content of the cell file.

    Raises:
        AddressError: An address cannot be used.
        EmulatorError: The process did not start.
        DualUR10Error: An option is invalid.
    """

    def __init__(self, *, log: str | Path | None = None, **options: Any) -> None:
        # The other process writes and this one reads. Appending keeps the write position independent of reads.
        if log is None:
            self._log: IO[str] = tempfile.TemporaryFile("a+")  # noqa: SIM115  # closed with the cell
        else:
            Path(log).write_text("")
            self._log = Path(log).open("a+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", MODULE, json.dumps(options)],
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
            self.left: str = self.description["left"]["host"]
            self.right: str = self.description["right"]["host"]
            self.port: int = self.description["emulator"]["port"]
            self._injection = JsonLink("fault injection", self.left, self.port)

    def _started(self) -> dict[str, Any]:
        stdout = self.process.stdout
        ready = [] if stdout is None else self.clock.wait((stdout.fileno(),), self.clock.now_s() + _START_S)[0]
        line = stdout.readline() if stdout is not None and ready else b""
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            code = self.process.poll()
            what = f"gave no answer within {_START_S:g} s" if code is None else f"ended with code {code}"
            raise EmulatorError(f"the process of the emulated cell {what}; its log ends: {self.log_tail()}") from None
        if "error" in answer:
            kind = getattr(errors, answer["error"], EmulatorError)
            if not issubclass(kind, DualUR10Error) or kind is errors.UnknownNameError:
                kind = errors.SettingsError
            raise kind(answer["text"])
        return answer

    def log_tail(self, characters: int = 2000) -> str:
        """Return the end of the cell's log."""
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
