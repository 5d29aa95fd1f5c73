"""Emulated cell in a process of its own."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO, Any, Final

from dual_ur10 import errors
from dual_ur10.errors import ClosedError, DualUR10Error, EmulatorError, LinkError, OperationRefusedError
from dual_ur10.sim2real.links.json_link import JsonLink
from dual_ur10.types import Closing

MODULE: Final = "dual_ur10.sim2real.emulator.emulator"
"""Main program of an emulated cell."""

_START_S: Final = 30.0
_END_S: Final = 5.0


class EmulatedCell(Closing):
    """Two emulated controllers and their simulated arms, for the duration of a `with` block.

    They run in a process of their own, because constructors of `ur_rtde` hold Python's global lock while they wait for
    answers: a controller in the same process could not answer them.

    Args:
        log: Log file of the cell; None keeps the log until the cell is closed.
        options: See `dual_ur10.sim2real.emulator.emulator.EmulatorOptions`.

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
        self._injection: JsonLink | None = None
        with self.closed_on_error():
            self.description = self._started()
            self.left: str = self.description["left"]["host"]
            self.right: str = self.description["right"]["host"]
            self.port: int = self.description["emulator"]["port"]
            self._injection = JsonLink("fault injection", self.left, self.port)

    def _started(self) -> dict[str, Any]:
        stdout = self.process.stdout
        ready = [] if stdout is None else select.select([stdout], [], [], _START_S)[0]
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

    def ask(self, do: str, **values: Any) -> Any:
        """Send one fault-injection request, such as `ask("stop", arm="left", mode=3)`.

        Returns:
            The value of the answer.

        Raises:
            ClosedError: The cell was closed.
            EmulatorError: The request was refused, or there was no answer.
        """
        if self._injection is None or self.process.stdin is None or self.process.stdin.closed:
            raise ClosedError("this emulated cell was closed: start another")
        try:
            return self._injection.ask(do, **values)
        except (LinkError, OperationRefusedError) as error:
            raise EmulatorError(str(error)) from error

    def setpoints(self, arm: str, since: int = 0) -> list[Any]:
        """Return the executed servoj targets of a controller from number `since` on, as far as it keeps them.

        Returns:
            For each: tick, target (6), t, lookahead, gain.
        """
        return self._pages("setpoints", "setpoints", arm, since)

    def packages(self, arm: str, since: int = 0) -> list[Any]:
        """Return the received RTDE packages with motion commands from number `since` on, as far as they are kept.

        Returns:
            For each: tick, `ur_rtde`'s number of the command, the first six numbers that belong to it.
        """
        return self._pages("received", "packages", arm, since)

    def _pages(self, do: str, name: str, arm: str, since: int) -> list[Any]:
        found: list[Any] = []
        while True:
            answer = self.ask(do, arm=arm, since=since)
            found += answer[name]
            since = answer["first"] + len(answer[name])
            if since >= answer["count"]:
                return found

    def wait_until(self, arm: str, name: str, value: Any, within_s: float = 10.0) -> None:
        """Wait until a controller reports this value of a variable, by RTDE name.

        Raises:
            EmulatorError: It did not in time.
        """
        end = time.monotonic() + within_s
        found = None
        while time.monotonic() < end:
            found = self.ask("state", arm=arm, names=[name])[name]
            if found == value:
                return
            time.sleep(0.01)
        raise EmulatorError(f"{name} of the {arm} controller is {found!r} after {within_s:g} s, and not {value!r}")

    def close(self) -> None:
        """End the process. May be called twice."""
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
