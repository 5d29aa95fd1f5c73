"""Ctrl-C: one line while the program loads and once it ends, and deferral of SIGINT around critical sections.

The first module that `dual_ur10` imports. Where another program imports the package, it changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any, Final

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as shells have it."""

CHILD: Final = "dual_ur10.sim2real.processes.child_process"
"""Module that the processes of a cell begin with."""


def end_interrupted(*_: Any) -> None:
    """Say one line and end. What is being done comes to its end first, as by any other exception.

    Raises:
        SystemExit: With code `INTERRUPTED`.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # what still has to be ended takes a bounded time
    sys.stderr.write("interrupted\n")
    raise SystemExit(INTERRUPTED)


def begin_program() -> None:
    """Everything is loaded: from here on Ctrl-C is a `KeyboardInterrupt` again, by which commands end in order."""
    if signal.getsignal(signal.SIGINT) is end_interrupted:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def is_child() -> bool:
    """Whether this is a process of a cell, of an arm for instance, and no program of a user."""
    return CHILD in sys.orig_argv


def _is_program() -> bool:
    """Whether what is loaded is the command line: `-m` is its first argument for as long as modules are looked for."""
    begun = sys.argv[0] if sys.argv else ""
    return (begun == "-m" and "dual_ur10" in sys.orig_argv) or os.path.basename(begun) == "dual-ur10"


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Within, no SIGINT is heard; it comes right behind. For what takes a bounded time.

    Only the main thread is interrupted, so elsewhere this does nothing.
    """
    # None: handled by other than Python, and cannot be put back.
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is None:
        yield
        return
    waiting: list[tuple[Any, ...]] = []
    before = signal.signal(signal.SIGINT, lambda *heard: waiting.append(heard))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if waiting and callable(before):
            before(*waiting[-1])
        elif waiting and before == signal.SIG_DFL:
            signal.raise_signal(signal.SIGINT)


# Only where it would be a KeyboardInterrupt: a program in the background ignores it.
if _is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, end_interrupted)
