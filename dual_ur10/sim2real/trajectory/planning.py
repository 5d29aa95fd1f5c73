"""Trajectories to a configuration, around what is in the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from dual_ur10.sim2real.trajectory.timing import BLEND_RAD, time_path
from dual_ur10.types import Array


def plan_to(
    start_rad: Array,
    goal_rad: Array,
    gate: SafetyGate,
    law: TargetLaw,
    rng: np.random.Generator,
    *,
    arms: Sequence[str] = ARMS,
    blend_rad: float = BLEND_RAD,
    duration_s: float | None = None,
) -> JointTrajectory:
    """Return a trajectory from rest to rest that a safety gate releases: a planned path, then its times.

    Args:
        start_rad: (2, 6) configuration where it begins.
        goal_rad: (2, 6) configuration where it ends.
        gate: Gate with the limits of motion and the distances that count. It does not change.
        law: Makes the targets that the gate sees.
        rng: Generator of the planner's samples.
        arms: Arms that move; the others must be where the goal has them.
        blend_rad: See `time_path`.
        duration_s: See `time_path`.

    Raises:
        PlanningError: There is no path, or none was found.
        TrajectoryError: The start is the goal, or the motion takes longer than `duration_s`.
    """
    path = plan_path(gate.distances, start_rad, goal_rad, gate.limits, rng, arms=arms)
    return time_path(path, gate, law, arms=arms, blend_rad=blend_rad, duration_s=duration_s)
