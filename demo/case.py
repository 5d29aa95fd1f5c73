"""One case type and one result type for all tasks of the demonstration, and what makes up a task there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dual_ur10 import policies
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.evaluation.film import Take
from dual_ur10.policies.evaluation.rollout import Info, Record, Trace, rollout
from dual_ur10.policies.policy import Policy
from dual_ur10.sim2real.analysis.page import Column, PageTable
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.types import Array

Key = tuple[int, str, str]
"""Key frame: number of the instant, title and text."""

OnStep = Callable[[int], None]
"""Called with the number of steps done, after each."""


@dataclass(frozen=True)
class Case:
    """A task with a policy, and keywords of its environment.

    Attributes:
        name: Short name.
        title: Title of its row.
        env_id: Id of the environment.
        keywords: Keywords of the environment.
        learn: False: the policy of SineTracking does not learn the arms' deviation.
        policy: Name of the policy.
    """

    name: str
    title: str
    env_id: str
    keywords: Mapping[str, Any] = field(default_factory=dict)
    learn: bool = True
    policy: str = "scripted"

    @property
    def nominal(self) -> bool:
        """True if plant and measurements are exactly those of the nominal model."""
        cell = self.keywords.get("cell")
        return "randomization" not in self.keywords and (cell is None or cell.perturbation == Perturbation())

    def given(self, **keywords: Any) -> Case:
        """Return the case with further keywords of the environment."""
        return replace(self, keywords={**self.keywords, **keywords})


@dataclass(frozen=True)
class CaseResult:
    """One episode of a case.

    Attributes:
        case: The case that was run.
        seed: Seed of the episode.
        record: Measured motion.
        trace: `info` over time.
        limits: Motion limits of the task.
        figures: Figures of the episode by name, as the task computes them; empty if it has none.
        late_actions: Number of actions that missed their deadline, so that both arms stopped and then went on.
        folder: Folder of the recording; None if nothing was recorded.
    """

    case: Case
    seed: int
    record: Record
    trace: Trace
    limits: MotionLimits
    figures: Mapping[str, Any] = field(default_factory=dict)
    late_actions: int = 0
    folder: Path | None = None

    @property
    def speed_ratio(self) -> float:
        """Largest joint speed over its limit."""
        return speed_ratio(self.record.q_rad, self.record.period_s, self.limits)


def figure_column(title: str, unit: str, figure: str, scale: float = 1.0) -> Column[CaseResult]:
    """Return a column of one of the results' figures; a dash where a result has none."""
    return Column(title, unit, lambda result: float(scale * result.figures.get(figure, np.nan)))


SUCCESS = Column[CaseResult]("success", "", lambda result: "yes" if result.record.success else "no")
JOINT_SPEED = Column[CaseResult]("joint speed", "% of limit", lambda result: f"{100 * result.speed_ratio:.0f}")


@dataclass(frozen=True)
class DemoTask:
    """Everything that the demonstration runs, measures, draws and reports of one task.

    Attributes:
        name: Short name.
        title: Name of the task.
        cases: Cases that are run.
        columns: Columns of the table.
        page_only: Titles of the columns for which a terminal is too narrow.
        emulated_columns: Columns of the table that sets simulation beside emulated controllers.
        figures: Figures of an episode. Raises a `DualUR10Error` where it has none.
        context: Plots and further values for the task's template, from the results.
        filmed: The case of the video: not one of the nominal model.
        keys: Key frames of an episode: number of the instant, title and text of each.
        video: File name of the video.
        step_s: Computing time of a step, for the estimate of the time left.
        steps: Approximate steps of an episode; 0: its length is chosen by the keyword `duration_s`.
        replayed: True: emulated controllers replay the actions of the simulation; False: the policy acts there, too.
        many: True: a case has several episodes, which may be cut short; False: one, which must be complete.
    """

    name: str
    title: str
    cases: Sequence[Case]
    columns: Sequence[Column[CaseResult]]
    emulated_columns: Sequence[Column[CaseResult]]
    figures: Callable[[CaseResult], Mapping[str, Any]]
    context: Callable[[Sequence[CaseResult]], Mapping[str, Any]]
    filmed: Case
    video: str
    step_s: float
    steps: int = 0
    page_only: Sequence[str] = ()
    keys: Callable[[Take], Sequence[Key]] = lambda _: ()
    replayed: bool = False
    many: bool = False

    def table(self, name: str, results: Sequence[CaseResult], omitted: Sequence[str] = ()) -> PageTable:
        """Return the table of results without some columns. Rows of the nominal model are "weak"."""
        seeds = [f", seed {each.seed}" if self.many else "" for each in results]
        rows = [
            (each.case.title + seed, "weak" if each.case.nominal else "", each)
            for each, seed in zip(results, seeds, strict=True)
        ]
        return PageTable.of(name, [each for each in self.columns if each.title not in omitted], rows)

    def measure(self, case: Case, seeds: Sequence[int] = (0,), on_step: OnStep = lambda _: None) -> list[CaseResult]:
        """Run an episode for each seed and compute its figures.

        Args:
            case: One of this task.
            seeds: Seeds of the episodes.
            on_step: Called with the number of steps of all episodes.

        Raises:
            DualUR10Error: An episode was cut short, and the task has one for each case: its figures mean nothing.
        """
        env, policy = make(case)
        found: list[CaseResult] = []
        steps = 0

        def count(info: Info) -> None:
            nonlocal steps
            steps += 1
            on_step(steps)

        try:
            for seed in seeds:
                result = episode(case, env, policy, seed, count)
                if result.record.ended_by and not self.many:
                    raise DualUR10Error(
                        f"the run '{case.title}' ended after {result.record.time_s[-1]:g} s: {result.record.ended_by}"
                    )
                found.append(replace(result, figures=self.figures(result)))
        finally:
            env.close()
        return found


def make(case: Case) -> tuple[Any, Policy]:
    """Return environment and policy of a case."""
    policy: Any
    env, policy = policies.make(case.policy, case.env_id, **case.keywords)
    if not case.learn:
        policy.learn = False
    return env, policy


def episode(case: Case, env: Any, policy: Policy, seed: int, on_step: Callable[[Info], None]) -> CaseResult:
    """Run one episode; the result has no figures yet."""
    trace = Trace()

    def keep(info: Info) -> None:
        trace(info)
        on_step(info)

    record = rollout(env, policy, seed=seed, on_step=keep)
    core = env.unwrapped.core
    return CaseResult(case, seed, record, trace, core.task.limits, late_actions=core.late_actions)


def speed_ratio(q_rad: Array, period_s: float, limits: MotionLimits) -> float:
    """Return the largest joint speed of an episode, by differences over policy periods, over its limit.

    Args:
        q_rad: (k, 2, 6) joint positions, a policy period apart.
        period_s: Policy period.
        limits: Motion limits of the arms.
    """
    speed = np.abs(np.diff(q_rad, axis=0)) / period_s
    return float((speed / np.asarray(limits.speed_rad_s)).max())
