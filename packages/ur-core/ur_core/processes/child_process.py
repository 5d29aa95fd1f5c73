"""Child processes that run a function of this package, and their scheduling priority.

Unlike those of `multiprocessing`, they do not import the main module of the program that starts them. So they work from
a script without a guard, from a notebook and from a terminal. They are in sessions of their own, so that Ctrl-C reaches
the program alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import logging
import os
import pickle
import platform
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from ur_core.errors import SettingsError
from ur_core.processes.interrupts import CHILD, interrupts_deferred

log = logging.getLogger(__name__)

LOST: Final = 255
"""Exit code of a process whose end somebody else has collected."""

KILLED_S: Final = 5.0
"""Longest wait for the end of a killed process: one that waits for a device may take its time."""

NICE: Final = -15
"""Niceness of a process with deadlines. The system may deny it to users; then the process keeps its own."""

SLICE_S: Final = 1e-4
"""Time slice of a process that sends targets, the shortest that Linux takes. Any user may ask for it."""

YIELDING: Final = 5
"""Niceness of a process that owes nothing in time."""

LONGER_SLICE_S: Final = 1e-3
"""Time slice of other processes with deadlines, which a process that sends targets interrupts when it wakes."""

_POLL_S: Final = 0.002
_DRAIN_S: Final = 0.2  # for the lines that an ended process printed
_AUTOGROUP: Final = "/proc/self/autogroup"
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274}  # numbers of the system call, which libc does not wrap
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30  # prctl(2)
_RESET_ON_FORK: Final = 1
_RESETS: Final = 0x40000000  # the same as part of a policy
_SCHED_ATTR: Final = struct.Struct("IIQiIQQQ")  # sched_setattr(2): size, policy, flags, nice, priority, slice in ns, ..


def hasten(rt_priority: int = 0, slice_s: float = LONGER_SLICE_S) -> None:
    """Give the calling thread, and those that it starts, priority over other processes.

    Niceness compares processes of one session only where Linux groups processes by session. There the session gets it,
    too, unless it is that of a terminal. A thread with a short time slice need not wait until the one that runs has
    used up its own, typically 3 ms; kernels before Linux 6.12 ignore that.

    Args:
        rt_priority: Real-time priority; 0: only niceness and time slice, where the system allows them.
        slice_s: Time slice, s.

    Raises:
        SettingsError: A real-time priority is wanted, and the system refuses it.
    """
    if not rt_priority:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, NICE)
        if os.getsid(0) == os.getpid():
            with contextlib.suppress(OSError):
                Path(_AUTOGROUP).write_text(str(NICE))
        shorten_slice(slice_s, inherited=True)
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(rt_priority))
    except OSError as error:
        reason = f"rt_priority {rt_priority} was refused by the system ({error})"
        raise SettingsError(f"{reason}: allow it (rtprio in limits.conf), or set it to 0") from error


def give_way() -> None:
    """Give way to all processes that owe something in time."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, YIELDING)
    with contextlib.suppress(OSError):
        Path(_AUTOGROUP).write_text(str(YIELDING))


def shorten_slice(slice_s: float = LONGER_SLICE_S, *, inherited: bool) -> float:
    """Ask for a short time slice for the calling thread. A refusal changes nothing.

    Args:
        slice_s: Time slice, s; 0: the system's ordinary one.
        inherited: Threads and processes that it starts from now on get it, too. Otherwise they begin with the
            system's ordinary scheduling.

    Returns:
        Time slice of before, s; 0: unknown.
    """
    number, before_ns = _SCHED_SETATTR.get(platform.machine()), 0
    if sys.platform == "linux" and number is not None and os.sched_getscheduler(0) & ~_RESETS == os.SCHED_OTHER:
        call, found = ctypes.CDLL(None).syscall, ctypes.create_string_buffer(_SCHED_ATTR.size)
        if call(number + 1, 0, found, _SCHED_ATTR.size, 0) == 0:  # sched_getattr
            before_ns = _SCHED_ATTR.unpack(found)[5]
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        flags = 0 if inherited else _RESET_ON_FORK
        slice_ns = round(1e9 * slice_s)
        attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, flags, nice, 0, slice_ns, 0, 0)
        call(number, 0, attributes, 0)
    return 1e-9 * before_ns


