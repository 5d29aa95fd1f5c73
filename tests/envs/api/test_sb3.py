import warnings

import gymnasium as gym
import pytest

import dual_ur10

env_checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra train")


@pytest.mark.parametrize("env_id", dual_ur10.ENV_IDS)
def test_stable_baselines_checks_it_without_a_warning(env_id):
    env = gym.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(env.unwrapped, warn=True)
    env.close()
