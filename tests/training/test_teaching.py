"""Scripted policies as teachers of pupils who are not so exact, and do not know what time it is."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.policies.carrying import TAUGHT_HIGHER_M

CARRY, HANDOVER = "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0"
KEYWORDS = {"action_latency_ticks": 5}
COMMANDED, HEIGHT = slice(12, 18), 20


def pair(env_id):
    """An environment at its beginning, and two policies, of which the second teaches."""
    env = gym.make(env_id, disable_env_checker=True, **KEYWORDS)
    acting, teaching = (policies.load("scripted", env_id, **KEYWORDS) for _ in range(2))
    teaching.teach()
    return env, acting, teaching


@pytest.mark.parametrize("env_id", [CARRY, HANDOVER])
def test_a_teacher_grips_higher_and_succeeds(env_id):
    env, *both = pair(env_id)
    lowest = []
    for policy in both:
        observation, info = env.reset(seed=2)
        height, over = np.inf, False
        while not over:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
            height = min(height, observation.reshape(2, -1)[:, HEIGHT].min())
        assert info["is_success"]
        lowest.append(height)
    env.close()
    assert lowest[1] - lowest[0] == pytest.approx(TAUGHT_HIGHER_M, abs=0.001)


def test_a_pupil_is_told_how_to_go_on_from_where_it_is():
    env, *both = pair(HANDOVER)
    wrong = []
    for policy in both:
        observation, _ = env.reset(seed=2)
        seen, told = [], []
        for _ in range(20):
            seen.append(observation)
            told.append(policy(observation))
            observation = env.step(told[-1])[0]
        policy.reset()
        for k in range(15):
            policy(seen[k])
        wrong.append(np.abs(policy(seen[17]) - told[17]).max())  # the pupil is two periods ahead
    env.close()
    assert np.abs(told[17]).max() > 0.3
    assert wrong[0] > 0.5  # by the time, it is to go back
    assert wrong[1] < 0.2


def descended(policy, env):
    """Observations up to the one at which the giver, which is the left arm, is told to close."""
    observation, _ = env.reset(seed=2)
    seen = []
    while True:
        seen.append(observation)
        action = policy(observation)
        if action[6] < 0.0:
            return seen
        observation = env.step(action)[0]


def test_a_motion_is_over_near_its_end():
    env, *both = pair(HANDOVER)
    off = []
    for policy in both:
        seen = descended(policy, env)
        motion = policy._episodes[0].motion
        off.append(np.abs(seen[-1].reshape(2, -1)[:, COMMANDED].reshape(12) - motion.at(motion.duration_s)).max())
    env.close()
    assert off[0] < 1e-6
    assert 1e-3 < off[1] < 4e-3


def test_a_pupil_beside_the_way_is_told_to_come_back_before_it_goes_on():
    env, _, policy = pair(HANDOVER)
    seen = [each.copy() for each in descended(policy, env)]
    env.close()
    seen[-1].reshape(2, -1)[1, COMMANDED] += 0.03  # an arm that has nothing to do now
    policy.reset()
    for observation in seen[:-1]:
        policy(observation)
    for _ in range(100):
        told = policy(seen[-1]).reshape(2, 7)
        assert (told[1, :6] < -0.5).all()
        assert told[0, 6] == 1.0  # its fingers stay open
