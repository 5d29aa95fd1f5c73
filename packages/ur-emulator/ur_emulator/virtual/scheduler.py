"""Scheduler of actors on a virtual clock: exactly one runs at a time, and time passes only while all wait.

An actor is a greenlet that runs unchanged code of the motion path. The next one to run is the one that is due first,
by time and then by the number of the actor, so that a run is the same to the bit every time.
"""

from __future__ import annotations

import heapq
import logging
import math
import threading
from collections.abc import Callable, Container, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from ur_core.errors import MissingExtraError, VirtualCellError
from ur_core.processes.interrupts import interrupts_deferred

try:
    from greenlet import GreenletExit as GreenletExit
    from greenlet import getcurrent, greenlet
except ImportError:
    raise MissingExtraError("greenlet", "virtual", "a virtual clock", distribution="ur-emulator") from None

log = logging.getLogger(__name__)

BEGIN_S: Final = 1000.0
"""Time of the clock at its start: not zero, which stands for "never" in shared memories."""

_EPOCH: Final = datetime(2026, 1, 1, tzinfo=UTC)
_MOST_TURNS: Final = 100_000  # of actors without any passing of time: they wait for each other in a busy loop


class Endpoint:
    """End of a connection in memory, as the scheduler sees it.

    Attributes:
        number: File number.
    """

    readable = False
    writable = False

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self.number = scheduler.new_file(self)

    def fileno(self) -> int:
        """Return the file number for `Clock.wait`."""
        return self.number

    def note(self) -> None:
        """Tell the scheduler whether it can be read, and wake the actors that wait for it."""
        self.update()
        self._scheduler.notify(self.number)

    def update(self) -> None:
        """Tell the scheduler whether it can be read."""
        scheduler, number = self._scheduler, self.number
        if self.readable or number not in scheduler.files:
            scheduler.readable.add(number)
        else:
            scheduler.readable.discard(number)


