"""Soonest stop of an arm, as a feedback law on its last targets.

A polynomial that ends on the command needs several times the way that the limits demand: it gives away most of the
acceleration. The stop planned here ends at rest wherever the limits allow, and the way back is a path to the command
again. With `N` ticks to go, it has the least sum of squared accelerations and, weighted, jerks of the targets. That is
a linear-quadratic problem, so each target is a fixed row of numbers times what the joint carries along, for each `N`;
after a tick the rest of a plan is the plan for `N - 1`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY
from ur_core.types import Array

CARRIED: Final = HISTORY + 2
"""Numbers of a joint that a stop is planned from: its last three targets, its arm's position and speed."""

LATEST_S: Final = 0.6
"""Longest stop that is planned: within the hard limits one from full speed takes 0.4 s."""

_JERK_WEIGHT: Final = 1.5  # of a squared jerk, times the square of the limits' acceleration over jerk
_REST: Final = 1e9  # weight of the arm's remaining motion at the end, in squares of accelerations per tick


def gains(arm: Array, tick_s: float, acceleration_rad_s2: float, jerk_rad_s3: float) -> Array:
    """Return the weights of the next target of a stop, (latest, 5), on what a joint carries along.

    Args:
        arm: (2, 6) the arm's position and speed after a tick, on what the joint carries along and the tick's target.
        tick_s: Time between two targets.
        acceleration_rad_s2: Limit of the targets' second difference.
        jerk_rad_s3: Limit of their third difference.

    Returns:
        Row k is the law with k + 1 ticks to go.
    """
    weight = (_JERK_WEIGHT * acceleration_rad_s2 / jerk_rad_s3 / tick_s) ** 2
    # What is carried along, after a tick with a target: columns of the five numbers, and of the target.
    after = np.zeros((CARRIED, CARRIED + 1))
    after[0, 1] = after[1, 2] = after[2, CARRIED] = 1.0
    after[3:] = arm
    differences = np.array([[0.0, 1.0, -2.0, 0.0, 0.0, 1.0], [-1.0, 3.0, -3.0, 0.0, 0.0, 1.0]])
    cost = differences.T @ np.diag([1.0, weight]) @ differences
    # At the end the arm rests on its target, which is held: two ticks later the differences are over.
    at_rest = np.array([[0.0, 0.0, -1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, tick_s]])
    value = _REST * at_rest.T @ at_rest
    held = np.eye(CARRIED + 1, CARRIED)
    held[CARRIED, 2] = 1.0
    for _ in range(HISTORY - 1):
        value = held.T @ (cost + after.T @ value @ after) @ held
    rows = []
    for _ in range(math.ceil(LATEST_S / tick_s)):
        whole = cost + after.T @ value @ after
        rows.append(-whole[CARRIED, :CARRIED] / whole[CARRIED, CARRIED])
        closed = np.vstack([np.eye(CARRIED), rows[-1]])
        value = closed.T @ whole @ closed
        value = (value + value.T) / 2
    result: Array = np.array(rows)
    return result
