"""A task of your own, in every interface: python examples/own_task.py [EPISODES]."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import gymnasium as gym
import numpy as np

from dual_ur10.tasks import (
    ARM_FIELDS,
    HOME_Q_RAD,
    Array,
    CellConfig,
    CellState,
    Field,
    Frames,
    MotionLimits,
    ObservationLayout,
    Outcome,
    Rows,
    Start,
    Task,
    Timing,
    arm_values,
    gaussian,
    register,
)


@dataclass(frozen=True)
class ReachSettings:
    """Settings of Reach, keywords of `gym.make`.

    Attributes:
        radius_m: Largest distance of a goal from the home position of its flange, along each axis.
        tolerance_m: Distance at which a goal counts as reached.
        duration_s: Duration of an episode.
    """

    radius_m: float = 0.1
    tolerance_m: float = 0.01
    duration_s: float = 4.0


@register("MyLab/Reach-v0")
class Reach(Task[ReachSettings, Array]):
    """Both flanges reach a random goal each.

    The observation of an arm: its fields of every task, then its goal in its own `base` frame.
    """

    limits: MotionLimits = MotionLimits(
        speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.0
    )
    weights: ClassVar[dict[str, float]] = {"distance": 1.0}
    settings_type: ClassVar[type[ReachSettings]] = ReachSettings
    per_arm: ClassVar[tuple[str, ...]] = ("distance_m",)
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS, Field("goal_base_m", 3, -10.0, 10.0, "position (m)", "goal of the flange", concise=(0.5,))
    )

    def __init__(self, settings: ReachSettings, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        self._frames = Frames((cell.left, cell.right))
        self._home_m = np.array([[0.0, 0.6, 0.4], [0.0, -0.6, 0.4]])  # flanges at HOME_Q_RAD with default mounts
        self._goal_m = np.zeros((n, 2, 3))

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample a goal for each arm; the arms begin at home."""
        for row, rng in zip(rows.tolist(), rngs, strict=True):
            self._goal_m[row] = self._home_m + rng.uniform(-1, 1, (2, 3)) * self.settings.radius_m
        return Start(np.broadcast_to(HOME_Q_RAD, (len(rows), 2, 6)))

    def measure(self, state: CellState) -> Array:
        """Return the distances of flanges and goals, (n, 2)."""
        return np.linalg.norm(self._goal_m - state.flange_m, axis=2)

    def observe(self, state: CellState, measured: Array, commanded_q_rad: Array) -> Array:
        """Assemble the observations in the order of the layout."""
        goal_base_m = self._frames.position_to_base(self._goal_m)
        return self.layout.join({**arm_values(state, commanded_q_rad), "goal_base_m": goal_base_m})

    def evaluate(self, state: CellState, measured: Array) -> Outcome:
        """Reward nearness; an episode succeeds if both goals are reached at its end."""
        over = state.time_s >= self.settings.duration_s - 1e-9
        success = over & (measured.max(axis=1) <= self.settings.tolerance_m)
        terms = gaussian(measured, margin=0.1)[..., None]
        return Outcome(terms, success, over, {"distance_m": measured})


if __name__ == "__main__":
    env = gym.make("MyLab/Reach-v0", radius_m=0.05)
    for episode in range(int(sys.argv[1]) if len(sys.argv) > 1 else 1):
        observation, info = env.reset(seed=episode)
        over = False
        while not over:
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            over = terminated or truncated
        print(f"episode {episode}: distances {info['distance_m'].round(3)} m, success {info['is_success']}")
    env.close()
