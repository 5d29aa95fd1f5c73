"""Trajectories to a configuration, around what is in the way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dual_ur10.errors import TrajectoryError, nearest_name
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.trajectory.files import FORMATS, read_trajectory
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from dual_ur10.sim2real.trajectory.path_timing import BLEND_RAD, time_path
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array


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


def configuration_of(text: str, home_q_rad: Array) -> tuple[tuple[str, ...], Array]:
    """Return the arms and the joint angles, (arms, 6), that a text names.

    Args:
        text: "home"; 12 joint angles in rad, separated by commas; an arm and its six, as in "left:0,-1.5,1,0,1,0"; or
            the name of a trajectory's file, whose first point counts.
        home_q_rad: (2, 6) home configuration.

    Raises:
        TrajectoryError: It names nothing, or the file cannot be read.
    """
    if text == "home":
        return ARMS, home_q_rad.copy()
    if Path(text).suffix.lower() in FORMATS:
        trajectory = read_trajectory(text, number_points=True)
        return trajectory.arms, trajectory.q_rad[0].copy()
    arm, _, angles = text.rpartition(":")
    arms = ARMS if not arm else (arm,)
    try:
        q_rad = np.array([float(each) for each in angles.split(",")])
    except ValueError:
        q_rad = np.empty(0)
    if arm not in ("", *ARMS) or q_rad.size != 6 * len(arms):
        near = nearest_name(text, ["home"])
        hint = f" (did you mean {near!r}?)" if near else ""
        raise TrajectoryError(
            f"{text!r:.200} is no configuration{hint}: it must be home, 12 joint angles, left: or right: and six, or "
            "the file of a trajectory",
            ResultCode.INVALID_JOINTS,
        )
    return arms, q_rad.reshape(len(arms), 6)
