"""Services of the operating system for the motion path: time, connections, processes and threads.

What moves arms gets them from an argument `system`. A `VirtualCell` gives it virtual ones.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import resource
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np

from ur_core.errors import SettingsError
from ur_core.processes.child_process import LONGER_SLICE_S, SLICE_S, Child, give_way, hasten, shorten_slice
from ur_core.processes.clock import Clock, SystemClock
from ur_core.processes.garbage import GarbageCollector
from ur_core.processes.remote_function import RemoteFunction
from ur_core.processes.transport import Listener, TcpListener, TcpTransport, Transport

T = TypeVar("T")

_STANDARD: Final = 3  # standard input, output and error


class Process(Protocol):
    """Child process."""

    @property
    def pid(self) -> int:
        """Number of the process."""

    @property
    def is_alive(self) -> bool:
        """True while it runs."""

    @property
    def code(self) -> int | None:
        """Exit code; negative: the signal that ended it; None: it runs."""

    def wait(self, within_s: float) -> bool:
        """Wait for its end. Return True if it has ended."""

    def kill(self) -> None:
        """End it at once."""


class Thread(Protocol):
    """Thread of this process."""

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end; in the thread itself, do nothing."""


class Event(Protocol):
    """Flag that threads wait for."""

    def set(self) -> None:
        """Set it."""

    def clear(self) -> None:
        """Reset it."""

    def is_set(self) -> bool:
        """Return True if it is set."""

    def wait(self, timeout: float) -> bool:
        """Wait until it is set or the timeout, s, has passed; return True if it is set."""


class _DaemonThread(threading.Thread):
    """Thread that can be joined from itself, as when the garbage collector runs in it."""

    def join(self, timeout: float | None = None) -> None:
        if self is not threading.current_thread():
            super().join(timeout)


