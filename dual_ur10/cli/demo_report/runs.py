"""The runs of SineTracking that the demonstration and the accuracy benchmark are made of, and what comes of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DualUR10Error
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.policies.evaluation.accuracy import Accuracy, accuracy, lag_s, skew_s
from dual_ur10.policies.evaluation.rollout import Info, Record, rollout
from dual_ur10.policies.scripted.sine_tracking import SineTrackingPolicy
from dual_ur10.sim2real.config.cell import TYPICAL_PERTURBATION, CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits

SINE_ID = "DualUR10/SineTracking-v0"

ASYMMETRIC_CELL = CellConfig(left=ArmMount((-0.75, 0.6, 0.0)), right=ArmMount((-0.92, -0.45, 0.08)))
"""Where accuracy is measured. In a symmetric cell both arms make the same errors, and the distance between them is
exactly right whatever the controller does."""

PERTURBED_CELL = replace(ASYMMETRIC_CELL, perturbation=TYPICAL_PERTURBATION)

LATENCY_TICKS = 5


@dataclass(frozen=True)
class Run:
    """One way to run the sine.

    Attributes:
        name: Short name.
        title: For people.
        cell: Plant and bases.
        learn: Whether the policy learns the arms' deviation.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.
        arms: Which arms follow the sine.
        latency_ticks: Ticks between an observation and the first target of its action.
        axis: Direction of the sine; y is the line between the flanges.
    """

    name: str
    title: str
    cell: CellConfig = ASYMMETRIC_CELL
    learn: bool = True
    compensate_lag: bool = True
    arms: str = "both"
    latency_ticks: int = 0
    axis: str = "y"


RUNS = (
    Run("nominal", "nominal"),
    Run("perturbed", "perturbed", PERTURBED_CELL),
    Run("perturbed_fixed", "perturbed, without learning", PERTURBED_CELL, learn=False),
    Run("perturbed_late", f"perturbed, L = {LATENCY_TICKS} ticks", PERTURBED_CELL, latency_ticks=LATENCY_TICKS),
    Run("single", "single arm, nominal", arms="left"),
    Run("single_perturbed", "single arm, perturbed", PERTURBED_CELL, arms="left"),
    Run("lagging", "nominal, lag not compensated", learn=False, compensate_lag=False),
)


@dataclass(frozen=True)
class Result:
    """What came of a run.

    Attributes:
        run: How it was run.
        record: What was measured.
        accuracy: Figures of the whole episode.
        lag_s: How far the slower of the tracking arms is behind its reference.
        skew_s: How far the left arm is behind the right one; NaN if only one moves.
    """

    run: Run
    record: Record
    accuracy: Accuracy
    lag_s: float
    skew_s: float


def make(run: Run, duration_s: float, **keywords: Any) -> tuple[Any, SineTrackingPolicy]:
    """Environment and policy of a run."""
    env = gym.make(
        SINE_ID,
        cell=run.cell,
        axis=run.axis,
        duration_s=duration_s,
        randomize=False,
        arms=run.arms,
        compensate_lag=run.compensate_lag,
        action_latency_ticks=run.latency_ticks,
        **keywords,
    )
    mounts = (run.cell.left, run.cell.right)
    return env, SineTrackingPolicy(env.unwrapped.core.timing, mounts=mounts, learn=run.learn)  # type: ignore[attr-defined]


def measure(run: Run, duration_s: float, on_step: Callable[[Info], None] | None = None) -> Result:
    """Run one episode and compute its figures.

    Raises:
        DualUR10Error: The episode was cut short: its figures would mean nothing.
    """
    env, policy = make(run, duration_s)
    try:
        record = rollout(env, policy, seed=0, on_step=on_step)
    finally:
        env.close()
    if record.ended_by:
        raise DualUR10Error(f"the run '{run.title}' ended after {record.time_s[-1]:g} s: {record.ended_by}")
    lag = lag_s(record)
    return Result(
        run=run,
        record=record,
        accuracy=accuracy(record),
        lag_s=float(lag[~np.isnan(lag)].max()),
        skew_s=skew_s(record),
    )


def speed_share(q_rad: NDArray[np.float64], period_s: float, limits: MotionLimits) -> float:
    """Largest joint speed of an episode, by differences over control periods, as a share of its limit.

    Args:
        q_rad: (k, 2, 6) joint positions, a control period apart.
        period_s: That period.
        limits: What the arms may do.
    """
    speed = np.abs(np.diff(q_rad, axis=0)) / period_s
    return float((speed / np.asarray(limits.speed_rad_s)).max())
