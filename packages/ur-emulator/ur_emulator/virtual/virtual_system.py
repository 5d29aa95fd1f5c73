"""Operating system of the processes of a virtual cell."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final, TypeVar

from ur_core.errors import VirtualCellError
from ur_core.processes.garbage import GarbageCollector, NoGarbageCollector
from ur_core.processes.remote_function import RemoteFunction
from ur_core.processes.system import System
from ur_core.processes.transport import Listener, Transport
from ur_emulator.virtual.network import MemoryTransport, VirtualNetwork
from ur_emulator.virtual.scheduler import (
    Actor,
    GreenletExit,
    Group,
    Scheduler,
    VirtualClock,
    VirtualEvent,
    VirtualLock,
)

T = TypeVar("T")

KILLED: Final = -9
"""Exit code of a killed process."""


class VirtualThread:
    """Thread of a virtual process."""

    def __init__(self, scheduler: Scheduler, actor: Actor) -> None:
        self._scheduler, self._actor = scheduler, actor

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end; in the thread itself, do nothing."""
        self._scheduler.join(self._actor, math.inf if timeout is None else self._scheduler.now_s + timeout)


class VirtualProcess:
    """Process of a virtual cell: its threads, and what it has open.

    Args:
        world: All processes.
        parent: Process that starts it.
        name: Name for messages.
    """

    def __init__(self, world: World, parent: VirtualProcess | None, name: str, group: Group | None = None) -> None:
        self.world, self.parent, self.name = world, parent, name
        self.pid = next(world.pids)
        self.group = group or Group(name)
        self.code: int | None = None
        world.processes[self.pid] = self

    @property
    def is_alive(self) -> bool:
        """True while it runs."""
        return self.code is None

    def wait(self, within_s: float) -> bool:
        """Wait for its end. Return True if it has ended."""
        scheduler = self.world.scheduler
        until_s = scheduler.now_s + within_s
        while self.is_alive and self.group.actors and scheduler.now_s < until_s:
            scheduler.join(self.group.actors[0], until_s)
        return not self.is_alive

    def kill(self) -> None:
        """End it at once."""
        self.finish(KILLED)

    def finish(self, code: int) -> None:
        """End its threads, and close what it has open."""
        if not self.is_alive:
            return
        self.code = code
        self.world.processes.pop(self.pid, None)
        for endpoint in self.group.endpoints:
            endpoint.close()
        self.group.endpoints.clear()
        self.world.scheduler.kill(self.group)

    def stall(self, duration_s: float) -> None:
        """Keep its threads from running for a duration, as a busy machine does."""
        self.group.stalled_until_s = self.world.scheduler.now_s + duration_s


class World:
    """All running processes of a virtual cell by their numbers, and their network."""

    def __init__(self) -> None:
        self.scheduler = Scheduler()
        self.network = VirtualNetwork(self.scheduler)
        self.pids = itertools.count(1)
        self.processes: dict[int, VirtualProcess] = {}


