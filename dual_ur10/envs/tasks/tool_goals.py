"""Goals of tools that handle an object: how tools come to grips, and what agents observe of their goals.

A tool that goes to a grip goes to a point behind it first, along its own z: up to `APPROACH_M`, in proportion to how
far it is beside the line and how far it is turned (`LEVER_M`). So the fingers pass the object on both sides, and a
straight step to the goal never pushes it. Fingers close once tool and goal agree within 10 mm and 0.08 rad.

*Nearness* measures how near a tool is to its goal. With the length d of the path to the goal, in m, and the chord
c = 2 sin(angle / 2) of the rotation, it is a quarter of 2 - d - c / 2 + s, and s is half of the sum of
0.03 / (0.03 + d), 0.3 / (0.3 + d), 0.2 / (0.2 + c) and 1 / (1 + c). It is 1 at the goal, and has a slope at every
distance below 1 m. While the goal of a gripper is to be open, it counts 0.8 to 1 times, with the opened fraction of the
gripper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool, strokes_m
from dual_ur10.envs.tasks.agent_observations import AgentObservations
from dual_ur10.envs.tasks.holding import APPROACH_M, grasp_limits
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.kernel import Struct
from dual_ur10.kinematics.forward import links
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import quat_to_matrix
from dual_ur10.types import Array

LEVER_M: Final = 0.1
"""Lever with which distances include a rotation: 0.1 rad counts as 0.01 m."""

_CLEARANCE_M: Final = 0.007  # on both sides together, at which fingers are clear of an object
_THERE_M: Final = 0.01  # of the goal: there fingers close or open
_THERE: Final = 0.08  # the same of its rotation
_KEEP: Final = 3.0  # times these: fingers that have begun to close go on
_ASIDE: Final = 1.5  # m behind the grip for each m beside the line
_SLACK_M: Final = 0.01  # of such an error, at which a goal is not behind its grip
# Distances and rotations at which the terms of a nearness have fallen to their halves.
_SCALES_M: Final = np.array([0.03, 0.3])
_SCALES: Final = np.array([0.2, 1.0])
# Lengths of steps of which half is left when they are saturated.
_NEAR_M: Final = 0.01
_NEAR: Final = 0.03

GOAL_FIELDS: Final = (
    Field("goal_step_m", 3, -20.0, 20.0, "position (m)", "step from the commanded tool to its goal, in the cell frame"),
    Field("goal_rotation", 3, -2.01, 2.01, "2 sin(angle / 2)", "the same of its rotation, along the axis"),
    Field("goal_step_saturated", 3, -1.0, 1.0, "ratio", f"x / ({_NEAR_M:g} m + |x|) of this step"),
    Field("goal_rotation_saturated", 3, -1.0, 1.0, "ratio", f"x / ({_NEAR:g} + |x|) of this rotation"),
    Field("lag_saturated", 3, -1.0, 1.0, "ratio", "the same of the step from the tool to the commanded tool"),
    Field("lag_rotation_saturated", 3, -1.0, 1.0, "ratio", "the same of its rotation"),
    Field("between", 1, 0.0, 1.0, "0 or 1", "its grip of the object is between its fingers"),
    Field("opening", 1, -1.2, 1.2, "ratio", "opening of the gripper, of the largest"),
    Field("goal_opening", 1, 0.0, 1.0, "0 or 1", "goal of the gripper: 0 closed, 1 open"),
    Field(
        "goal_closeness", 2, 0.0, 1.0, "ratio", f"{_NEAR_M:g} m / ({_NEAR_M:g} m + way left); the same of the rotation"
    ),
)
"""Fields that agents observe beside those of their arms."""

GRIPPER_FIELDS: Final = ("between", "opening", "goal_opening")
"""Those of them that need a gripper."""


def approach(width_m: float, tools: tuple[Tool, Tool] = DEFAULT_TOOLS) -> Struct:
    """Return the constants of tools that come to grips of this width, for the kernel."""
    return Struct(
        "Approach",
        tcp_m=np.array([tool.tcp_m for tool in tools]),
        width_m=width_m,
        clear_m=width_m + _CLEARANCE_M,
        opening_m=np.array(strokes_m(tools)),
        back_m=APPROACH_M,
        lever_m=LEVER_M,
        aside=_ASIDE,
        slack_m=_SLACK_M,
        there_m=_THERE_M,
        there=_THERE,
        keep=_KEEP,
        scales_m=_SCALES_M,
        scales=_SCALES,
    )


def rows(poses: Poses) -> Array:
    """Return position and rotation matrix of poses as the kernel takes them, (..., 12)."""
    matrix = quat_to_matrix(poses.quat)
    return np.concatenate([poses.position_m, matrix.reshape(*matrix.shape[:-2], 9)], axis=-1)


def goal_observations(
    name: str,
    function: str,
    layout: ObservationLayout,
    own: ObservationLayout,
    mounts: tuple[ArmMount, ArmMount],
    width_m: float,
    fields: Mapping[str, str],
    tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    **values: Any,
) -> AgentObservations:
    """Return the function that adds `GOAL_FIELDS` to what each arm observes.

    Args:
        name: Name of the kernel's structure. It also has `tool`.
        function: Name of the kernel's function.
        layout: Fields of an arm in a joint observation.
        own: Fields of an agent's observation.
        mounts: Mounts of both arms.
        width_m: Width of the object between the fingers.
        fields: Fields of an arm whose positions the structure has, by its names for them.
        tools: Tools of both arms.
        **values: Other fields of the structure.
    """
    frames = Frames(mounts)
    begin = {field: layout.indices([field])[0] for field in layout.names}
    tool = Struct(
        "ToolFields",
        size=layout.size,
        commanded=begin["commanded_q_rad"],
        flange=begin["flange_base_m"],
        gripper=begin.get("gripper_m", -1),
        near_m=_NEAR_M,
        near=_NEAR,
        links=np.stack([links(mount.dh) for mount in mounts]),
        base_m=frames.base_m,
        to_base=np.ascontiguousarray(frames.rotation),
        grips=grasp_limits(width_m, tools),
    )
    positions = {each: begin[field] for each, field in fields.items()}
    return AgentObservations(name, function, layout.size, own.size, tool=tool, **positions, **values)
