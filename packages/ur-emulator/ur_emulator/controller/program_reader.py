"""Reader of the programs that clients send to one controller, which must not delay control periods."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Final

from ur_core.errors import LinkError, ScriptError, ScriptSyntaxError
from ur_core.processes.system import System
from ur_emulator.script import Builtins, Program, read
from ur_emulator.script.compiled import compiled, interfaces

SHORT: Final = 1024
"""Most characters of a program that is compiled in a thread, which holds Python's global lock meanwhile."""


class ProgramReader:
    """Reader of programs, one after the other: short ones in a thread, long ones in a process of its own.

    The process starts with `prepare`, or with the first long program.

    Args:
        system: Threads and processes.
        name: Name of the controller.
        builtins: Functions that its programs may call.
    """

    def __init__(self, system: System, name: str, builtins: Builtins) -> None:
        self._builtins, self._interfaces = builtins, interfaces(builtins)
        self._thread = system.worker(f"{name} programs")
        self._process = system.remote(compiled, f"{name} programs")
        self._prepared = False

    def prepare(self) -> None:
        """Start the process: clients wait for about a second until a program that they send plays."""
        if not self._prepared:
            self._prepared = True
            self._thread.submit(self._process.prepare)

    def submit(self, text: str) -> Future[Program | ScriptError]:
        """Read a program, and return what will be the program or its error."""
        return self._thread.submit(read, text, self._builtins, compiled if len(text) <= SHORT else self._elsewhere)

    def _elsewhere(self, text: str, _: Builtins) -> Program | ScriptError:
        try:
            return self._process(text, self._interfaces)
        except LinkError as error:
            return ScriptSyntaxError(1, "", f"the program could not be read: {error}")

    def close(self) -> None:
        """Give up what is being read."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._process.close()
