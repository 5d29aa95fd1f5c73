"""Keeps Ctrl-C out of what must not be left half done."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any


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
