"""The four tasks that are one file each: what holds for all of them."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dual_ur10.policies import evaluate, load

LED = ("PegInsertion", "TrayBalance", "LidAndPlace")
MODE = {"action_mode": "tcp_delta"}


@pytest.mark.parametrize(("action_mode", "observation"), [("joint_delta", "state"), ("tcp_delta", "goals")])
@pytest.mark.parametrize("name", [*LED, "BoxLift"])
def test_gymnasium(name, action_mode, observation):
    env_id = f"DualUR10/{name}-v0"
    with gym.make(env_id, duration_s=0.2, action_mode=action_mode, observation=observation) as env:
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", LED)
def test_goals_lead_through_all_stages(name):
    keywords = {**MODE, "randomization": "mild", "on_refusal": "terminate"}
    (episode,) = evaluate(name, "scripted", episodes=1, env_kwargs=keywords).episodes
    assert episode.success
    assert max(episode.peak["force_n/left"], episode.peak["force_n/right"]) < 60


@pytest.mark.parametrize("name", LED)
def test_a_state_that_is_observed_again_has_the_same_goals(name):
    keywords = {**MODE, "randomization": "mild"}
    with gym.make(f"DualUR10/{name}-v0", **keywords) as env:
        follower, core = load("scripted", name, **keywords), env.unwrapped.core
        observation, _ = env.reset(seed=0)
        for _ in range(280):  # beyond the grasp
            observation, *_ = env.step(follower(observation))
        assert core.task.passed[0] > 0
        state, commanded_q_rad = core._state, core.pipeline.adapter.commanded_q_rad
        measured = core.task.measure(state)
        first = core.task.observe(state, measured, commanded_q_rad)
        assert np.array_equal(core.task.observe(state, measured, commanded_q_rad), first)
