"""Clock of the motion path: time, and waiting for connections."""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final, Protocol

_SELECT_FILES: Final = 1024  # FD_SETSIZE: `select` takes no higher file numbers


class Clock(Protocol):
    """Source of time. Two implementations exist: `SystemClock`, and the virtual clock of a `VirtualCell`."""

    def now_s(self) -> float:
        """Return the time of a monotonic clock, s."""

    def utc(self) -> datetime:
        """Return the date and time in UTC, for labels only."""

    def sleep(self, duration_s: float) -> None:
        """Wait for a duration; not at all if it is not positive."""

    def wait(self, readers: Sequence[int], until_s: float, writers: Sequence[int] = ()) -> tuple[list[int], list[int]]:
        """Wait until a connection can be read or written, or until a time.

        Args:
            readers: File numbers of connections to read. The end of a stream can be read, too.
            until_s: Time on this clock; a past time means not to wait.
            writers: File numbers of connections to write.

        Returns:
            Readers and writers that are ready.
        """


class SystemClock:
    """Monotonic clock of the operating system."""

    now_s = staticmethod(time.monotonic)

    def utc(self) -> datetime:
        """See `Clock`."""
        return datetime.now(UTC)

    def sleep(self, duration_s: float) -> None:
        """See `Clock`."""
        if duration_s > 0.0:
            time.sleep(duration_s)

    def wait(self, readers: Sequence[int], until_s: float, writers: Sequence[int] = ()) -> tuple[list[int], list[int]]:
        """See `Clock`. It is exact to microseconds, which `poll` and `epoll` are not."""
        left_s = max(0.0, until_s - time.monotonic())
        if max((*readers, *writers), default=0) >= _SELECT_FILES:
            return _poll(readers, left_s, writers)
        ready = select.select(readers, writers, (), left_s)
        return ready[0], ready[1]


def _poll(readers: Sequence[int], left_s: float, writers: Sequence[int]) -> tuple[list[int], list[int]]:
    """Wait in a program with many open files, to a millisecond."""
    poll = select.poll()
    for number in {*readers, *writers}:
        poll.register(number, select.POLLIN * (number in readers) | select.POLLOUT * (number in writers))
    found = dict(poll.poll(1e3 * left_s))
    return (
        [each for each in readers if found.get(each, 0) & ~select.POLLOUT],
        [each for each in writers if found.get(each, 0) & ~select.POLLIN],
    )
