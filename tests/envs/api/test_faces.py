"""A pickled copy of an environment continues bit for bit, through each interface and over the end of an episode."""

import importlib
import pickle

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo.utils.conversions import aec_to_parallel

from dual_ur10.envs import aec_env, parallel_env
from tests.envs.equality import equal
from ur_core.kinematics.ur10 import ARMS

SINE = "DualUR10/SineTracking-v0"
SHORT = {"duration_s": 0.24}
IMAGES = {"observation": "both", "pixels_rate_hz": 25 / 3, "width": 48, "height": 40, **SHORT}


def dm():
    pytest.importorskip("dm_env")
    return importlib.import_module("dual_ur10.envs").dm_env(SINE, seed=3, **SHORT)


def learners():
    pytest.importorskip("stable_baselines3")
    return importlib.import_module("dual_ur10.envs.api.sb3_bridge").TwoAgentVecEnv(SINE, 2, max_episode_steps=6)


# What makes an environment, the shape of its actions, and how many of the values that a step returns are compared.
FACES = {
    "dm_env": (dm, (12,), 4),
    "parallel": (lambda: parallel_env(SINE, reward="individual", max_cycles=6), (2, 6), 5),
    "aec": (lambda: aec_env(SINE, reward="individual", max_cycles=6), (2, 6), 5),
    "learners": (learners, (4, 6), 3),
    "vector": (lambda: gym.make_vec(SINE, num_envs=2, **SHORT), (2, 12), 4),
    "images": (lambda: gym.make(SINE, **IMAGES), (12,), 4),
    "vector of images": (lambda: gym.make_vec(SINE, num_envs=2, threads=1, **IMAGES), (2, 12), 4),
}


@pytest.mark.parametrize("face", FACES)
def test_a_pickled_copy_continues_bit_for_bit(face):
    make, shape, compared = FACES[face]
    env, rng = make(), np.random.default_rng(0)
    actions = rng.uniform(-0.3, 0.3, (8, *shape)).astype(np.float32)

    def play(env, actions):
        two = aec_to_parallel(env) if face == "aec" else env
        by_arm = face in ("aec", "parallel")
        return [two.step(dict(zip(ARMS, each, strict=True)) if by_arm else each)[:compared] for each in actions]

    env.reset(**({} if face in ("dm_env", "learners") else {"seed": 0}))
    play(env, actions[:3])
    copy = pickle.loads(pickle.dumps(env))
    last = 6 if face in ("aec", "parallel") else 8  # agents are gone at the end
    for ours, theirs in zip(play(env, actions[3:last]), play(copy, actions[3:last]), strict=True):
        assert all(equal(one, other) for one, other in zip(ours, theirs, strict=True))
