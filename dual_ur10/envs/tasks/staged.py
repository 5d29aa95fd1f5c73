"""Base of tasks that go through stages: conditions, reward terms, order, settling and end."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.tasks.geometry import Number
from dual_ur10.envs.tasks.task import FINISH, MeasuredT, Outcome, SettingsT, Task, Timing
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell.cell import CellState
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.types import Array, Mask, Rows

NowT = TypeVar("NowT")
CaseT = TypeVar("CaseT", bound=tuple[Any, ...])
DecisionT = TypeVar("DecisionT", bound=tuple[Any, ...])
Progress = Number | tuple[Number, Number]
"""Progress towards passing a stage: of both roles, or of the first and the second one."""

StageMethod = Callable[[Any, Any], tuple[Number, Progress]]
TermMethod = Callable[[Any, Any], Progress]


class _Stage(NamedTuple):
    """Stage of a task, as its method is decorated.

    Attributes:
        weight: Weight of its reward term.
        earned: Largest value of the term for each role.
        early: Roles that earn progress before the stage begins.
        load_kg: Mass that the gripper of each role carries at this stage; None: none is declared.
        coupled: Both arms hold one object at this stage.
    """

    weight: float
    earned: tuple[float, float]
    early: tuple[bool, bool]
    load_kg: tuple[float, float] | None
    coupled: bool


def stage(
    weight: float,
    earned: tuple[float, float] = (1.0, 1.0),
    early: tuple[bool, bool] = (False, False),
    load_kg: tuple[float, float] | None = None,
    coupled: bool = False,
) -> Callable[[StageMethod], StageMethod]:
    """Make a method of a `StagedTask` its next stage, and its name that of a reward term.

    The method gets what `StagedTask.facts` returns: arrays, or plain numbers of one cell if the task prefers them. It
    returns a mask, (n,), of the rows in which the stage is passed now, and the progress towards that, 0 to 1: (n,) for
    the first and for the second role, or one for both. It must keep no state: rows that are not at this stage are
    evaluated, too, or not at all.

    Args:
        weight: Weight of the reward term.
        earned: Value of the term of each role once the stage is passed, and factor of its progress until then.
        early: Roles that earn progress from the first step on, and not only once the stage before is passed.
        load_kg: Mass that the gripper of each role carries from when the stage before is passed until this one is; it
            is declared to simulated controllers, with a ramp. None: nothing; and nothing is declared if no stage has a
            load. That of the last stage counts until the episode ends.
        coupled: Both arms hold one object in that time; see `Task.coupled`.
    """

    def mark(method: StageMethod) -> StageMethod:
        method.stage = _Stage(weight, earned, early, load_kg, coupled)  # type: ignore[attr-defined]
        return method

    return mark


def term(weight: float) -> Callable[[TermMethod], TermMethod]:
    """Make a method of a `StagedTask` a reward term of its name, on which no stage depends.

    The method gets what `StagedTask.facts` returns, in each step, after the stages are evaluated. It returns the value
    of the term, 0 to 1: (n,) for the first and for the second role, or one for both.

    Args:
        weight: Weight of the reward term.
    """

    def mark(method: TermMethod) -> TermMethod:
        method.term_weight = weight  # type: ignore[attr-defined]
        return method

    return mark


class StagedTask(Task[SettingsT, MeasuredT], Generic[SettingsT, MeasuredT, NowT]):
    """Task whose episodes pass stages in their order; several are passed at once if their conditions hold.

    A subclass decorates one method per stage with `stage`, in order. Each is a reward term: its largest value once the
    stage is passed, which is never lost, and progress while it is the next one. Methods decorated with `term` are
    further terms. The term `FINISH` replaces the reward of the steps that success spares. `info["stage"]` is the number
    of stages passed.

    An arm has a role: first or second. Without `begin_rows(rows, first)` the left arm is first.

    Attributes:
        stages: Names of the stages.
        weights: Weights of their terms, of further terms, and that of `FINISH`, 1.
        settled_s: Time for which the last stage's condition must hold, in a row, before the episode ends with success.
        duration_s: Time of an episode.
        passed: (n,) number of stages passed.
        first: (n,) index of the arm in the first role.

    Args:
        settings: Values of the task's keywords.
        cell: The cell.
        timing: Rate and latency of actions.
        n: Number of cells.
        duration_s: Time of an episode.

    Raises:
        SettingsError: The class has no stage. A class with `weights` of its own is refused when it is made.
    """

    settled_s: ClassVar[float] = 0.5
    _stages: ClassVar[tuple[StageMethod, ...]] = ()
    _further: ClassVar[tuple[TermMethod, ...]] = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Collect the stages and the further terms."""
        super().__init_subclass__(**keywords)
        if "weights" in vars(cls):
            raise SettingsError(
                f"{cls.__name__} sets weights: give each to its method, as `stage(weight=...)` or `term(...)`"
            )
        found = {name: method for each in reversed(cls.__mro__) for name, method in vars(each).items()}
        cls._stages = tuple(method for method in found.values() if hasattr(method, "stage"))
        cls._further = tuple(method for method in found.values() if hasattr(method, "term_weight"))
        cls.stages = tuple(method.__name__ for method in cls._stages)
        if "couples" not in vars(cls):
            cls.couples = any(each.stage.coupled for each in cls._stages)  # type: ignore[attr-defined]
        weights = {each.__name__: each.stage.weight for each in cls._stages}  # type: ignore[attr-defined]
        further = {each.__name__: each.term_weight for each in cls._further}  # type: ignore[attr-defined]
        cls.weights = {**weights, **further, FINISH: 1.0}

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int, duration_s: float) -> None:
        super().__init__(settings, cell, timing, n)
        if not self._stages:
            raise SettingsError(f"{type(self).__name__} has no stage: decorate a method for each with `stage`")
        self.duration_s = duration_s
        self.horizon = self._steps = max(1, math.ceil(duration_s / timing.period_s - 1e-9))
        self._settled_steps = max(1, math.ceil(self.settled_s / timing.period_s - 1e-9))
        marks: list[_Stage] = [each.stage for each in self._stages]  # type: ignore[attr-defined]
        earned, early = (np.array(each).T for each in zip(*[mark[1:3] for mark in marks], strict=True))
        self._early = np.logical_or.reduce(early, axis=0).tolist()
        # By the number of stages passed, (stages + 1, 2, stages): factors of progress, and terms of passed stages.
        passed, number = np.arange(len(marks) + 1)[:, None, None], np.arange(len(marks))
        self._due: Array = np.where(early, passed <= number, passed == number) * earned
        self._earned: Array = (passed > number) * earned
        # By the number of stages passed, (stages + 1, ...): loads of the roles, and whether the arms are coupled.
        loads = [each.load_kg for each in marks]
        self._loads_kg: Array = np.array([(0.0, 0.0) if each is None else each for each in (*loads, loads[-1])])
        self._declares = any(each is not None for each in loads)
        self._coupled: Mask = np.array([*(each.coupled for each in marks), marks[-1].coupled])
        self._last, self._worth = len(marks), 1.0  # stages that success needs, and the weight of `FINISH`
        self.passed = np.zeros(n, dtype=np.int64)
        self.first = np.zeros(n, dtype=np.int64)
        self._arms: Rows = np.arange(2 * n).reshape(n, 2)  # of each role, among the arms of all rows; and back
        self._roles: Rows = self._arms.T.copy()
        self._count, self._settled = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)

    def begin_rows(self, rows: Rows, first: Sequence[int] | Rows | int = 0) -> None:
        """Begin episodes in `rows`, with these arms in the first role. Call it in `start`."""
        self.first[rows] = first
        self._arms[rows] = 2 * rows[:, None] + np.stack([self.first[rows], 1 - self.first[rows]], axis=1)
        self._roles = self._arms.T.copy()
        for values in (self.passed, self._count, self._settled):
            values[rows] = 0

    def end_after(self, name: str) -> None:
        """Let the condition of this stage end episodes with success.

        Of later stages a role earns only what it earns before they begin, such as for waiting. `FINISH` replaces what
        is earned in each step then.

        Args:
            name: One of `stages`.
        """
        self._last = self.stages.index(name) + 1
        marks: list[_Stage] = [each.stage for each in self._stages]  # type: ignore[attr-defined]
        weight, earned, early = (np.array(each) for each in list(zip(*marks, strict=True))[:3])
        later = np.arange(len(marks)) >= self._last
        self._due = self._due * (early.T | ~later)
        if later.any():
            self._worth = float(weight @ np.where(later, (earned * early).mean(axis=1), 1.0))

    def skip(self, rows: Rows, passed: Rows) -> None:
        """Let episodes that have just begun in `rows` continue from where these numbers of stages are passed.

        The load of these stages is declared already. A task that keeps more of an earlier stage extends it.
        """
        self.passed[rows] = passed
        load_kg = self.load_kg()
        if load_kg is not None:
            self._declared_kg[rows] = load_kg[rows]

    def by_role(self, values: NDArray[Any] | tuple[Number, Number]) -> tuple[Number, Number]:
        """Return values of the left and the right arm, (n, 2) or two numbers, as those of first and second role."""
        if self.n == 1:
            left, right = values if isinstance(values, tuple) else values[0].tolist()
            return (right, left) if self.first[0] else (left, right)
        both = np.stack(values, axis=1) if isinstance(values, tuple) else values
        first, second = both.take(self._roles)
        return first, second

    def load_kg(self) -> Array | None:
        """Return the mass that each gripper carries at the present stages; None if no stage has a load."""
        if not self._declares:
            return None
        by_role = self._loads_kg.take(self.passed, axis=0)
        loads: Array = by_role.take(self._arms)
        return loads

    def coupled(self) -> Mask:
        """Return the rows at a stage in which both arms hold one object."""
        return self._coupled.take(self.passed)

    @abstractmethod
    def facts(self, state: CellState, measured: MeasuredT) -> NowT:
        """Compute what the stages, the end and the values of `info` depend on. Called once per step."""

    def lost(self, now: NowT) -> Number:
        """Return a mask of rows that end in failure, (n,)."""
        return False

    def quality(self, now: NowT) -> Number:
        """Return the factor of the term `FINISH`, (n,): at least 1, or staying would earn more than success."""
        return 1.0

    def values(self, measured: MeasuredT) -> Mapping[str, Array]:
        """Return further values for `info`, after the stages are evaluated."""
        return {}

    def evaluate(self, state: CellState, measured: MeasuredT) -> Outcome:
        """Evaluate stages, reward terms, success and end."""
        now = self.facts(state, measured)
        terms, done = self._advance(now)
        self._count += 1
        over = self._count >= self._steps
        lost = np.zeros(self.n, dtype=bool)
        lost[:] = self.lost(now)
        if not np.count_nonzero(done):
            self._settled[:] = 0
            terminal, success = lost, done
        else:
            self._settled = (self._settled + 1) * done
            ended = self._settled >= self._settled_steps
            terminal = ended | lost
            success = done & ~lost & (ended | over)
            spared = np.maximum(self._steps - self._count, 0) * (ended & ~lost)
            terms[..., -1] = (spared * self.quality(now) * self._worth)[:, None]
        info: dict[str, Any] = {"stage": self.passed.copy(), **self.values(measured)}
        return Outcome(terms, success, over & ~terminal, info, terminal)

    def _advance(self, now: NowT) -> tuple[Array, Mask]:
        """Pass stages, and return the terms of the arms, (n, 2, terms), and the rows that passed all, (n,)."""
        passed, count = self.passed, len(self._stages)
        progress, done = np.zeros((self.n, 2, count)), np.zeros(self.n, dtype=bool)
        least, most = self._passed_by_rows()
        for number, method in enumerate(self._stages):
            last, later = number == self._last - 1 and most == self._last, number >= self._last
            if not (self._early[number] or (not later and (least <= number <= most or last))):
                continue  # no row is at this stage, or comes to it in this step
            condition, both = method(self, now)
            if condition is not False and not later:
                passed += condition & (passed == number)
                least, most = self._passed_by_rows()
            first, second = both if isinstance(both, tuple) else (both, both)
            progress[:, 0, number], progress[:, 1, number] = first, second
            if number == self._last - 1:
                done = condition & (passed == self._last)
        progress *= self._due.take(passed, axis=0)
        progress += self._earned.take(passed, axis=0)
        if self._further:
            further = np.empty((self.n, 2, len(self._further)))
            for number, method in enumerate(self._further):
                both = method(self, now)
                further[:, 0, number], further[:, 1, number] = both if isinstance(both, tuple) else (both, both)
            progress = np.concatenate([progress, further], axis=2)
            count += len(self._further)
        terms = np.zeros((self.n, 2, count + 1))
        terms[..., :-1] = progress.reshape(2 * self.n, count).take(self._arms, axis=0)
        return terms, done

    def _passed_by_rows(self) -> tuple[int, int]:
        """Return the smallest and the largest number of stages passed."""
        if self.n == 1:
            passed = self.passed.item(0)
            return passed, passed
        return int(self.passed.min()), int(self.passed.max())


