"""Policies that follow the goals of tools: no stage is known to them, and the goals lead through all of them."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.free.task import Free
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.errors import ActionError, SettingsError, UnknownNameError
from dual_ur10.policies.policy import Policy
from dual_ur10.policies.scripted.goal_follower import GoalFollower
from tests.soak import SOAK, scaled

CARRY, HANDOVER, MODE = "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0", {"action_mode": "tcp_delta"}


@pytest.mark.parametrize(
    "keywords",
    [
        {"giver": "right"},
        {"giver": "random", "randomization": "mild", "action_latency_ticks": 5},
        {"robot": "ur5e", "action_latency_ticks": 20},
    ],
)
def test_every_block_is_placed(keywords):
    n = scaled(8)
    core, follower = (
        Core("Handover", {**MODE, **keywords}, n=n),
        policies.load("scripted", HANDOVER, **MODE, **keywords),
    )
    observation, _ = core.reset([np.random.default_rng(seed) for seed in range(n)])
    success = np.zeros(n, dtype=bool)
    for _ in range(core.task.horizon):
        step = core.step(follower(observation))
        observation = step.observation
        success |= step.info["is_success"]
        if success.all():
            return
    raise AssertionError(success)


def test_every_bar_is_carried():
    n, keywords = 4 if SOAK else 1, {**MODE, "randomization": "mild", "action_latency_ticks": 5}
    core, follower = Core("SyncCarry", keywords, n=n), policies.load("scripted", CARRY, **keywords)
    observation, _ = core.reset([np.random.default_rng(seed) for seed in range(n)])
    for _ in range(core.task.horizon):
        step = core.step(follower(observation))
        observation = step.observation
    assert step.info["is_success"].all()
    assert step.info["relative_error_m"].max() < 2e-3


def test_actions_have_the_shape_of_the_observations_and_no_memory():
    env, follower = gym.make(HANDOVER, **MODE), policies.load("scripted", HANDOVER, **MODE)
    assert isinstance(follower, GoalFollower)
    assert isinstance(follower, Policy)
    observation, _ = env.reset(seed=0)
    one = follower(observation)
    assert one.dtype == np.float32
    assert env.action_space.contains(one)
    both = follower(np.stack([observation, observation]))
    assert np.array_equal(both, np.stack([one, one]))
    follower.reset()
    assert np.array_equal(follower(observation), one)
    with pytest.raises(ActionError, match="Handover"):
        follower(observation[:-1])


def test_another_action_mode_is_refused():
    with pytest.raises(UnknownNameError, match="joint_delta"):
        GoalFollower(Handover, Core("Handover", MODE).timing, "joint_delta")


def test_a_task_without_goals_is_refused():
    with pytest.raises(SettingsError, match="Free observes no goal_step_m and no goal_rotation"):
        GoalFollower(Free, Core("Free", MODE).timing)