class Group:
    """Actors that stall and end together: the threads of a process.

    Attributes:
        name: Name for messages.
        stalled_until_s: None of its actors runs before this time.
        ended: True once it was killed or has ended.
        endpoints: Ends of connections that are closed with it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.stalled_until_s = -math.inf
        self.ended = False
        self.endpoints: list[Any] = []
        self.actors: list[Actor] = []


class Actor:
    """Thread of execution.

    Attributes:
        number: Order among actors that are due at the same time.
        group: Its process.
        ended: True after its end.
    """

    def __init__(self, number: int, group: Group, name: str) -> None:
        self.number, self.group, self.name = number, group, name
        self.ended = self.killed = False
        self.ticket = 0  # of the entry in the queue that is valid
        self.due_s = math.inf
        self.greenlet: Any = None
        self.joiners: list[Actor] = []
        group.actors.append(self)


class Scheduler:
    """Queue of actors, and their time.

    The program that makes it is the first actor; it must use it from one thread.

    Attributes:
        now_s: Time, s.
        current: Actor that runs.
        files: Ends of connections by file number.
        readable: Numbers of those that can be read, or were closed.
        waiting: File numbers that actors wait for, to read and to write.
        failures: Actors that ended with an error.
    """

    def __init__(self) -> None:
        self.now_s = BEGIN_S
        self.program = Group("program")
        self._thread = threading.get_ident()
        self._queue: list[tuple[float, int, int, Actor]] = []
        self.files: dict[int, Endpoint] = {}
        self.readable: set[int] = set()
        self.waiting: dict[Actor, tuple[Container[int], Container[int]]] = {}
        self._count = 0
        self._turns = 0
        self._main = Actor(0, self.program, "program")
        self._main.greenlet = getcurrent()
        self._actors = 1
        self.current = self._main
        self.failures: list[tuple[str, BaseException]] = []

    def new_file(self, endpoint: Endpoint) -> int:
        """Return a file number for an end of a connection."""
        self._count += 1
        self.files[self._count] = endpoint
        return self._count

    def forget_file(self, number: int) -> None:
        """Release a file number."""
        self.files.pop(number, None)
        self.readable.add(number)

    # Actors.

    def start(self, work: Callable[[], None], group: Group, name: str) -> Actor:
        """Start an actor; it first runs when the present one waits."""
        actor = Actor(self._actors, group, name)
        self._actors += 1

        def run(*_: object) -> None:  # the result of an actor that ended, if this one is next
            try:
                work()
            except GreenletExit:
                pass
            except Exception as error:
                log.exception("%s: it ended with an error", name)
                self.failures.append((name, error))
            except BaseException:  # such as an exit, for the program
                actor.killed = True
                self._end(actor)
                self.current = self._main
                raise
            self._end(actor)

        actor.greenlet = greenlet(run, self._main.greenlet)
        self._wake(actor, self.now_s)
        return actor

    def _end(self, actor: Actor) -> None:
        actor.ended = True
        actor.group.actors.remove(actor)
        for joiner in actor.joiners:
            self._wake(joiner, self.now_s)
        if not actor.killed:
            self.current = self._next()
            actor.greenlet.parent = self.current.greenlet  # which runs once this greenlet returns

    def kill(self, group: Group) -> None:
        """End all actors of a process where they wait, as SIGKILL does. The present actor goes on until it waits."""
        group.ended = True
        for actor in list(group.actors):
            if actor is self.current:
                continue
            actor.killed = True
            if not actor.greenlet:  # it has not started
                self._end(actor)
                continue
            killer, self.current = self.current, actor
            actor.greenlet.parent = killer.greenlet
            actor.greenlet.throw(GreenletExit)
            self.current = killer

    def join(self, actor: Actor, until_s: float) -> None:
        """Wait for the end of an actor."""
        if actor is self.current:
            return
        while not actor.ended and self.now_s < until_s:
            actor.joiners.append(self.current)
            self._switch(until_s)

    # Waiting.

    def _wake(self, actor: Actor, at_s: float) -> None:
        if at_s < actor.due_s:
            actor.due_s = at_s
            actor.ticket += 1
            heapq.heappush(self._queue, (max(at_s, self.now_s), actor.number, actor.ticket, actor))

    def notify(self, number: int) -> None:
        """Wake the actors that wait for a file number."""
        for actor, (readers, writers) in self.waiting.items():
            if number in readers or number in writers:
                self._wake(actor, self.now_s)

    def notify_readers(self, number: int) -> None:
        """Wake the actors that wait for a file number to read it."""
        for actor, (readers, _) in self.waiting.items():
            if number in readers:
                self._wake(actor, self.now_s)

    def notify_writers(self, number: int) -> None:
        """Wake the actors that wait for a file number to write it."""
        for actor, (_, writers) in self.waiting.items():
            if number in writers:
                self._wake(actor, self.now_s)

    def wait(self, until_s: float) -> None:
        """Wait until a time, or until the actor is notified."""
        if until_s > self.now_s:
            self._switch(until_s)
        else:
            self.go_on()

    def go_on(self) -> None:
        """Let the present actor go on, without any passing of time."""
        if self.current.group.ended:
            raise GreenletExit
        self._count_turn(self.current)

    def _switch(self, until_s: float) -> None:
        actor = self.current
        if threading.get_ident() != self._thread:
            raise VirtualCellError(
                "a virtual cell is used from another thread than the one that made it: its actors take turns in one "
                "thread. Use it there"
            )
        if actor.group.ended:
            raise GreenletExit
        actor.due_s, actor.ticket = until_s, actor.ticket + 1
        if until_s < math.inf:
            heapq.heappush(self._queue, (until_s, actor.number, actor.ticket, actor))
        following = self._next()
        if following is not actor:
            self.current = following
            if actor is self._main:
                # Ctrl-C is for the program: it must not end whichever actor computes just then.
                with interrupts_deferred(lambda: self._wake(actor, self.now_s)):
                    following.greenlet.switch()
            else:
                following.greenlet.switch()
        actor.due_s = math.inf
        actor.ticket += 1
        if actor.group.ended:
            raise GreenletExit

    def _next(self) -> Actor:
        while self._queue:
            at_s, _, ticket, actor = heapq.heappop(self._queue)
            if actor.ended or ticket != actor.ticket:
                continue
            if actor.group.stalled_until_s > at_s:
                heapq.heappush(self._queue, (actor.group.stalled_until_s, actor.number, ticket, actor))
                continue
            if at_s > self.now_s:
                self.now_s, self._turns = at_s, 0
            return self._count_turn(actor)
        return self._fail("all actors wait for ever: nothing would ever wake one of them")

    def _count_turn(self, actor: Actor) -> Actor:
        self._turns += 1
        if self._turns > _MOST_TURNS:
            return self._fail(
                f"{_MOST_TURNS} turns of actors without any passing of time, the last of {actor.name}: they wait "
                "without sleeping"
            )
        return actor

    def _fail(self, text: str) -> Actor:
        """Raise an error in the program, which must learn of it whichever actor runs."""
        error = VirtualCellError(text)
        if self.current is self._main:
            raise error
        self.current = self._main
        self._main.greenlet.throw(error)
        raise GreenletExit  # the cell is closed now


class VirtualClock:
    """Clock of one process on a scheduler."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler

    def now_s(self) -> float:
        """See `Clock`."""
        return self._scheduler.now_s

    def utc(self) -> datetime:
        """See `Clock`. It begins with the year 2026 in every virtual cell."""
        return _EPOCH + timedelta(seconds=self._scheduler.now_s - BEGIN_S)

    def sleep(self, duration_s: float) -> None:
        """See `Clock`."""
        self._scheduler.wait(self._scheduler.now_s + duration_s)

    def wait(self, readers: Sequence[int], until_s: float, writers: Sequence[int] = ()) -> tuple[list[int], list[int]]:
        """See `Clock`."""
        scheduler = self._scheduler
        ready = _ready(scheduler, readers, writers)
        if until_s <= scheduler.now_s or ready[0] or ready[1]:
            scheduler.go_on()
            return ready
        actor = scheduler.current
        scheduler.waiting[actor] = readers, writers
        try:
            scheduler.wait(until_s)
        finally:
            scheduler.waiting.pop(actor, None)
        return _ready(scheduler, readers, writers)


