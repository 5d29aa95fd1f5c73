"""Differences of the reward: the same task for a learner, with less noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.core.ends import early_end
from dual_ur10.errors import MissingExtraError
from dual_ur10.types import Array

try:
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error

_FINISH: Final = "finish"
_REFUSAL: Final = "refusal"


class Differences(VecEnvWrapper):
    """Rewards for what a step has changed.

    The terms of a state, added up to s, are replaced by their change since the step before. With the discount g the
    return of the changes is 1 - g times that of s, less what the first state earns. The same policy is best, but for
    two exceptions. A finish, multiplied by 1 - g, counts for no more than a state with s = 1 that lasts for ever. A
    refused motion costs the time in which nothing changes, and 1 - g times a part of its own term: all of it from the
    beginning would keep the tools away from the table long before they can grasp. An end without success takes back
    what was earned.

    Args:
        env: Vector environment of the package.
        gamma: Discount of the learner, below 1.
        refusals: Function that returns the ratio of a refused motion's term that counts now.
    """

    def __init__(self, env: VecEnv, gamma: float, refusals: Callable[[], float] = lambda: 0.0) -> None:
        super().__init__(env)
        self._refusals = refusals
        weights = env.get_attr("core")[0].weights
        self._finish, self._refusal = weights.get(_FINISH, 0.0), weights.get(_REFUSAL, 0.0)
        self._gamma, self._before = gamma, np.full(env.num_envs, np.nan)

    def reset(self) -> Any:
        """Begin new episodes in all cells and return the observations, (rows, size)."""
        self._before[:] = np.nan
        return self.venv.reset()

    def step_wait(self) -> tuple[Any, Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all cells by one control period, as the environment does, with other rewards."""
        observation, reward, over, infos = self.venv.step_wait()
        named = f"reward/{_FINISH}", f"reward/{_REFUSAL}"
        finish, refusal = np.array([[info.get(name, 0.0) for name in named] for info in infos]).T
        finish *= self._finish
        refusal *= self._refusal
        state = reward - finish - refusal
        lost = [bool(each) and early_end(info) != "" for each, info in zip(over, infos, strict=True)]
        change = np.where(np.isnan(self._before), 0.0, state - self._before) - np.where(lost, self._gamma * state, 0.0)
        self._before = np.where(over, np.nan, state)
        once = np.minimum((1.0 - self._gamma) * finish, 1.0) + (1.0 - self._gamma) * self._refusals() * refusal
        return observation, change + once, over, infos
