"""A Gymnasium environment with one key per agent, as datasets hold them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from dual_ur10.envs.api.dual_arm_env import numbers_of
from dual_ur10.envs.api.two_agents import agent_spaces, check_options, joint_action
from dual_ur10.errors import ActionError
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array


class AgentDictWrapper(gym.Wrapper[dict[str, Array], dict[str, NDArray[Any]], Any, Any], RecordConstructorArgs):
    """Environment whose observations and actions are dicts with the keys "left" and "right".

    Each agent's observation and action are those of `dual_ur10.envs.api.parallel_env.DualArmParallelEnv`; the reward is
    that of both together. Infos hold the numbers of those of `DualArmEnv`, with the same keys after a reset.

    Minari's `recover_environment` makes it for the datasets of this package, and its `DataCollector` around it makes
    such datasets.

    Args:
        env: Environment of this package, made by `gym.make`.

    Attributes:
        info: Info of the last step or reset as `DualArmEnv` returns it.

    Raises:
        SettingsError: Pixels are observed.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self.info: dict[str, Any] = {}
        self._names: frozenset[str] = frozenset()
        self._core = core = env.unwrapped.core  # type: ignore[attr-defined]  # an environment of this package
        check_options("shared", {"observation": core.options.observation})
        core.keeps_start = True  # the infos of a reset have all keys
        observation, action = agent_spaces(core)
        self._shape = action[0].shape
        self.observation_space: Any = spaces.Dict(dict(zip(ARMS, observation, strict=True)))
        self.action_space: Any = spaces.Dict(dict(zip(ARMS, action, strict=True)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`."""
        _, self.info = self.env.reset(seed=seed, options=options)
        measured = {name: value for name, value in self.info.items() if isinstance(value, np.ndarray)}
        numbers = measured | numbers_of(self._core.initial_info())
        self._names = frozenset(numbers)
        return self._observation(), numbers

    def step(self, action: dict[str, NDArray[Any]]) -> tuple[dict[str, Array], Any, bool, bool, dict[str, Any]]:
        """Advance one policy period; see `gymnasium.Env.step`.

        Raises:
            ActionError: There is not one action for each agent, or one is malformed. Nothing has moved.
        """
        try:
            joint: Any = joint_action(action, self._shape)
        except ActionError as error:
            self._core.stop(f"the policy's action was refused: {error}")
            raise
        _, reward, terminated, truncated, self.info = self.env.step(joint)
        numbers = {name: value for name, value in self.info.items() if name in self._names}
        return self._observation(), reward, terminated, truncated, numbers

    def _observation(self) -> dict[str, Array]:
        own = self._core.agents.observations[0]
        return {arm: own[side].copy() for side, arm in enumerate(ARMS)}
