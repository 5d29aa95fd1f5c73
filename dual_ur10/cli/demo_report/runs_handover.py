"""The runs of Handover that the demonstration and the benchmarks are made of, and what comes of an episode."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.cli.demo_report.runs import speed_share
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.policies.evaluation.rollout import Info, Trace, rollout
from dual_ur10.policies.policy import Policy

HANDOVER_ID = "DualUR10/Handover-v0"

NOISE = {"object_noise_m": 0.002, "object_noise_rad": 0.01745}
"""How well the block's pose is measured where it is not known: σ along and about each axis, constant in an episode."""


@dataclass(frozen=True)
class HandoverRun:
    """One way to hand the block over.

    Attributes:
        name: Short name.
        title: For people.
        keywords: Of the environment.
    """

    name: str
    title: str
    keywords: Mapping[str, Any] = field(default_factory=dict)

    @property
    def nominal(self) -> bool:
        """Whether everything is exactly what is believed of it."""
        return "randomization" not in self.keywords


HANDOVER_RUNS = (
    HandoverRun("known", "pose known exactly", {"giver": "random"}),
    HandoverRun(
        "noisy",
        f"pose known to {1e3 * NOISE['object_noise_m']:g} mm, {math.degrees(NOISE['object_noise_rad']):.2g}°",
        {"giver": "random", "randomization": NOISE},
    ),
)


@dataclass(frozen=True)
class HandoverResult:
    """What came of one episode.

    Attributes:
        run: How it was run.
        seed: Of the episode.
        giver: Name of the arm that gives.
        stages: Names of the stages.
        passed_s: When each stage was passed, in their order; NaN: never.
        time_s: When the episode ended.
        success: Whether the task says that it was done well.
        ended_by: What cut it short; "" if nothing did.
        place_mm: Distance of the block to its target at the end.
        place_deg: Angle between the long axes of block and target at the end.
        slip_max_mm: Largest way of a grip in the gripper that held it.
        speed_share: Largest joint speed as a share of its limit.
        trace: `info` over time.
        period_s: Time between two steps of it.
    """

    run: HandoverRun
    seed: int
    giver: str
    stages: tuple[str, ...]
    passed_s: tuple[float, ...]
    time_s: float
    success: bool
    ended_by: str
    place_mm: float
    place_deg: float
    slip_max_mm: float
    speed_share: float
    trace: Trace
    period_s: float


def make_handover(run: HandoverRun, **keywords: Any) -> tuple[Any, Policy]:
    """Environment and scripted policy of a run."""
    return gym.make(HANDOVER_ID, **run.keywords, **keywords), policies.load("scripted", HANDOVER_ID, **run.keywords)


def measure_handovers(
    run: HandoverRun, episodes: int, on_share: Callable[[float], None] = lambda _: None
) -> list[HandoverResult]:
    """Run the episodes with the seeds 0, 1, ...

    Args:
        run: How.
        episodes: Number of episodes.
        on_share: Told after each step which share of all episodes is behind at least.
    """
    env, policy = make_handover(run)
    found: list[HandoverResult] = []
    try:
        for seed in range(episodes):
            found.append(_episode(env, policy, run, seed, lambda _: on_share(len(found) / episodes)))
    finally:
        env.close()
    return found


def _episode(env: Any, policy: Policy, run: HandoverRun, seed: int, on_step: Callable[[Info], None]) -> HandoverResult:
    trace = Trace()

    def keep(info: Info) -> None:
        trace(info)
        on_step(info)

    record = rollout(env, policy, seed=seed, on_step=keep)
    task = env.unwrapped.task
    return HandoverResult(
        run=run,
        seed=seed,
        giver=ARMS[int(trace["giver"][0])],
        stages=task.stages,
        passed_s=passed_s(trace["stage"], len(task.stages), record.period_s),
        time_s=float(record.time_s[-1]),
        success=record.success,
        ended_by=record.ended_by,
        place_mm=1e3 * float(trace["object_error_m"][-1]),
        place_deg=math.degrees(float(trace["object_error_rad"][-1])),
        slip_max_mm=1e3 * float(trace["slip_m"].max()),
        speed_share=speed_share(record.q_rad, record.period_s, task.limits),
        trace=trace,
        period_s=record.period_s,
    )


def passed_s(stage: np.ndarray[Any, np.dtype[np.float64]], stages: int, period_s: float) -> tuple[float, ...]:
    """When each stage was passed; NaN: never.

    Args:
        stage: (k,) number of stages passed at the end of each step.
        stages: Number of stages.
        period_s: Time of a step.
    """
    first = [np.flatnonzero(stage > k)[:1] for k in range(stages)]
    return tuple(period_s * (float(each[0]) + 1.0) if len(each) else math.nan for each in first)
