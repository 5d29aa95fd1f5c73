"""Scripted policies with steps of the tools: straight steps to the goals that agents observe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS, SceneSettings
from dual_ur10.assets.tool import Tool
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.sync_carry.task import SyncCarry
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import UnknownNameError
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.sim2real.control.adapter import TCP_ROTATION_RAD_S, TCP_STEP_M_S
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array

_RATIO: Final = 0.3  # of the step that is left, in each period


class GoalFollower:
    """Steps of both tools, and of the grippers, to their present goals.

    It knows no stage, remembers nothing, and plans nothing. So its actions show a learner that observes the same goals
    all that there is to learn.

    Args:
        timing: Rate of actions.
        action_mode: "tcp_delta".
        mounts: Poses of the bases and kinematics of the arms; None: those of the default cell.
        limits: Not used.
        settings: Settings of the task; None: the default ones.
        tools: Tools of both arms.

    Raises:
        UnknownNameError: Another action mode.
    """

    task: ClassVar[type[Handover | SyncCarry]]

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "tcp_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: Any = None,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        if action_mode != "tcp_delta":
            raise UnknownNameError("action mode of the goal follower", action_mode, ["tcp_delta"])
        both = SceneSettings().mounts if mounts is None else (mounts[0], mounts[1])
        settings = settings or self.task.settings_type()
        self._layout, self._own = self.task.layout_for(settings), self.task.agent_layout_for(settings)
        self._observe = self.task.agents_for(settings, both, tools)
        self._most = np.repeat([TCP_STEP_M_S, TCP_ROTATION_RAD_S], 3) * timing.period_s

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of the task.
        """
        own = self._observe(self._layout.batch(observation, self.task.__name__))
        step = own[..., self._own.indices(["goal_step_m", "goal_rotation"])]
        action = np.clip(_RATIO * step / self._most, -1.0, 1.0)
        if "goal_opening" in self._own.names:
            opening = own[..., self._own.indices(["goal_opening"])]
            action = np.concatenate([action, 2.0 * opening - 1.0], axis=-1)
        return action.reshape(*np.shape(observation)[:-1], -1).astype(np.float32)


class HandoverFollower(GoalFollower):
    """Follower of the goals of Handover."""

    task = Handover


class SyncCarryFollower(GoalFollower):
    """Follower of the goals of SyncCarry."""

    task = SyncCarry
