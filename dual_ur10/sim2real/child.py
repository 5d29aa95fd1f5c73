"""Starts functions of this package in processes of their own.

Unlike those of `multiprocessing`, they do not import the program that starts them: that works from a script without a
guard, from a notebook and from a terminal alike. They are in sessions of their own, so that Ctrl-C is for the program
alone.
"""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final

_MODULE: Final = "dual_ur10.sim2real.child"


class Child:
    """A process that runs one function, and ends with it.

    Args:
        function: Of this package.
        arguments: For it; they are pickled.
        files: Numbers of open files that it gets under the same numbers.
    """

    def __init__(self, function: Callable[..., None], *arguments: Any, files: Sequence[int] = ()) -> None:
        work = pickle.dumps((function.__module__, function.__qualname__, os.getpid(), arguments))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", _MODULE],
            stdin=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(each or os.getcwd() for each in sys.path)},
            start_new_session=True,
            pass_fds=tuple(files),
        )
        stdin = self._process.stdin
        if stdin is not None:
            try:
                stdin.write(work)
                stdin.close()
            except OSError:  # it has ended already, which `is_alive` tells
                pass

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """Its exit code; below 0 the signal that ended it; None: it runs."""
        return self._process.poll()

    def wait(self, within_s: float) -> bool:
        """Wait for its end. Returns whether it has come."""
        try:
            self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()


def main() -> None:
    """Run in the new process: what to do comes by its input."""
    module, name, parent, arguments = pickle.loads(sys.stdin.buffer.read())
    if os.getppid() != parent:
        return  # the program has ended meanwhile
    getattr(importlib.import_module(module), name)(*arguments)


if __name__ == "__main__":
    main()