class _Inline(Executor):
    """Executor that computes at once: computations take no virtual time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function, and return its result as a future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _InlineFunction(RemoteFunction[T]):
    """Function that computes at once, in the process that calls it."""

    def __call__(self, *arguments: Any) -> T:
        return self.function(*arguments)

    def prepare(self) -> None:
        """Do nothing: there is no process."""


class VirtualSystem(System):
    """Operating system of a virtual process. It leaves nothing to that of this machine.

    Args:
        process: Process that sees this system.
        folder: State folder of faults and locks.
        control: Factory of the control interface of a controller on a system.
    """

    def __init__(
        self, process: VirtualProcess, folder: Path, control: Callable[[str, VirtualSystem], Any] | None = None
    ) -> None:
        self._process, self._folder, self._control = process, folder, control
        self._world = process.world
        self.clock = VirtualClock(self._world.scheduler)

    @property
    def pid(self) -> int:
        """See `System`."""
        return self._process.pid

    @property
    def control(self) -> Callable[[str], Any] | None:
        """See `System`."""
        make = self._control
        return None if make is None else lambda host: make(host, self)

    def state_folder(self) -> Path:
        """See `System`."""
        return self._folder

    def connect(self, host: str, port: int, within_s: float, *, quick: bool = False) -> Transport:
        """See `System`. A connection is made at once."""
        return self._world.network.connect(host, port, self._process.group)

    def listen(self, host: str, port: int, send_buffer_bytes: int = 0) -> Listener:
        """See `System`."""
        return self._world.network.listen(host, port, self._process.group, send_buffer_bytes)

    def channel(self) -> tuple[Transport, Transport]:
        """See `System`."""
        first, second = MemoryTransport(self._world.scheduler), MemoryTransport(self._world.scheduler)
        first.join(second)
        self._process.group.endpoints.append(first)
        return first, second

    def spawn(
        self,
        function: Callable[..., None],
        *arguments: Any,
        name: str = "",
        channel: Transport | None = None,
        output: Callable[[str], None] | None = None,
    ) -> VirtualProcess:
        """See `System`. A virtual process prints where the program does."""
        process = VirtualProcess(self._world, self._process, name or function.__name__)
        if channel is not None:
            process.group.endpoints.append(channel)
            arguments = (channel, *arguments)
        system = VirtualSystem(process, self._folder, self._control)

        def run() -> None:
            code = 1
            try:
                function(*arguments, system=system)
                code = 0
            except _EndOfProcess:
                code = 0
            finally:
                process.finish(code)

        self._world.scheduler.start(run, process.group, process.name)
        return process

    def is_running(self, pid: int) -> bool:
        """See `System`."""
        return pid in self._world.processes

    def killer(self, pid: int) -> Callable[[], None] | None:
        """See `System`."""
        process = self._world.processes.get(pid)
        return None if process is None else process.kill

    def is_orphan(self, parent: int) -> bool:
        """See `System`."""
        return parent not in self._world.processes

    def end(self) -> None:
        """See `System`."""
        raise _EndOfProcess

    def ignore_interrupts(self) -> None:
        """Do nothing: Ctrl-C reaches the program alone."""

    def terminated(self) -> VirtualEvent:
        """Return an event that is never set: a virtual process is not asked to terminate."""
        return VirtualEvent(self._world.scheduler)

    def dedicate(self, rt_priority: int = 0, *, collect: bool = True, sends: bool = False) -> None:
        """Do nothing: nothing delays a virtual process but what a test asks for.

        Raises:
            VirtualCellError: A real-time priority is wanted.
        """
        if rt_priority:
            raise VirtualCellError(
                f"rt_priority is {rt_priority}: a virtual cell has no scheduling priorities. Set it to 0, or use an "
                "emulated cell"
            )

    def give_way(self) -> None:
        """Do nothing: virtual processes take turns."""

    def idle_s(self) -> float | None:
        """Return None: a virtual cell takes as long as it takes."""
        return None

    def hurry(self) -> Callable[[], None]:
        """Do nothing: a virtual process runs whenever it is due."""
        return lambda: None

    def garbage(self) -> GarbageCollector:
        """See `System`."""
        return NoGarbageCollector()

    def bar_connections(self) -> None:
        """Do nothing: the control interface of a virtual cell never reconnects."""

    def thread(self, work: Callable[[], None], name: str) -> VirtualThread:
        """See `System`."""
        return VirtualThread(self._world.scheduler, self._world.scheduler.start(work, self._process.group, name))

    def event(self) -> VirtualEvent:
        """See `System`."""
        return VirtualEvent(self._world.scheduler)

    def lock(self) -> VirtualLock:
        """See `System`."""
        return VirtualLock(self._world.scheduler)

    def worker(self, name: str) -> Executor:
        """See `System`."""
        return _Inline()

    def remote(self, function: Callable[..., T], name: str) -> RemoteFunction[T]:
        """See `System`."""
        return _InlineFunction(function, name)


class _EndOfProcess(GreenletExit):  # type: ignore[misc]  # greenlet has no types
    """End of a process at its own request."""