class System:
    """Operating system of this machine, as one process sees it. A `VirtualCell` derives its own."""

    def __init__(self) -> None:
        self.clock: Clock = SystemClock()

    @property
    def control(self) -> Callable[[str], Any] | None:
        """Factory of the control interface of the controller at an address; None: that of `ur_rtde`."""
        return None

    @property
    def pid(self) -> int:
        """Number of this process."""
        return os.getpid()

    def state_folder(self) -> Path:
        """Return the folder of faults and locks of this user: in `$XDG_STATE_HOME`, or `~/.local/state`.

        Raises:
            SettingsError: It cannot be created, or belongs to another user.
        """
        home = os.environ.get("XDG_STATE_HOME", "")
        path = (Path(home) if os.path.isabs(home) else Path.home() / ".local" / "state") / "dual_ur10"
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            if path.stat().st_uid != os.getuid():
                raise SettingsError(
                    f"{path} belongs to another user: faults and locks of cells are kept there. Remove it"
                )
            path.chmod(0o700)
        except OSError as error:
            raise SettingsError(
                f"cannot keep faults and locks of cells in {path}: {error}. Set XDG_STATE_HOME"
            ) from error
        return path

    def connect(self, host: str, port: int, within_s: float, *, quick: bool = False) -> Transport:
        """Connect to a port.

        Args:
            host: Address.
            port: Port number.
            within_s: Longest wait.
            quick: Acknowledge every packet at once; see `TcpTransport`.

        Raises:
            OSError: There is no connection in time.
        """
        return TcpTransport.connect(host, port, within_s, quick=quick)

    def listen(self, host: str, port: int, send_buffer_bytes: int = 0) -> Listener:
        """Listen on a port; see `TcpListener`.

        Raises:
            OSError: The address cannot be listened on.
        """
        return TcpListener(host, port, send_buffer_bytes)

    def channel(self) -> tuple[Transport, Transport]:
        """Return two connected ends, the second of which goes to a child process."""
        return TcpTransport.pair()

    def spawn(
        self,
        function: Callable[..., None],
        *arguments: Any,
        name: str = "",
        channel: Transport | None = None,
        output: Callable[[str], None] | None = None,
    ) -> Process:
        """Start a child process that calls a function of this package.

        Args:
            function: The function. It has a keyword `system`, by default `LOCAL`.
            arguments: Its arguments; they are pickled.
            name: Text that a list of processes shows after the command.
            channel: End of a channel, which becomes the first argument. It is closed here.
            output: Called in a thread with each line that the process prints; see `Child`. None: it prints them.
        """
        if channel is None:
            return Child(function, *arguments, name=name, output=output)
        number = channel.fileno()
        where = function.__module__, function.__qualname__
        try:
            return Child(_with_channel, number, *where, *arguments, files=[number], name=name, output=output)
        finally:
            channel.close()

    def is_running(self, pid: int) -> bool:
        """Return True if a process of this number exists and has not ended."""
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # of another user
            return True
        try:
            os.readlink(f"/proc/{pid}/exe")  # opens no file: see `bar_connections`
        except FileNotFoundError:  # it has ended, and its parent has not collected it yet; or there is no /proc
            return not os.path.lexists("/proc/self/exe")
        except OSError:  # of another user
            return True
        return True

    def killer(self, pid: int) -> Callable[[], None] | None:
        """Return a function that kills a running process and no later one of the same number; None: it has ended."""
        try:
            handle = os.pidfd_open(pid)
        except OSError:
            return None

        def kill() -> None:
            with contextlib.suppress(OSError):  # it has ended
                signal.pidfd_send_signal(handle, signal.SIGKILL)

        return kill

    def is_orphan(self, parent: int) -> bool:
        """Return True if the process that started this one has ended."""
        return os.getppid() != parent

    def end(self) -> None:
        """End this process at once, without clean-up."""
        os._exit(0)

    def ignore_interrupts(self) -> None:
        """Ignore Ctrl-C in this process."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def terminated(self) -> Event:
        """Return an event that is set once this process is asked to terminate (SIGTERM)."""
        event = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: event.set())
        return event

    def dedicate(self, rt_priority: int = 0, *, collect: bool = True, sends: bool = False) -> None:
        """Give this process priority, and freeze the garbage collector so that it does not delay deadlines.

        Args:
            rt_priority: Real-time priority; 0: none.
            collect: Keep collecting what is created later.
            sends: It sends targets to an arm, and interrupts the other processes with deadlines.

        Raises:
            SettingsError: The real-time priority is refused.
        """
        gc.collect()
        gc.freeze()
        if not collect:
            gc.disable()
            np.seterr(all="ignore")
        hasten(rt_priority, SLICE_S if sends else LONGER_SLICE_S)

    def give_way(self) -> None:
        """Give way to all processes that owe something in time."""
        give_way()

    def idle_s(self) -> float | None:
        """Return the time for which processors of this machine have been idle so far, s, added up; None: unknown."""
        try:
            return float(Path("/proc/uptime").read_text().split()[1])
        except OSError:
            return None

    def hurry(self) -> Callable[[], None]:
        """Let the calling thread run soon after it wakes, without more processor time than its share.

        Returns:
            Function that undoes it, for the same thread.
        """
        before_s = shorten_slice(inherited=False)

        def relax() -> None:
            shorten_slice(before_s, inherited=False)

        return relax

    def garbage(self) -> GarbageCollector:
        """Return the garbage collector of a program that moves two arms."""
        return GarbageCollector()

    def bar_connections(self) -> None:
        """Prevent this process from opening files and connections.

        The descriptors of standard input, output and error are taken, and no higher ones are allowed.
        """
        number = 0
        while number < _STANDARD:  # some programs are started without them
            number = os.open(os.devnull, os.O_RDWR)
        os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, (_STANDARD, _STANDARD))

    def thread(self, work: Callable[[], None], name: str) -> Thread:
        """Start a thread that does not keep the process alive."""
        thread = _DaemonThread(target=work, name=name, daemon=True)
        thread.start()
        return thread

    def event(self) -> Event:
        """Return a new event."""
        return threading.Event()

    def lock(self) -> contextlib.AbstractContextManager[Any]:
        """Return a new lock, which may be held while waiting for connections."""
        return threading.Lock()

    def worker(self, name: str) -> Executor:
        """Return an executor of one thread for computations."""
        return ThreadPoolExecutor(1, name)

    def remote(self, function: Callable[..., T], name: str) -> RemoteFunction[T]:
        """Return a function of this package that computes in a child process."""
        return RemoteFunction(function, name)


LOCAL: Final = System()
"""This machine."""


def in_parallel(system: System, works: Sequence[Callable[[], T]]) -> list[T]:
    """Do several things at once in threads, and return their results in order.

    Raises:
        Exception: As one of them raised.
    """
    results: dict[int, T] = {}
    failures: list[Exception] = []

    def run(number: int, work: Callable[[], T]) -> None:
        try:
            results[number] = work()
        except Exception as error:  # raised in the thread of the caller
            failures.append(error)

    threads = [
        system.thread(lambda number=number, work=work: run(number, work), f"part {number}")  # type: ignore[misc]  # defaults bind the loop's values
        for number, work in enumerate(works)
    ]
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return [results[number] for number in range(len(works))]


def _with_channel(number: int, module: str, name: str, *arguments: Any) -> None:
    """Call a function with the inherited end of a channel."""
    getattr(importlib.import_module(module), name)(TcpTransport.of_file(number), *arguments)
