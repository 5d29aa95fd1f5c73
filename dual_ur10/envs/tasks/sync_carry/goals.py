"""Goals of both tools of a carry: where the reward leads them, and what is observed of them.

A commanded tool goes to its grip on the bar's reference at the end of the next motion. Before the path begins that is
where the bar lies, and as long as its gripper does not hold the bar it comes from behind
(`dual_ur10.envs.tasks.geometry.Goal`). The grip is `LEARNERS_ROOM_M` above the task's; welded, it is the task's.
The reward takes tools and reference now instead.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.props import BAR_WIDTH_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.geometry import KEEP, LEARNERS_ROOM_M, Goal, GoalSteps, ToolSteps
from dual_ur10.envs.tasks.grasps import Grasped, Grasps
from dual_ur10.envs.tasks.observation_layout import Field
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses
from ur_core.tools.tool import Tool
from ur_core.types import Array, Mask

PATH_FIELDS: Final = (
    Field("path_m_s", 3, -5.0, 5.0, "velocity (m/s)", "velocity of the grip on the bar's reference", concise=(0.1,)),
    Field("path_rad_s", 3, -5.0, 5.0, "velocity (rad/s)", "angular velocity of the bar's reference", concise=(0.2,)),
)
"""Last fields of a carry whose settings have `path_speed`, in the cell frame."""

POSES: Final = 3
BAR_POSE, REFERENCE, AHEAD = range(POSES)
"""Poses of a carry: the bar, its reference now, and that at the end of the next motion."""


class Wanted(NamedTuple):
    """Goals of both arms.

    Attributes:
        steps: Steps of the tools to their goals.
        closes: (n, 2) True for a gripper that is to be closed.
    """

    steps: ToolSteps
    closes: Mask


class CarryGoals:
    """Grasps of n carries, and the goals of their tools.

    Args:
        n: Number of carries.
        settings: Settings of the task.
        mounts: Mounts of the arms.
        tools: Tools of the arms.

    Attributes:
        grasps: Measurement of the grasps of the bar.
        steps: Steps of the tools.
        commanded: Steps of the commanded tools.
    """

    def __init__(
        self,
        n: int,
        settings: CarrySettings,
        mounts: tuple[ArmMount, ArmMount],
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        self._welded, grip = settings.rigid, settings.grip
        self._grip_m = grip.position_m[:, None]
        room = np.array([0.0, 0.0, 0.0 if settings.rigid else LEARNERS_ROOM_M])
        self.grasps = Grasps(Frames(mounts), np.tile(grip.position_m, (n, 1, 1)), BAR_WIDTH_M, POSES, tools=tools)

        def goals(frame: int) -> list[Goal]:
            grips = [Poses(grip.position_m[arm] + room, grip.quat[arm]) for arm in (0, 1)]
            return [Goal(frame, each, approached) for each in grips for approached in (False, True)]

        self.steps = GoalSteps(n, POSES, goals(REFERENCE))
        self.commanded = GoalSteps(n, POSES, goals(AHEAD), mounts, tcp_m=[tool.tcp_m for tool in tools])

    def measure(self, flanges: Poses, opening_m: Array | None, poses: Array) -> Grasped:
        """Return the grasps of the bar; grippers that are welded to it hold it."""
        found = self.grasps(flanges, opening_m, poses)
        if self._welded:
            found.between[...] = found.holding[...] = True
        return found

    def speeds(self, grasped: Grasped, ahead_s: float) -> tuple[Array, Array]:
        """Return the velocities of both grips on the reference, (n, 2, 3) each, m/s and rad/s in the cell frame.

        They are means from now to the end of the next motion.

        Args:
            grasped: Grasps, as returned by `measure`.
            ahead_s: Time to the end of the next motion.
        """
        now, ahead = grasped.frames[:, REFERENCE], grasped.frames[:, AHEAD]
        (begin, end) = (each[:, 3:].reshape(-1, 3, 3) for each in (now, ahead))
        moved_m = (ahead - now)[:, None, :3] + (self._grip_m * (end - begin)[:, None]).sum(axis=-1)
        turn = (end[:, :, None] * begin[:, None]).sum(axis=-1)
        axis = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]])
        return moved_m / ahead_s, np.repeat(axis.T[:, None] / (2.0 * ahead_s), 2, axis=1)

    def __call__(self, grasped: Grasped, commanded_q_rad: Array | None = None) -> Wanted:
        """Return the goals.

        Args:
            grasped: Grasps, as returned by `measure`.
            commanded_q_rad: Joint positions of the commanded tools, whose goals are wanted; None: those of the tools.
        """
        follow, tools = self.steps, grasped.tools
        if commanded_q_rad is not None:
            follow, tools = self.commanded, commanded_q_rad
            follow.actual[...] = grasped.tools
        left, right = ~grasped.holding.T
        steps = follow(tools, grasped.frames, (left, 2 + right))
        # Fingers close where their tool has arrived; those that have begun to go on at a larger error.
        within = np.where(grasped.cleared < 1.0, KEEP, 1.0)
        return Wanted(steps, grasped.holding | (grasped.between & (steps.away < within)))
