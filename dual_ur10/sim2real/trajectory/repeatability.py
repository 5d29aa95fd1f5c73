"""Repeatability of one configuration of both arms, after random collision-free paths away and back.

The flange poses come from the joints' encoders by forward kinematics: what bends between encoder and flange, and how
far the kinematics are wrong, they do not show. The figure of ISO 9283 is the mean distance from the mean position plus
three standard deviations of it. As there, the arms are measured once they have settled: joints with friction creep for
a while after they count as resting.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import PlanningError, TrajectoryError
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor
from dual_ur10.sim2real.trajectory.planning import plan_to
from ur_core.types import Array

UR10_M: Final = 1e-4
"""Repeatability of a UR10: CB3 data sheet, ±0.1 mm."""

SETTLE_S: Final = 1.0
"""Default time between arrival and measurement: friction of a mild plant then leaves an eighth of the spread."""

_AROUND_RAD: Final = 1.0  # largest distance of a joint from home at the end of a random path
_TRIES: Final = 1000
_SAME_RAD: Final = 1e-9
_LATE: Final = 10  # stops per path because this computer was busy, after which the path is planned again


class FlangeSpread(NamedTuple):
    """Spread of both flanges.

    Attributes:
        iso_9283_m: (2,) mean distance from the mean position plus three standard deviations.
        largest_m: (2,) largest distance from it.
    """

    iso_9283_m: Array
    largest_m: Array


def spread_of(positions_m: Array) -> FlangeSpread:
    """Return the spread of (n, 2, 3) positions of both flanges.

    Raises:
        TrajectoryError: There are fewer than two.
    """
    if len(positions_m) < 2:
        raise TrajectoryError(f"a spread of {len(positions_m)} positions means nothing: measure 2 or more")
    away = np.linalg.norm(positions_m - positions_m.mean(axis=0), axis=-1)
    return FlangeSpread(away.mean(axis=0) + 3.0 * away.std(axis=0, ddof=1), away.max(axis=0))


def returns(
    executor: TrajectoryExecutor, paths: int, rng: np.random.Generator, settle_s: float = SETTLE_S
) -> Iterator[Array]:
    """Yield the joint angles, (2, 6), that are measured after each of some random paths away and back.

    Args:
        executor: Executor whose arms rest at the configuration.
        paths: Number of paths.
        rng: Generator of the paths.
        settle_s: Time for which the arms rest before they are measured, in the trajectory's time.

    Raises:
        PlanningError: No path was found.
        TrajectoryError: A path was not followed to its end.
    """
    home = executor.desired_q_rad
    for _ in range(paths):
        away = _random_goal(home, executor.gate, rng)
        for goal in (away, home):
            _move(executor, goal, rng)
        for _ in range(math.ceil(settle_s / executor.law.period_s)):
            executor.step()
        yield executor.measured_q_rad


def _move(executor: TrajectoryExecutor, goal: Array, rng: np.random.Generator) -> None:
    """Move along a planned path; after a missed deadline, on from where the arms stopped.

    Raises:
        PlanningError: No path was found.
        TrajectoryError: The path was not followed to its end.
    """
    for _ in range(_LATE):
        here = executor.desired_q_rad
        if np.abs(goal - here).max() < _SAME_RAD:
            return
        result = executor.execute(plan_to(here, goal, executor.gate, executor.law, rng)).wait()
        if result.succeeded:
            return
        if result.reason != "late":
            break
    raise TrajectoryError(f"a random path was not followed to its end: {result.text}", result.code)


def _random_goal(home: Array, gate: SafetyGate, rng: np.random.Generator) -> Array:
    """Return a configuration near home that the gate allows.

    Raises:
        PlanningError: None was found.
    """
    lower, upper = np.asarray(gate.limits.lower_rad) + 0.1, np.asarray(gate.limits.upper_rad) - 0.1
    for _ in range(_TRIES):
        goal = np.clip(home + rng.uniform(-_AROUND_RAD, _AROUND_RAD, (2, 6)), lower, upper)
        _, distance_m, allowed_m = gate.distances.worst(goal.reshape(12))
        if distance_m >= allowed_m:
            return goal
    raise PlanningError(f"none of {_TRIES} random configurations around the present one is free: choose another one")
