"""Ctrl-C: one line while the program loads and once it ends, and deferral of SIGINT around critical sections.

The first module that `dual_ur10` imports. Where another program imports the package, it changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as in shells."""

PROGRAMS: Final = {"dual_ur10": "dual-ur10", "ur_emulator": "ur-emulator"}
"""Names of the command lines, by package."""

CHILD: Final = "ur_core.processes.child_process"
"""Main module of the child processes of a cell."""


def end_interrupted(*_: Any) -> None:
    """Print one line and end. Running code unwinds as after any other exception.

    Raises:
        SystemExit: With code `INTERRUPTED`.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the clean-up that is left takes a bounded time
    sys.stderr.write("interrupted\n")
    raise SystemExit(INTERRUPTED)


def begin_program() -> None:
    """Make Ctrl-C a `KeyboardInterrupt` again, once everything is loaded: commands handle it."""
    if signal.getsignal(signal.SIGINT) is end_interrupted:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def is_child() -> bool:
    """Return True in a child process of a cell, such as that of an arm."""
    return CHILD in sys.orig_argv


def _is_program() -> bool:
    """Return True if a command line is being loaded: `-m` is its first argument while Python looks for modules."""
    begun = sys.argv[0] if sys.argv else ""
    return (begun == "-m" and not PROGRAMS.keys().isdisjoint(sys.orig_argv)) or (
        os.path.basename(begun) in PROGRAMS.values()
    )


@contextlib.contextmanager
def interrupts_deferred(notify: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Defer SIGINT to the end of the `with` block, which must take a bounded time.

    Only the main thread is interrupted, so elsewhere this does nothing.

    Args:
        notify: Called when one comes, to shorten the block.
    """
    # None: the handler is not Python's, and cannot be restored.
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is None:
        yield
        return
    waiting: list[tuple[Any, ...]] = []

    def defer(*heard: Any) -> None:
        waiting.append(heard)
        notify()

    before = signal.signal(signal.SIGINT, defer)
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
