"""Running one episode."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.cell.cell_config import CellConfig


class Still:
    """A policy that counts its calls."""

    def __init__(self) -> None:
        self.resets = self.calls = 0

    def reset(self) -> None:
        self.resets += 1

    def __call__(self, observation: Any) -> Any:
        self.calls += 1
        return np.zeros(12)


class Refusing:
    """An environment whose gate refuses the third step."""

    def __init__(self) -> None:
        self.action_space = gym.spaces.Box(-1, 1, (12,), np.float32)
        core = SimpleNamespace(timing=SimpleNamespace(period_s=0.04), config=CellConfig())
        self.unwrapped = SimpleNamespace(core=core)
        self.steps = 0

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(3), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.dtype == np.float32
        self.steps += 1
        info: dict[str, Any] = {"q_rad": np.zeros((2, 6)), "flange_m": np.zeros((2, 3))}
        if self.steps == 3:
            info |= {"safety": "too close", "end_reason": "refused/distance"}
        return np.zeros(3), 0.5, self.steps == 3, False, info


def test_an_episode_is_recorded_from_its_first_step_to_its_end() -> None:
    env, policy, seen = gym.make("DualUR10/SineTracking-v0", duration_s=0.4), Still(), []
    record = rollout(env, policy, seed=1, on_step=lambda info: seen.append(info["flange_m"]))
    env.close()
    assert (policy.resets, policy.calls, record.steps) == (1, 10, 10)
    assert np.allclose(record.time_s, 0.04 * np.arange(1, 11))
    assert record.q_rad.shape == (10, 2, 6)
    assert np.array_equal(record.flange_m, np.array(seen))
    assert record.reference_m is not None
    assert record.reference_m.shape == (10, 2, 3)
    assert record.ended_by == ""


def test_same_seed_same_record() -> None:
    env = gym.make("DualUR10/SineTracking-v0", duration_s=0.4)
    first, again, other = (rollout(env, Still(), seed=seed) for seed in (7, 7, 8))
    env.close()
    assert np.array_equal(first.q_rad, again.q_rad)
    assert not np.array_equal(first.q_rad, other.q_rad)


def test_a_refused_motion_is_named() -> None:
    record = rollout(Refusing(), Still())
    assert (record.steps, record.ended_by, record.success) == (3, "too close", False)
    assert record.reward.sum() == 1.5
    assert record.reference_m is None