class Cases(Generic[CaseT, DecisionT]):
    """Decisions in plain Python on one row's conditions, looked up for all rows.

    At these sizes a NumPy call costs more than its arithmetic, and nested masks hide what is decided. So a task writes
    its decision as a function of named conditions, with `if`. It is evaluated once for every combination of them.

    Args:
        case: Named tuple of conditions, at most 16.
        decide: Function from one row's case to its decision, a named tuple of numbers or of tuples of them. It must
            depend on nothing else.
    """

    def __init__(self, case: type[CaseT], decide: Callable[[CaseT], DecisionT]) -> None:
        self._case, self._decide = case, decide
        self._weights = 2.0 ** np.arange(len(case._fields))  # type: ignore[attr-defined]

    def __call__(self, case: CaseT) -> DecisionT:
        """Return the decision of one row, or that of each row of masks, (n,): numbers and (n,) arrays, likewise."""
        if isinstance(case[0], bool):
            decision: DecisionT = _decided(self._decide, case)
            return decision
        numbers = np.stack(case, axis=1).dot(self._weights).astype(np.intp)
        kind, tables = _tabulated(self._case, self._decide)
        decisions: DecisionT = kind(*[table.take(numbers, axis=-1) for table in tables])
        return decisions


_decided = lru_cache(maxsize=None)(lambda decide, case: decide(case))


@lru_cache(maxsize=32)
def _tabulated(case: Any, decide: Callable[[Any], Any]) -> tuple[Callable[..., Any], list[Array]]:
    decisions = [decide(case(*each[::-1])) for each in itertools.product((False, True), repeat=len(case._fields))]
    return type(decisions[0]), [np.array(column).T.copy() for column in zip(*decisions, strict=True)]
