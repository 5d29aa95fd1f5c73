"""Starts functions of this package in processes of their own.

Unlike those of `multiprocessing`, they do not import the program that starts them: that works from a script without a
guard, from a notebook and from a terminal alike. They are in sessions of their own, so that Ctrl-C is for the program
alone.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from dual_ur10.sim2real.processes.interrupts import CHILD, held_back

log = logging.getLogger(__name__)

LOST: Final = 255
"""Code of a process whose end somebody else has taken note of."""

KILLED_S: Final = 5.0
"""How long a process that is killed is waited for: one that waits for a device may take its time."""

_LOOK_S: Final = 0.002


class Child:
    """A process that runs one function, and ends with it.

    It can be asked for its end at any time and however often that is interrupted: `Popen.poll` and `Popen.wait` cannot,
    for an interrupt leaves their lock taken, and whoever asks next waits for ever.

    Args:
        function: Of this package.
        arguments: For it; they are pickled.
        files: Numbers of open files that it gets under the same numbers.
        name: What a list of processes shows behind its command.
    """

    def __init__(
        self, function: Callable[..., None], *arguments: Any, files: Sequence[int] = (), name: str = ""
    ) -> None:
        work = pickle.dumps((function.__module__, function.__qualname__, os.getpid(), arguments))
        self._code: int | None = None
        process = None
        try:
            with held_back():  # an interrupt comes before there is a process, or once it is known here
                self._process = process = subprocess.Popen(
                    [sys.executable, "-P", "-m", CHILD, *filter(None, [name])],
                    stdin=subprocess.PIPE,
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(each or os.getcwd() for each in sys.path)},
                    start_new_session=True,
                    pass_fds=tuple(files),
                )
            if process.stdin is not None:
                with contextlib.suppress(OSError):  # it has ended already, which `is_alive` tells
                    process.stdin.write(work)
                    process.stdin.close()
        except BaseException:
            if process is not None:
                self.kill()
            raise

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self.code is None

    @property
    def code(self) -> int | None:
        """Its exit code; below 0 the signal that ended it; None: it runs."""
        if self._code is None:
            try:
                found = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:
                self._code = LOST
            else:
                if found is None:
                    return None
                self._code = found.si_status if found.si_code == os.CLD_EXITED else -found.si_status
        if self._process.returncode is None:  # known first, then taken from the system: in this order, nothing is lost
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, os.WNOHANG)
            self._process.returncode = self._code
        return self._code

    def wait(self, within_s: float) -> bool:
        """Wait for its end. Returns whether it has come."""
        end = time.monotonic() + within_s
        while self.is_alive:
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            time.sleep(min(left, _LOOK_S))
        return True

    def kill(self, within_s: float = KILLED_S) -> None:
        """End it at once, and wait for that, but not for ever."""
        if self.is_alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        if not self.wait(within_s):
            log.error("process %d was killed and has not ended within %g s: see what it waits for", self.pid, within_s)


def main() -> None:
    """Run in the new process: what to do comes by its input."""
    told = sys.stdin.buffer.read()
    if not told:
        return  # the program has ended before it could say
    module, name, parent, arguments = pickle.loads(told)
    if os.getppid() != parent:
        return  # the program has ended meanwhile
    getattr(importlib.import_module(module), name)(*arguments)


if __name__ == "__main__":
    main()