def _ready(scheduler: Scheduler, readers: Sequence[int], writers: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the readers and writers that are ready; a closed one is."""
    files, readable = scheduler.files, scheduler.readable
    return (
        [] if readable.isdisjoint(readers) else [each for each in readers if each in readable],
        [each for each in writers if each not in files or files[each].writable] if writers else [],
    )


class VirtualEvent:
    """See `ur_core.processes.system.Event`."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._flag = False
        self._waiting: list[Actor] = []

    def set(self) -> None:
        """Set it."""
        self._flag = True
        waiting, self._waiting = self._waiting, []
        for actor in waiting:
            self._scheduler._wake(actor, self._scheduler.now_s)

    def clear(self) -> None:
        """Reset it."""
        self._flag = False

    def is_set(self) -> bool:
        """Return True if it is set."""
        return self._flag

    def wait(self, timeout: float) -> bool:
        """Wait until it is set or the timeout, s, has passed."""
        if not self._flag:
            actor = self._scheduler.current
            self._waiting.append(actor)
            self._scheduler.wait(self._scheduler.now_s + timeout)
            if actor in self._waiting:
                self._waiting.remove(actor)
        return self._flag


class VirtualLock:
    """Lock that actors may hold while they wait."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._held = False
        self._waiting: list[Actor] = []

    def __enter__(self) -> None:
        while self._held:
            self._waiting.append(self._scheduler.current)
            self._scheduler._switch(math.inf)
        self._held = True

    def __exit__(self, *_: object) -> None:
        self._held = False
        waiting, self._waiting = self._waiting, []
        for actor in waiting:
            self._scheduler._wake(actor, self._scheduler.now_s)
