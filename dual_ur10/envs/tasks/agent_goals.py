"""Goals of tools that agents observe beside their arms' numbers.

They follow from joint observations alone, with the same goals to which the reward leads. Fingers close once tool and
goal agree within 10 mm and 0.08 rad.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Final, Generic, NamedTuple, TypeVar

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool, strokes_m
from dual_ur10.envs.tasks.geometry import Goal, GoalSteps, Grasped, ToolSteps
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses, length
from dual_ur10.types import Array, Mask

# Lengths of steps of which half is left when they are saturated.
_NEAR_M: Final = 0.01
_NEAR: Final = 0.03
_SATURATED: Final = np.array([_NEAR_M, _NEAR, _NEAR_M, _NEAR])[:, None, None, None]

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


class Wanted(NamedTuple):
    """Goals of both arms, as far as they depend on the present.

    Attributes:
        steps: Steps of the tools to their goals.
        closes: (n, 2) True for a gripper that is to be closed.
    """

    steps: ToolSteps
    closes: Mask


GoalsT = TypeVar("GoalsT")


class AgentGoals(ABC, Generic[GoalsT]):
    """Each agent's own observation, with `GOAL_FIELDS`, from joint observations of any number of rows.

    Args:
        layout: Fields of an arm in a joint observation.
        own: Fields of an agent's observation.
        mounts: Mounts of both arms.
        tools: Tools of both arms.

    Attributes:
        objects: Names of the poses that the goals depend on, as of `dual_ur10.envs.tasks.observation_layout.pose_of`,
            in the order of the layout.
    """

    objects: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        layout: ObservationLayout,
        own: ObservationLayout,
        mounts: tuple[ArmMount, ArmMount],
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        self._layout, self._own, self._frames = layout, own, Frames(mounts)
        self.mounts, self.tools = mounts, tools
        self._most_m = np.array(strokes_m(tools))[:, None]
        names = [f"{name}_{part}" for name in ("flange_base", *self.objects) for part in ("m", "quat")]
        self._poses = layout.indices(names)
        self._made: dict[int, tuple[GoalsT, GoalSteps]] = {}  # by the number of rows

    @abstractmethod
    def goals(self, n: int) -> GoalsT:
        """Return the goals of n rows, whose tools are given by commanded joint positions."""

    @abstractmethod
    def wanted(
        self, goals: GoalsT, fields: Mapping[str, Array], flanges: Poses, objects: Array
    ) -> tuple[Grasped, Wanted]:
        """Return grasps and goals.

        Args:
            goals: As returned by `goals`.
            fields: Fields of the joint observation, (n, 2, field size) each.
            flanges: Poses of the flanges in the cell frame.
            objects: (n, 2, k, 7) poses of the objects in that frame, as each arm measures them.
        """

    @abstractmethod
    def commanded(self, goals: GoalsT) -> Array:
        """Return the frames of the commanded tools, (n, 2, 12), of the last call of `wanted`."""

    def __call__(self, observation: Array) -> Array:
        """Return new observations, (n, 2, own size), from joint ones, (n, 2 * size)."""
        n = len(observation)
        if n not in self._made:
            self._made[n] = self.goals(n), GoalSteps(n, 2, (Goal(0), Goal(1)))
        goals, lag_steps = self._made[n]
        fields = self._layout.split(observation)
        arms = observation.reshape(n, 2, -1)[..., self._poses]
        poses = self._frames.poses_to_cell(arms.reshape(n, 2, -1, 7))
        flanges = Poses(poses[:, :, 0, :3], poses[:, :, 0, 3:])
        grasped, wanted = self.wanted(goals, fields, flanges, poses[:, :, 1:])
        steps, lag = wanted.steps, lag_steps(grasped.tools, self.commanded(goals))
        vectors = np.stack([steps.move_m, steps.turn, lag.move_m, lag.turn])
        saturated = vectors * (1.0 / (_SATURATED + length(vectors)[..., None]))
        near = [_NEAR_M / (_NEAR_M + steps.left_m), _NEAR / (_NEAR + steps.chord)]
        values: dict[str, Any] = {
            **fields,
            "goal_step_m": steps.move_m,
            "goal_rotation": steps.turn,
            "goal_step_saturated": saturated[0],
            "goal_rotation_saturated": saturated[1],
            "lag_saturated": saturated[2],
            "lag_rotation_saturated": saturated[3],
            "goal_closeness": np.stack(near, axis=2),
        }
        if "gripper_m" in fields:
            values["between"] = grasped.between[..., None]
            values["opening"] = fields["gripper_m"] / self._most_m
            values["goal_opening"] = ~wanted.closes[..., None]
        return self._own.join(values).reshape(n, 2, -1)
