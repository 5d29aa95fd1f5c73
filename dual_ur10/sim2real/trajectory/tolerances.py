"""Comparisons of measured arms with a goal: feedback, tolerances, and the start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.errors import distinguishable
from dual_ur10.kinematics.forward import flange_pose
from dual_ur10.kinematics.ur10 import ARMS, JOINTS, DHParameters
from dual_ur10.sim2real.trajectory.course_stepper import Desired
from dual_ur10.sim2real.trajectory.goal import Feedback, TrajectoryGoal
from dual_ur10.types import Array

START_RAD: Final = 0.01
"""Largest distance of a first point at time 0 from where the arms are commanded to be."""

MEASURED_RAD: Final = 0.02
"""Largest measured distance of resting arms from where they are commanded to be, as after an approach."""


def feedback_of(
    goal: TrajectoryGoal, desired: Desired, measured_q_rad: Array, dh: Sequence[DHParameters], time_s: float
) -> Feedback:
    """Return the feedback of a goal's arms after a period.

    Args:
        goal: The goal.
        desired: Commanded motion that the measurement shows.
        measured_q_rad: (2, 6) measured positions.
        dh: Kinematics of both arms.
        time_s: Time on the executor's clock.
    """
    rows = goal.rows
    wanted, found = desired.q_rad[rows], measured_q_rad[rows]
    flanges = [flange_pose(q, dh[arm])[0] for arm, q in zip(rows, np.stack([wanted, found], 1), strict=True)]
    away = np.array([math.dist(*each) for each in flanges])
    return Feedback(time_s, desired.path_s, desired.rate, wanted, found, wanted - found, away)


def off_path(goal: TrajectoryGoal, feedback: Feedback) -> str:
    """Return which joint exceeds its path tolerance most; "" if none does."""
    if not (np.abs(feedback.error_rad) > goal.path_tolerance_rad).any():
        return ""
    worst = _worst(goal, feedback.error_rad, goal.path_tolerance_rad)
    return f"{worst} from its path at {feedback.path_s:.3f} s: both arms stop on it"


def off_goal(goal: TrajectoryGoal, feedback: Feedback, rests: bool) -> str:
    """Return which joint is not at the last point, or that an arm moves; "" if all rest there."""
    if rests and (np.abs(feedback.error_rad) <= goal.goal_tolerance_rad).all():
        return ""
    worst = _worst(goal, feedback.error_rad, goal.goal_tolerance_rad) if rests else "an arm still moves"
    return f"{worst} from the last point, {goal.goal_time_s:g} s after it: check what holds it, or allow more"


def misplaced(goal: TrajectoryGoal, desired_q_rad: Array, measured_q_rad: Array) -> str:
    """Return which joint of resting arms is not where it should be at the beginning of a goal; "" if none.

    Args:
        goal: The goal.
        desired_q_rad: (2, 6) commanded positions.
        measured_q_rad: (2, 6) measured positions.
    """
    off = np.abs(measured_q_rad - desired_q_rad)
    if (off > MEASURED_RAD).any():
        arm, joint = np.unravel_index(int(off.argmax()), off.shape)
        return (
            f"{ARMS[arm]}/{JOINTS[joint]} is measured at {measured_q_rad[arm, joint]:.4f} rad and was commanded to "
            f"{desired_q_rad[arm, joint]:.4f} rad: allowed are {MEASURED_RAD:g} rad between them. Check what holds it"
        )
    first = goal.trajectory.q_rad[0]
    off = np.abs(desired_q_rad[goal.rows] - first)
    if goal.trajectory.time_s[0] == 0.0 and (off > START_RAD).any():
        arm, joint = np.unravel_index(int(off.argmax()), off.shape)
        return (
            f"point 0 of {goal.trajectory.arms[arm]}/{JOINTS[joint]} is at {first[arm, joint]:.4f} rad, and it is "
            f"at {desired_q_rad[goal.rows][arm, joint]:.4f} rad: allowed are {START_RAD:g} rad between them at time 0. "
            "Bring the arms there first, or give the point a later time"
        )
    return ""


def _worst(goal: TrajectoryGoal, error: Array, tolerance: Array) -> str:
    """Return the joint that exceeds its tolerance most."""
    arm, joint = np.unravel_index(int((np.abs(error) / tolerance).argmax()), error.shape)
    name = f"{goal.trajectory.arms[arm]}/{JOINTS[joint]}"
    found, allowed = distinguishable(abs(error[arm, joint]), tolerance[arm, joint], 4)
    return f"{name} is {found} rad, allowed are {allowed} rad,"
