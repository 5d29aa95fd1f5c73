"""Scripted policies as experts of learners that are less exact and do not know the time."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.tasks.geometry import LEARNERS_ROOM_M
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.envs.tasks.sync_carry.task import SyncCarry
from dual_ur10.errors import LostError
from dual_ur10.policies.scripted import handover

CARRY, HANDOVER = "DualUR10/SyncCarry-v0", "DualUR10/Handover-v0"
KEYWORDS = {"action_latency_ticks": 5}


def pair(env_id):
    """Return an environment and two scripted policies, of which the second is an expert."""
    env = gym.make(env_id, disable_env_checker=True, **KEYWORDS)
    acting, expert = (policies.load("scripted", env_id, **KEYWORDS) for _ in range(2))
    expert.teach()
    return env, acting, expert


@pytest.mark.parametrize(("env_id", "gripped"), [(CARRY, 220), (HANDOVER, None)])  # step after which the bar is lifted
def test_an_expert_grips_higher_and_succeeds(env_id, gripped):
    env, *both = pair(env_id)
    lowest = []
    for policy, most in zip(both, (gripped, None), strict=True):
        observation, info = env.reset(seed=2)
        height, over, steps = np.inf, False, 0
        while not over and steps != most:
            steps += 1
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
            height = min(height, env.unwrapped.task.layout.split(observation)["flange_base_m"][:, 2].min())
        assert info["is_success"] or most
        lowest.append(height)
    env.close()
    assert lowest[1] - lowest[0] == pytest.approx(LEARNERS_ROOM_M, abs=0.001)


def test_an_expert_answers_from_where_the_learner_is():
    env, *both = pair(HANDOVER)
    wrong = []
    for policy in both:
        observation, _ = env.reset(seed=2)
        seen, answers = [], []
        for _ in range(20):
            seen.append(observation)
            answers.append(policy(observation))
            observation = env.step(answers[-1])[0]
        policy.reset()
        for k in range(15):
            policy(seen[k])
        wrong.append(np.abs(policy(seen[17]) - answers[17]).max())  # the learner is two periods ahead
    env.close()
    assert np.abs(answers[17]).max() > 0.3
    assert wrong[0] > 0.5  # by the time, it would have to go back
    assert wrong[1] < 0.2


def descended(policy, env):
    """Return observations up to the one at which the giver, the left arm, has to close its gripper."""
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
        commanded = Handover.layout.split(seen[-1])["commanded_q_rad"].reshape(12)
        off.append(np.abs(commanded - motion.at(motion.duration_s)).max())
    env.close()
    assert off[0] < 1e-6
    assert 1e-3 < off[1] < 4e-3


def test_a_learner_beside_the_path_has_to_come_back_first():
    env, _, policy = pair(HANDOVER)
    seen = [each.copy() for each in descended(policy, env)]
    env.close()
    Handover.layout.split(seen[-1])["commanded_q_rad"][1] += 0.03  # an arm that has nothing to do now
    policy.reset()
    for observation in seen[:-1]:
        policy(observation)
    for _ in range(100):
        answers = policy(seen[-1]).reshape(2, 7)
        assert (answers[1, :6] < -0.5).all()
        assert answers[0, 6] == 1.0  # its fingers stay open


def until(env, policy, phase):
    """Return observations of an episode up to one in the middle of the motion of a phase."""
    observation, _ = env.reset(seed=2)
    seen = []
    while True:
        seen.append(observation)
        action = policy(observation)
        episode = policy._episodes[0]
        if episode.phase == phase and episode.motion is not None and episode.time_s > 0.5 * episode.motion.duration_s:
            return seen
        observation = env.step(action)[0]


def answer_to(policy, seen, last):
    policy.reset()
    for observation in seen[:-1]:
        policy(observation)
    return policy(last).reshape(2, 7)


@pytest.mark.parametrize("phase", [handover._MEET, handover._PLACE])
@pytest.mark.parametrize("opening_m", [0.085, 0.005])
def test_a_block_that_was_let_go_is_lost(phase, opening_m):
    """Seed 2's giver is the left arm."""
    env, acting, policy = pair(HANDOVER)
    seen = until(env, policy, phase)
    env.close()
    last = seen[-1].copy()
    Handover.layout.split(last)["gripper_m"][0 if phase == handover._MEET else 1] = opening_m
    with pytest.raises(LostError, match="has left the gripper"):
        answer_to(policy, seen, last)
    answer_to(acting, seen, last)  # on its own it continues, for the measured width may err briefly


def test_a_block_that_was_let_go_on_the_table_is_left_there():
    env, _, policy = pair(HANDOVER)
    seen = until(env, policy, handover._PLACE)
    env.close()
    last = seen[-1].copy()
    fields = Handover.layout.split(last)
    assert answer_to(policy, seen, last)[1, 6] == -1.0  # still carried
    fields["gripper_m"][1] = 0.085
    height_m = policy._paths.to_cell(pose_of(fields, "block_base")).position_m[1, 2]
    fields["block_base_m"][1, 2] -= height_m - 0.021
    assert answer_to(policy, seen, last)[1, 6] == 1.0
    episode = policy._episodes[0]
    assert episode.phase == handover._LEAVE
    assert episode.motion.at(episode.motion.duration_s)[6:] == pytest.approx(fields["commanded_q_rad"][1], abs=0.4)


def test_an_expert_grips_the_bar_where_its_path_begins():
    """The measured pose of the bar has an error, which is unknown once the bar is lifted."""
    env, *both = pair(CARRY)
    observation, _ = env.reset(seed=2)
    env.close()
    wrong = observation.copy()
    SyncCarry.layout.split(wrong)["bar_base_m"][:, :2] += 0.004
    for policy, apart in zip(both, (True, False), strict=True):
        ends = []
        for each in (observation, wrong):
            policy.reset()
            policy(each)
            motion = policy._motion[0]
            ends.append(motion.at(motion.duration_s))
        assert (np.abs(ends[1] - ends[0]).max() > 1e-3) == apart