@contextlib.contextmanager
def patient_threads(slack_s: float) -> Iterator[None]:
    """Let threads that start meanwhile sleep up to `slack_s` longer than they ask for, whenever another one wakes.

    Threads of a library that poll cost less so. Threads with a real-time priority sleep exactly.
    """
    if sys.platform != "linux":
        yield
        return
    call = ctypes.CDLL(None).prctl
    before_ns = call(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    call(_PR_SET_TIMERSLACK, ctypes.c_ulong(round(1e9 * slack_s)), 0, 0, 0)
    try:
        yield
    finally:
        call(_PR_SET_TIMERSLACK, ctypes.c_ulong(before_ns), 0, 0, 0)


class Child:
    """Process that runs one function, and ends with it.

    Its end can be queried at any time, however often a query is interrupted. `Popen.poll` and `Popen.wait` cannot: an
    interrupt leaves their lock taken, and the next query waits forever.

    Args:
        function: Function of this package.
        arguments: Its arguments; they are pickled.
        files: Numbers of open files that the process inherits under the same numbers.
        name: Text that a list of processes shows after the command.
        output: Called in a thread with each line that the process, or a library in it, prints. What is not read in
            time is lost, and never blocks the process. None: the process shares standard output and error.
    """

    def __init__(
        self,
        function: Callable[..., None],
        *arguments: Any,
        files: Sequence[int] = (),
        name: str = "",
        output: Callable[[str], None] | None = None,
    ) -> None:
        work = pickle.dumps((function.__module__, function.__qualname__, os.getpid(), arguments))
        self._code: int | None = None
        self._reader: threading.Thread | None = None
        process = None
        reading, writing = (None, None) if output is None else os.pipe()
        if writing is not None:
            os.set_blocking(writing, False)
        try:
            with interrupts_deferred():  # an interrupt comes before there is a process, or once it is known here
                self._process = process = subprocess.Popen(
                    [sys.executable, "-P", "-m", CHILD, *filter(None, [name])],
                    stdin=subprocess.PIPE,
                    stdout=writing,
                    stderr=writing,
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(each or os.getcwd() for each in sys.path)},
                    start_new_session=True,
                    pass_fds=tuple(files),
                )
            if output is not None and reading is not None:
                self._reader = threading.Thread(target=_read_lines, args=(reading, output), name="output", daemon=True)
                self._reader.start()
                reading = None
            if process.stdin is not None:
                with contextlib.suppress(OSError):  # it has ended already, which `is_alive` reports
                    process.stdin.write(work)
                    process.stdin.close()
        except BaseException:
            if process is not None:
                self.kill()
            raise
        finally:
            for each in (reading, writing):
                if each is not None:
                    os.close(each)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """True while it runs."""
        return self.code is None

    @property
    def code(self) -> int | None:
        """Exit code; negative: the signal that ended it; None: it runs."""
        if self._code is None:
            try:
                found = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:
                self._code = LOST
            else:
                if found is None:
                    return None
                self._code = found.si_status if found.si_code == os.CLD_EXITED else -found.si_status
        if self._process.returncode is None:  # stored first, then collected from the system, so that nothing is lost
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, os.WNOHANG)
            self._process.returncode = self._code
        return self._code

    def wait(self, within_s: float) -> bool:
        """Wait for its end. Return True if it has ended."""
        end = time.monotonic() + within_s
        while self.is_alive:
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            time.sleep(min(left, _POLL_S))
        if self._reader is not None:
            self._reader.join(_DRAIN_S)  # what it printed last
        return True

    def kill(self, within_s: float = KILLED_S) -> None:
        """End it at once, and wait for that for a bounded time."""
        if self.is_alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        if not self.wait(within_s):
            log.error("process %d was killed and has not ended within %g s: see what it waits for", self.pid, within_s)


def _read_lines(file: int, output: Callable[[str], None]) -> None:
    """Pass the lines of a pipe on until its end."""
    with os.fdopen(file, "rb") as pipe:
        for line in pipe:
            output(line.decode("utf-8", "replace").rstrip("\r\n"))


def main() -> None:
    """Run the function that the parent process sends by standard input."""
    work = sys.stdin.buffer.read()
    if not work:
        return  # the parent has ended before it could send it
    module, name, parent, arguments = pickle.loads(work)
    if os.getppid() != parent:
        return  # the parent has ended meanwhile
    getattr(importlib.import_module(module), name)(*arguments)


if __name__ == "__main__":
    main()
