"""An environment as LeRobot evaluates policies in it: positions as actions, and observations by its names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.lerobot.features import words_of
from dual_ur10.lerobot.positions import Positions
from dual_ur10.policies.learned.lerobot_files import IMAGES, image_key, image_keys
from dual_ur10.policies.learned.signature import view_of_env

_INSTEAD: Final = {
    "max_episode_steps": "give episode_length instead",
    "disable_env_checker": "leave it out",
    "action_mode": "leave it out, actions are joint positions",
    "observation": "leave it out, and give cameras for images",
}
STATE, ENVIRONMENT, PIXELS = "agent_pos", "environment_state", "pixels"


class LeRobotView(gym.Wrapper[dict[str, Any], Any, Any, Any]):
    """An environment whose numbers are those of an exported dataset.

    Observations are `agent_pos`, commanded joints and measured gripper widths; `environment_state`, the whole
    observation in float32; and `pixels`, images by camera. An action is what a dataset's `action` is: joints in rad,
    and grippers from 0, closed, to 1, open.

    Args:
        task: Id of the environment, or its short form.
        episode_length: Steps after which an episode is truncated; None: the horizon of the task.
        **keywords: Further keywords; with `cameras`, images are observed.

    Attributes:
        task: Short name of the environment.
        task_description: Its name in words.

    Raises:
        SettingsError: The task has no horizon and no length is given, or a keyword is one that the view itself sets.
        DualUR10Error: A name or a value is not legal.
    """

    def __init__(self, task: str, *, episode_length: int | None = None, **keywords: Any) -> None:
        env_id = env_id_of(task)
        for name, instead in _INSTEAD.items():
            if name in keywords:
                raise SettingsError(f"{name} is set by {type(self).__name__} itself: {instead}")
        self._pictured = "cameras" in keywords
        made = {**keywords, "action_mode": "joint_position", "observation": "both" if self._pictured else "state"}
        env = gym.make(env_id, max_episode_steps=episode_length, disable_env_checker=True, **made)
        super().__init__(env)
        try:
            horizon = episode_length or env.unwrapped.task.horizon  # type: ignore[attr-defined]  # of our environments
            if horizon is None:
                raise SettingsError(f"episodes of {env_id} do not end: give them a length, such as episode_length=500")
            self.positions = Positions(view_of_env(env))
        except BaseException:
            env.close()
            raise
        self._max_episode_steps = int(horizon)
        self.task, self.task_description = task, words_of(env_id)
        size = len(self.positions.names)
        self.action_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        shown: Any = env.observation_space
        numbers = shown["state"] if self._pictured else shown
        observed: dict[str, spaces.Space[Any]] = {
            STATE: spaces.Box(-np.inf, np.inf, (size,), np.float32),
            ENVIRONMENT: spaces.Box(-np.inf, np.inf, numbers.shape, np.float32),
        }
        if self._pictured:
            image_keys(tuple(shown["pixels"]))  # no two are one
            observed[PIXELS] = spaces.Dict({_name(each): space for each, space in shown["pixels"].items()})
        self.observation_space = spaces.Dict(observed)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Begin an episode. LeRobot's own options are not those of the environment, and are left out."""
        kept = {name: value for name, value in (options or {}).items() if not name.startswith("lerobot_")}
        observation, info = self.env.reset(seed=seed, options=kept)
        return self._shown(observation), info

    def step(self, action: NDArray[np.floating]) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Command positions, (12 or 14,), and advance one step."""
        observation, reward, terminated, truncated, info = self.env.step(self.positions.action(action))
        return self._shown(observation), reward, terminated, truncated, info

    def _shown(self, observation: Any) -> dict[str, Any]:
        numbers = observation["state"] if self._pictured else observation
        found = {STATE: self.positions.state(numbers[None])[0], ENVIRONMENT: numbers.astype(np.float32)}
        if self._pictured:
            found[PIXELS] = {_name(each): image for each, image in observation["pixels"].items()}
        return found


def _name(camera: str) -> str:
    return image_key(camera).removeprefix(IMAGES)
