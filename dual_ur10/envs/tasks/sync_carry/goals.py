"""Goals of both tools of a carry: where the reward leads them, and what agents observe of them.

A tool goes to its grip on the bar's reference at the end of the next motion. Before the path begins that is where the
bar lies, and as long as its gripper does not hold the bar it comes from behind (`dual_ur10.envs.tasks.geometry.Goal`).
The grip is `LEARNERS_ROOM_M` above the task's; welded, it is the task's.
The reward takes the reference now instead.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dual_ur10.assets.props import BAR_WIDTH_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool
from dual_ur10.envs.tasks.agent_goals import GOAL_FIELDS, GRIPPER_FIELDS, AgentGoals, Wanted
from dual_ur10.envs.tasks.geometry import KEEP, LEARNERS_ROOM_M, Goal, GoalSteps, Grasped, Grasps
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses
from dual_ur10.types import Array


def goal_fields(settings: CarrySettings) -> tuple[Field, ...]:
    """Return the fields of goals; with a rigid grasp there are no grippers."""
    return tuple(field for field in GOAL_FIELDS if not settings.rigid or field.name not in GRIPPER_FIELDS)


class CarryGoals:
    """Grasps of n carries, and the goals of their tools.

    Args:
        n: Number of carries.
        settings: Settings of the task.
        mounts: Mounts of the arms.
        objects: Number of poses.
        held: Index of the bar among them, as each arm measures it.
        references: Index of its reference, likewise.
        of_joints: Tools are given by joint positions, and not as frames.
        tools: Tools of the arms.
    """

    def __init__(
        self,
        n: int,
        settings: CarrySettings,
        mounts: tuple[ArmMount, ArmMount],
        objects: int,
        held: tuple[int, int],
        references: tuple[int, int],
        *,
        of_joints: bool = False,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        self._welded, grip = settings.rigid, settings.grip
        room = np.array([0.0, 0.0, 0.0 if settings.rigid else LEARNERS_ROOM_M])
        grips_m = np.tile(grip.position_m, (n, 1, 1))
        self.grasps = Grasps(Frames(mounts), grips_m, BAR_WIDTH_M, objects, held, tools)
        goals = [
            Goal(references[arm], Poses(grip.position_m[arm] + room, grip.quat[arm]), approached)
            for arm in (0, 1)
            for approached in (False, True)
        ]
        tcp_m = [tool.tcp_m for tool in tools]
        self.steps = GoalSteps(n, objects, goals, mounts if of_joints else None, tcp_m=tcp_m)

    def measure(self, flanges: Poses, opening_m: Array | None, poses: Array) -> Grasped:
        """Return the grasps of the bar; grippers that are welded to it hold it."""
        found = self.grasps(flanges, opening_m, poses)
        if self._welded:
            found.between[...] = found.holding[...] = True
        return found

    def __call__(self, grasped: Grasped, tools: Array) -> Wanted:
        """Return the goals.

        Args:
            grasped: Grasps, as returned by `measure`.
            tools: Frames of the tools, or commanded joint positions.
        """
        left, right = ~grasped.holding.T
        steps = self.steps(tools, grasped.frames, (left, 2 + right))
        # Fingers close where their tool has arrived; those that have begun to go on at a larger error.
        within = np.where(grasped.cleared < 1.0, KEEP, 1.0)
        return Wanted(steps, grasped.holding | (grasped.between & (steps.away < within)))


class CarryAgents(AgentGoals[CarryGoals]):
    """Agents' observations of a carry, in which each sees the bar as its arm measures it.

    Args:
        settings: Settings of the task.
        layout: Fields of an arm in a joint observation.
        own: Fields of an agent's observation.
        mounts: Mounts of both arms.
        tools: Tools of both arms.
    """

    objects = ("bar_base", "ahead_base")

    def __init__(
        self,
        settings: CarrySettings,
        layout: ObservationLayout,
        own: ObservationLayout,
        mounts: tuple[ArmMount, ArmMount],
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        super().__init__(layout, own, mounts, tools)
        self._settings = settings

    def goals(self, n: int) -> CarryGoals:
        """Return the goals of n rows: of the poses of bar and reference that both arms measure, left and right."""
        return CarryGoals(n, self._settings, self.mounts, 4, (0, 1), (2, 3), of_joints=True, tools=self.tools)

    def wanted(
        self, goals: CarryGoals, fields: Mapping[str, Array], flanges: Poses, objects: Array
    ) -> tuple[Grasped, Wanted]:
        """Return grasps and goals."""
        opening_m = fields["gripper_m"][..., 0] if "gripper_m" in fields else None
        grasped = goals.measure(flanges, opening_m, objects.swapaxes(1, 2).reshape(len(objects), 4, 7))
        return grasped, goals(grasped, fields["commanded_q_rad"])

    def commanded(self, goals: CarryGoals) -> Array:
        """Return the frames of the commanded tools."""
        return goals.steps.tools
