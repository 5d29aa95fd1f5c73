"""The runs of SyncCarry that the demonstration and the benchmarks are made of, and what comes of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.cli.demo_report.runs import speed_share
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.evaluation.rollout import Info, Trace, rollout
from dual_ur10.policies.policy import Policy

CARRY_ID = "DualUR10/SyncCarry-v0"

_OFF_TABLE_M = 0.05  # above where it lay: a bar that is carried


@dataclass(frozen=True)
class CarryRun:
    """One way to carry the bar.

    Attributes:
        name: Short name.
        title: For people.
        keywords: Of the environment.
        seed: Of the episode.
    """

    name: str
    title: str
    keywords: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0

    @property
    def nominal(self) -> bool:
        """Whether the plant is exactly what is believed of it."""
        return "randomization" not in self.keywords

    @property
    def rigid(self) -> bool:
        """Whether the bar is welded to the grippers, so that it cannot slip."""
        return self.keywords.get("grasp") == "rigid"


CARRY_RUNS = (
    CarryRun("rigid", "rigid grasp, nominal", {"grasp": "rigid"}),
    CarryRun("friction", "friction grasp, nominal"),
    CarryRun("mild", "friction grasp, mild randomization", {"randomization": "mild"}),
)


@dataclass(frozen=True)
class CarryFigures:
    """Figures of one episode, from the begin of the path on.

    Attributes:
        relative_max_mm: Largest error of the right flange's position in the left one's frame.
        relative_max_deg: Largest error of its orientation there.
        squeeze_max_n: Largest force by which the arms press against each other along the bar, or pull.
        lateral_max_n: The same across the bar.
        slip_max_mm: Largest way of a grip in its gripper; NaN for a rigid grasp.
        bar_max_mm: Largest distance of the bar to its reference.
        bar_rms_mm: Its root mean square.
        bar_max_deg: Largest turn of the bar from its reference.
        least_load_share: Smallest share of the load that an arm carries while the bar is off the table.
        speed_share: Largest joint speed of the whole episode as a share of its limit.
    """

    relative_max_mm: float
    relative_max_deg: float
    squeeze_max_n: float
    lateral_max_n: float
    slip_max_mm: float
    bar_max_mm: float
    bar_rms_mm: float
    bar_max_deg: float
    least_load_share: float
    speed_share: float


@dataclass(frozen=True)
class CarryResult:
    """What came of a run.

    Attributes:
        run: How it was run.
        trace: `info` over time.
        period_s: Time between two steps of it.
        success: Whether the task says that it was done well.
        figures: Of the whole path.
    """

    run: CarryRun
    trace: Trace
    period_s: float
    success: bool
    figures: CarryFigures

    @property
    def time_s(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(k,) time since the reset."""
        return self.period_s * np.arange(1, len(self.trace) + 1, dtype=np.float64)


def make_carry(run: CarryRun, **keywords: Any) -> tuple[Any, Policy]:
    """Environment and scripted policy of a run."""
    return gym.make(CARRY_ID, **run.keywords, **keywords), policies.load("scripted", CARRY_ID, **run.keywords)


def measure_carry(run: CarryRun, on_share: Callable[[float], None] = lambda _: None) -> CarryResult:
    """Run one episode and compute its figures.

    Args:
        run: How.
        on_share: Told after each step which share of the episode is behind.

    Raises:
        DualUR10Error: The episode was cut short: its figures would mean nothing.
    """
    env, policy = make_carry(run)
    trace, duration_s = Trace(), env.unwrapped.task.duration_s

    def keep(info: Info) -> None:
        trace(info)
        on_share(min(1.0, len(trace) * env.unwrapped.core.timing.period_s / duration_s))

    try:
        record = rollout(env, policy, seed=run.seed, on_step=keep)
        limits = env.unwrapped.task.limits
    finally:
        env.close()
    if record.ended_by:
        raise DualUR10Error(f"the run '{run.title}' ended after {record.time_s[-1]:g} s: {record.ended_by}")
    share = speed_share(record.q_rad, record.period_s, limits)
    return CarryResult(run, trace, record.period_s, record.success, figures_of_carry(trace, run.rigid, share))


def figures_of_carry(trace: Trace, rigid: bool, share: float) -> CarryFigures:
    """Figures of an episode from its `info`.

    Args:
        trace: `info` over time.
        rigid: Whether the bar is welded to the grippers.
        share: Largest joint speed as a share of its limit.

    Raises:
        DualUR10Error: The episode ended before its path began.
    """
    begun = trace["clock_s"] > 0.0
    if not begun.any():
        raise DualUR10Error("the episode ended before its path began: it has no figures")

    def peak(name: str) -> float:
        return float(np.abs(trace[name][begun]).max())

    height = trace["object_m"][:, 2]
    carried = begun & (height > height[0] + _OFF_TABLE_M)
    return CarryFigures(
        relative_max_mm=1e3 * peak("relative_error_m"),
        relative_max_deg=math.degrees(peak("relative_error_rad")),
        squeeze_max_n=peak("squeeze_n"),
        lateral_max_n=peak("lateral_n"),
        slip_max_mm=math.nan if rigid else 1e3 * peak("slip_m"),
        bar_max_mm=1e3 * peak("object_error_m"),
        bar_rms_mm=1e3 * float(np.sqrt((trace["object_error_m"][begun] ** 2).mean())),
        bar_max_deg=math.degrees(peak("object_error_rad")),
        least_load_share=float(trace["load_share"][carried].min()) if carried.any() else math.nan,
        speed_share=share,
    )
