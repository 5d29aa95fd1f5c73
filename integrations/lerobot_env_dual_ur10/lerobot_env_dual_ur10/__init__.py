"""Tasks of dual_ur10 as environments of LeRobot: `--env.type=dual_ur10`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from dual_ur10.lerobot.features import ACTION, ENVIRONMENT_STATE, STATE
from dual_ur10.lerobot.gym_view import LeRobotView
from dual_ur10.policies.learned.lerobot_files import image_key

__all__ = ["DualUR10EnvConfig"]


@EnvConfig.register_subclass("dual_ur10")
@dataclass
class DualUR10EnvConfig(EnvConfig):
    """Settings of an environment, whose actions and observations are those of exported datasets.

    Attributes:
        task: Id of the environment, or its short form.
        fps: Steps per second: `policy_rate_hz` of the environment.
        images: Cameras whose images are observed.
        width, height: Size of an image.
        episode_length: Steps after which an episode ends; None: the horizon of the task.
        settings: Further keywords of the environment, such as {"randomization": "mild"}.
    """

    task: str | None = "Handover"
    fps: int = 25
    images: list[str] = field(default_factory=list)
    width: int = 320
    height: int = 240
    episode_length: int | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        env = LeRobotView(**self.gym_kwargs)
        try:
            observed: Any = env.observation_space
            self.features = {
                ACTION: PolicyFeature(FeatureType.ACTION, env.action_space.shape),
                "agent_pos": PolicyFeature(FeatureType.STATE, observed["agent_pos"].shape),
                "environment_state": PolicyFeature(FeatureType.ENV, observed["environment_state"].shape),
            }
        finally:
            env.close()
        self.features_map = {ACTION: ACTION, "agent_pos": STATE, "environment_state": ENVIRONMENT_STATE}
        for each in self.images:
            key = image_key(each)
            name = f"pixels/{key.rpartition('.')[2]}"
            self.features[name] = PolicyFeature(FeatureType.VISUAL, (self.height, self.width, 3))
            self.features_map[name] = key

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `LeRobotView`."""
        shown = {"cameras": tuple(self.images), "height": self.height, "width": self.width} if self.images else {}
        return {
            "task": self.task,
            "episode_length": self.episode_length,
            "policy_rate_hz": float(self.fps),
            "render_mode": "rgb_array",
            **shown,
            **self.settings,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return the environments, one after the other in this process."""
        make = partial(LeRobotView, **self.gym_kwargs)
        vector = gym.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
        return {self.type: {0: vector}}
