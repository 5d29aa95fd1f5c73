"""Scripted policies with steps of the tools: straight steps to the goals that are observed."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.envs.tasks.task import Task, Timing
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.control.adapter import TCP_ROTATION_RAD_S, TCP_STEP_M_S, ActionScale, scale_of_steps
from ur_core.types import Array, changed

_MODES: Final = ("tcp_delta", "tcp_translation")
_STEPS: Final = ("goal_step_m", "goal_rotation")
_RATIO: Final = 0.3  # of the step that is left, in each period


class GoalFollower:
    """Steps of both tools, and of the grippers, to their present goals.

    It knows no stage, remembers nothing, and plans nothing. So its actions show a learner that observes the same goals
    all that there is to learn.

    Args:
        task: Class of the task, whose observations have `dual_ur10.envs.tasks.goal_fields.GOAL_FIELDS`.
        timing: Rate of actions.
        action_mode: "tcp_delta", or "tcp_translation" for tools that need no rotation.
        settings: Settings of the task; None: the default ones.
        action_scale: Factor of steps.

    Raises:
        UnknownNameError: Another action mode.
        SettingsError: The task observes no goals.
    """

    def __init__(
        self,
        task: type[Task[Any, Any]],
        timing: Timing,
        action_mode: str = "tcp_delta",
        settings: Any = None,
        action_scale: ActionScale = 1.0,
    ) -> None:
        if action_mode not in _MODES:
            raise UnknownNameError("action mode of the goal follower", action_mode, _MODES)
        self._steps = 3 if action_mode == "tcp_translation" else 6
        given: Any = task.settings_type() if settings is None else settings
        self._task, self._settings, self._rate_hz = task, given, 1.0 / timing.period_s
        self._layout, self._mode = task.layout_for(given), action_mode
        lacking = [name for name in _STEPS if name not in self._layout.names]
        if lacking:
            raise SettingsError(
                f"{task.__name__} observes no {' and no '.join(lacking)}, which the goal follower follows: add "
                "GOAL_FIELDS of `dual_ur10.envs.tasks.goal_fields` to its `layout`, and use observation='state'"
            )
        most = np.repeat([TCP_STEP_M_S, TCP_ROTATION_RAD_S], 3) * timing.period_s
        self._most = most * scale_of_steps(action_mode, action_scale)

    def __repr__(self) -> str:
        texts = self._task.__name__, changed(self._settings), f"{self._mode} at {self._rate_hz:g} Hz"
        return f"{type(self).__name__}({', '.join(filter(None, texts))})"

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of the task.
        """
        fields = self._layout.split(self._layout.batch(observation, self._task.__name__))
        step = np.concatenate([fields[name] for name in _STEPS], axis=-1)
        action = np.clip(_RATIO * step / self._most, -1.0, 1.0)[..., : self._steps]
        if "goal_opening" in fields:
            action = np.concatenate([action, 2.0 * fields["goal_opening"] - 1.0], axis=-1)
        return action.reshape(*np.shape(observation)[:-1], -1).astype(np.float32)
