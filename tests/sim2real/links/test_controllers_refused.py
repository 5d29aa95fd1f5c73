"""What is refused on a cell of two controllers, on every way to it; none of it needs a controller."""

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import Perturbation
from dual_ur10.envs import dm_env
from dual_ur10.envs.api.dual_arm_env import DualArmEnv
from dual_ur10.envs.api.parallel_env import parallel_env
from dual_ur10.envs.core.cells import check_for_controllers
from dual_ur10.envs.core.randomization import Randomization
from dual_ur10.envs.core.sensing import Sensing
from dual_ur10.errors import ResetNeededError, SettingsError
from dual_ur10.sim2real.config.cell_file import load_cell_file, starting_text
from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell

SINE, HANDOVER = "DualUR10/SineTracking-v0", "DualUR10/Handover-v0"
BY_THEMSELVES = "episodes that begin by themselves, as in training, on a cell of controllers"


@pytest.fixture(params=["real", "emulated"])
def path(request, tmp_path, monkeypatch):
    """A cell file of controllers that nobody gets to."""

    def reached(*_, **__):
        pytest.fail("it came to the controllers")

    monkeypatch.setattr(RtdeCell, "__init__", reached)
    hosts = ("192.0.2.1", "192.0.2.2") if request.param == "real" else ("127.0.0.2", "127.0.0.3")
    file = tmp_path / "lab.toml"
    file.write_text(starting_text(request.param, *hosts))
    return str(file)


@pytest.fixture
def arms(path):
    """A simulated environment that takes its cell for one of controllers."""
    env = DualArmEnv("SineTracking", duration_s=0.2)
    env.core.config = load_cell_file(path).config()
    yield env
    env.close()


def run(env, action):
    """Beyond the end of an episode."""
    for _ in range(10):
        env.step(action)


@pytest.mark.parametrize("mode", ["sync", "async", "vector_entry_point"])
def test_vector_environments_are_refused_before_anything_is_connected(path, mode):
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        gym.make_vec(HANDOVER, num_envs=1, vectorization_mode=mode, cell=path)


def test_gymnasiums_own_vector_environment_is_refused_where_it_resets_by_itself(arms):
    env = gym.vector.SyncVectorEnv([lambda: arms])
    env.reset(seed=0)
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        run(env, env.action_space.sample())


def test_the_wrapper_that_resets_by_itself_is_refused_where_it_does(arms):
    env = gym.wrappers.Autoreset(arms)
    env.reset(seed=0)
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        run(env, env.action_space.sample())


def test_a_vector_environment_that_leaves_resets_to_the_program_is_none_of_them(arms):
    env = gym.vector.SyncVectorEnv([lambda: arms], autoreset_mode="Disabled")
    for _ in range(2):
        env.reset(seed=0)
        env.step(env.action_space.sample())


def test_a_program_resets_as_often_as_it_likes(arms):
    env = gym.wrappers.TimeLimit(gym.wrappers.RecordEpisodeStatistics(arms), 3)
    for _ in range(2):
        env.reset(seed=0)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass


def test_stable_baselines3_is_refused_on_every_way(path, arms):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from stable_baselines3.common.vec_env import DummyVecEnv

    from dual_ur10.envs.api.sb3_bridge import JointVecEnv, TwoAgentVecEnv

    for kind in (JointVecEnv, TwoAgentVecEnv):
        with pytest.raises(SettingsError, match=BY_THEMSELVES):
            kind("SineTracking", 1, cell=path)
        with pytest.raises(SettingsError, match="2 environments on one cell"):
            kind("SineTracking", 2, cell=path)
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        DummyVecEnv([lambda: gym.make(SINE, cell=path)])
    env = DummyVecEnv([lambda: arms])
    env.reset()
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        run(env, [env.action_space.sample()])


def test_dm_env_does_not_begin_an_episode_in_a_step(path):
    env = dm_env(SINE, duration_s=0.2)
    env.env.core.config = load_cell_file(path).config()
    action = np.zeros(12, dtype=np.float32)
    with pytest.raises(ResetNeededError, match=r"call reset\(\) first"):
        env.step(action)
    for _ in range(2):
        step = env.reset()
        while not step.last():
            step = env.step(action)
        with pytest.raises(ResetNeededError, match=r"on a cell of controllers none begins by itself"):
            env.step(action)
    env.close()


def test_two_agents_are_not_refused(path):
    with pytest.raises(pytest.fail.Exception, match="it came to the controllers"):
        parallel_env("SineTracking", cell=path)


def test_nothing_is_added_to_what_controllers_measure(path):
    config = load_cell_file(path).config()
    core = DualArmEnv("Handover").core
    config = config.furnished(core.config.equipment, 0.001, "compliant")
    assert config.equipment.grippers
    assert Sensing(config, Randomization(), 0.04, 1).is_exact
    assert not Sensing(core.config, Randomization(), 0.04, 1).is_exact
    core.close()


def test_what_is_believed_of_a_simulated_plant_is_refused(path):
    from dataclasses import replace

    config = load_cell_file(path).config()
    check_for_controllers(config, 1, autoreset=False, randomized=False)
    with pytest.raises(SettingsError, match="randomization is of simulated cells"):
        check_for_controllers(config, 1, autoreset=False, randomized=True)
    shifted = replace(config, perturbation=Perturbation(base_shift_m=0.01))
    with pytest.raises(SettingsError, match="a perturbation is of simulated cells"):
        check_for_controllers(shifted, 1, autoreset=False, randomized=False)
