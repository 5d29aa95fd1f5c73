"""TorchRL's own wrappers and check: `make test-torchrl` installs it and runs them."""

import gymnasium as gym
import pytest

from dual_ur10 import ENV_IDS
from dual_ur10.envs import parallel_env

pytestmark = pytest.mark.filterwarnings("ignore")  # of TorchRL about itself
envs = pytest.importorskip("torchrl.envs", reason="needs TorchRL: make test-torchrl", exc_type=ImportError)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_torchrl_makes_an_environment_from_an_id(env_id):
    env = envs.GymEnv(env_id, max_episode_steps=30)
    envs.check_env_specs(env)
    found = env.rollout(40, break_when_any_done=False)
    assert found["next", "done"].any()
    env.close()


def test_torchrl_wraps_a_gymnasium_environment_of_single_precision():
    env = envs.GymWrapper(gym.make(ENV_IDS[0], observation_dtype="float32"))
    envs.check_env_specs(env)
    env.close()


@pytest.mark.parametrize("reward", ["shared", "individual"])
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_torchrl_wraps_two_agents_over_episodes(env_id, reward):
    env = envs.PettingZooWrapper(parallel_env(env_id, reward=reward, randomization="mild", max_cycles=20))
    envs.check_env_specs(env)
    found = env.rollout(60, break_when_any_done=False)  # random actions: the gate ends some episodes
    assert found["next", "done"].any()
    env.close()
