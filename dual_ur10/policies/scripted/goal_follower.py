"""Scripted policy for Handover with steps of the tools: straight steps to the goals that agents observe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.tasks.handover.goals import agent_observations, goals
from dual_ur10.envs.tasks.handover.settings import HandoverSettings
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import UnknownNameError
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.sim2real.control.adapter import TCP_ROTATION_RAD_S, TCP_STEP_M_S
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array

_RATIO: Final = 0.3  # of the step that is left, in each period


class GoalFollower:
    """Steps of both tools, and of the grippers, to their goals of the present phase.

    It knows no stage, remembers nothing, and plans nothing. So its actions show a learner that observes the same goals
    all that there is to learn.

    Args:
        timing: Rate of actions.
        action_mode: "tcp_delta".
        mounts: Poses of the bases and kinematics of the arms; None: those of the default cell.
        limits: Not used.
        settings: Settings of the task; None: the default ones.

    Raises:
        UnknownNameError: Another action mode.
    """

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "tcp_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: HandoverSettings | None = None,
    ) -> None:
        if action_mode != "tcp_delta":
            raise UnknownNameError("action mode of the goal follower", action_mode, ["tcp_delta"])
        both = SceneSettings().mounts if mounts is None else (mounts[0], mounts[1])
        settings = settings or HandoverSettings()
        self._layout, self._own = Handover.layout_for(settings), Handover.agent_layout_for(settings)
        self._observe = agent_observations(self._layout, self._own, goals(both), both)
        self._most = np.repeat([TCP_STEP_M_S, TCP_ROTATION_RAD_S], 3) * timing.period_s

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of Handover.
        """
        own = self._observe(self._layout.batch(observation, Handover.name))
        step, opening = (
            own[..., self._own.indices(names)] for names in (["goal_step_m", "goal_rotation"], ["goal_opening"])
        )
        action = np.concatenate([np.clip(_RATIO * step / self._most, -1.0, 1.0), 2.0 * opening - 1.0], axis=-1)
        return action.reshape(*np.shape(observation)[:-1], -1).astype(np.float32)
