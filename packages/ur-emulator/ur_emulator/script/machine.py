"""Virtual machine that runs a program, one control period at a time."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator
from itertools import islice
from typing import Any, Final, NoReturn

from ur_core.errors import ScriptRuntimeError, SettingsError, URError
from ur_emulator.script.arrays import with_lists
from ur_emulator.script.compiled import Program
from ur_emulator.script.compiler import FILE, MAIN, NAMES
from ur_emulator.script.operations import ARITHMETIC, OPERATIONS
from ur_emulator.script.values import Builtins, kind

log = logging.getLogger(__name__)

Steps = Generator[None, None, Any]

THREADS_MAX: Final = 50
"""Most threads of a program, and most threads started in one control period."""

CALLS_MAX: Final = 100
"""Greatest depth of recursive calls."""

# Errors that a program can cause. Any other exception of a builtin is a bug in that builtin.
_FAULTS: Final = (URError, TypeError, ValueError, ArithmeticError, LookupError, NameError, RecursionError)


class _HaltError(Exception):
    """Raised by the statement `halt`."""


class _KillError(Exception):
    """Raised when a thread kills itself."""


class ScriptThread:
    """Thread of a running program, compared by identity.

    Attributes:
        name: Name in the program's text.
        handle: Number that `run` returns; 0 is the program itself.
        alive: Whether it has not ended.
        depth: Depth of nested recursive calls.
    """

    __slots__ = ("alive", "depth", "handle", "name", "steps")

    def __init__(self, name: str, handle: int, steps: Steps) -> None:
        self.name, self.handle, self.steps = name, handle, steps
        self.alive, self.depth = True, 0


class Machine:
    """Running program.

    In each control period every thread runs once, in order of their start, until it blocks or ends. No other thread
    interrupts it before, so `enter_critical` and `exit_critical` have no effect of their own: others run while a thread
    waits, in a critical section too. UR's client library relies on it, whose program waits for its peers in one. The
    program ends with its main function, together with all of its threads.

    Args:
        program: Program to run.
        builtins: Functions that it calls. A generator function blocks its thread, at each `yield` for the rest of the
            control period. When the generator ends, the thread goes on; when the thread is killed, the generator
            receives GeneratorExit.
        steps_per_tick: Statements that all threads together may run in one control period.

    Raises:
        SettingsError: The builtins do not match those that the program was parsed for, or a number is not positive.

    Attributes:
        program: The program.
        thread: Thread that runs now, or is being killed; None between control periods.
        finished: Whether the program has ended.
    """

    def __init__(self, program: Program, builtins: Builtins, *, steps_per_tick: int) -> None:
        if steps_per_tick < 1:
            raise SettingsError(f"steps_per_tick must be at least 1, found {steps_per_tick}")
        program.check(builtins)
        self.program = program
        self.thread: ScriptThread | None = None
        self.finished = False
        self._steps_per_tick = steps_per_tick
        self._threads: list[ScriptThread] = []
        self._handles = 0
        self._names: dict[str, Any] = {"__builtins__": {}, "n_steps": steps_per_tick}
        self._names.update({f"b_{name}": builtins[name] for name in program.used})
        self._names.update({NAMES[word]: operation for word, operation in OPERATIONS.items()})
        self._names.update({NAMES[word]: with_lists(word, OPERATIONS[word], self.spend) for word in ARITHMETIC})
        self._names.update(
            n_run=self._run,
            n_kill=self._kill_handle,
            n_join=self._join,
            n_halt=_halt,
            n_endless=self._endless,
            n_deeper=self._deeper,
            n_shallower=self._shallower,
        )
        exec(program.code, self._names)
        self._threads.append(ScriptThread(program.name, 0, self._names[MAIN]()))

    def tick(self) -> None:
        """Run one control period. A finished program does nothing.

        Raises:
            ScriptRuntimeError: The program failed, and has finished.
        """
        self._names["n_steps"] = self._steps_per_tick
        ended = False
        # Threads that start meanwhile are appended, and run too.
        for thread in self._threads:
            if self.finished:
                break
            if thread.alive:
                self._resume(thread)
            ended = ended or not thread.alive
        if ended:
            self._threads = [thread for thread in self._threads if thread.alive]

    def spend(self, steps: int) -> None:
        """Charge a costly function with so many statements of this control period.

        Raises:
            RecursionError: The control period has fewer left.
        """
        self._names["n_steps"] -= steps
        if self._names["n_steps"] < 0:
            self._endless()

    def kill(self) -> None:
        """End the program and all of its threads."""
        self.finished = True
        for thread in self._threads:
            self._end(thread)

    def _resume(self, thread: ScriptThread) -> None:
        self.thread = thread
        try:
            thread.steps.send(None)
        except (StopIteration, _KillError):
            self.thread = None
            self._end(thread)
            self.finished = self.finished or thread.handle == 0
        except _HaltError:
            self.finished = True
        except ScriptRuntimeError:
            self.finished = True
            raise
        except Exception as error:
            if not isinstance(error, _FAULTS):
                log.exception("a builtin of the program failed")
            self.finished = True
            raise self._located(error) or ScriptRuntimeError(1, thread.name, str(error)) from error
        finally:
            self.thread = None
            if self.finished:
                self.kill()

    def _end(self, thread: ScriptThread) -> None:
        """End a thread. The thread that runs ends when it returns."""
        running = self.thread
        if thread is running:
            return
        thread.alive = False
        self.thread = thread
        try:
            thread.steps.close()
        finally:
            self.thread = running

    def _run(self, function: Callable[..., Steps], /, *arguments: Any, **keywords: Any) -> int:
        # Threads that ended in this control period count too, so that threads that start each other and end at once
        # cannot go on forever.
        if len(self._threads) >= THREADS_MAX:
            raise RecursionError(f"a program has at most {THREADS_MAX} threads, also of those started in one period")
        self._handles += 1
        self._threads.append(ScriptThread(function.__name__[2:], self._handles, function(*arguments, **keywords)))
        return self._handles

    def _find(self, handle: object) -> ScriptThread | None:
        """Return the live thread of a handle; None for 0 and for a thread that has ended."""
        if not isinstance(handle, int) or not 0 <= handle <= self._handles:
            raise ValueError(f"a thread's handle is the result of run, or 0: found {kind(handle)} ({handle})")
        for thread in self._threads:
            if handle and thread.handle == handle and thread.alive:
                return thread
        return None

    def _kill_handle(self, handle: object) -> None:
        thread = self._find(handle)
        if thread is None:
            return
        if thread is self.thread:
            raise _KillError
        self._end(thread)

    def _join(self, handle: object) -> Steps:
        thread = self._find(handle)
        if thread is not None and thread is self.thread:
            raise ValueError("a thread cannot wait for its own end")
        while thread is not None and thread.alive:
            yield

    def _endless(self) -> NoReturn:
        raise RecursionError(
            f"infinite loop: more than {self._steps_per_tick} statements in one control period (is a sync() missing?)"
        )

    def _deeper(self) -> None:
        thread = self.thread
        if thread is not None:
            if thread.depth >= CALLS_MAX:
                raise RecursionError(f"functions call themselves more than {CALLS_MAX} deep")
            thread.depth += 1

    def _shallower(self) -> None:
        if self.thread is not None:
            self.thread.depth -= 1

    def _located(self, error: BaseException) -> ScriptRuntimeError | None:
        """Return the error with line and word of the program, or None if the program was not running."""
        found = None
        trace = error.__traceback__
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == FILE:
                found = trace
            last, trace = trace, trace.tb_next
        if found is None:
            return None
        positions = islice(found.tb_frame.f_code.co_positions(), found.tb_lasti // 2, None)
        line, _, start, end = next(positions)
        word = self.program.lines[(line or 1) - 1][start:end]
        reason = str(error)
        if isinstance(error, NameError) and found is last:
            reason = "it has no value yet: nothing was assigned, or defined, so far"
        elif isinstance(error, ZeroDivisionError):
            reason = "division by zero"
        return ScriptRuntimeError(line or 1, word, reason or type(error).__name__, (start or 0) + 1)


def _halt() -> NoReturn:
    raise _HaltError


def machine_functions(tick_s: float) -> dict[str, Callable[..., Any]]:
    """Return `sync` and `sleep`, for control periods of `tick_s`."""

    def sync() -> Steps:
        yield

    def sleep(t: float) -> Steps:
        if not 0 <= t <= 1e9:
            raise ValueError(f"sleep takes 0 to 1e9 s, found {t}")
        # With a tolerance of a millionth of a period, 0.1 s is 50 periods of 2 ms.
        for _ in range(math.ceil(t / tick_s - 1e-6)):
            yield

    return {"sync": sync, "sleep": sleep}
