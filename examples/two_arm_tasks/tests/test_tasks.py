"""The task on every interface, in short episodes; and whole ones by its scripted policy."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test
from typer.testing import CliRunner

from dual_ur10.cli.main import app
from dual_ur10.envs import dm_env, parallel_env
from dual_ur10.ids import TASKS, env_id_of
from dual_ur10.policies import evaluate, load
from dual_ur10.tasks import SettingsError
from dual_ur10.testing import VirtualCell

ID = env_id_of("CupOnTray")  # which reads the entry point
REFUSALS_END = {"on_refusal": "terminate"}


def run(*arguments):
    """Run a command of dual_ur10, and return what it writes."""
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exit_code == 0, done.output
    return done.output


def test_its_package_registers_it():
    assert ID == "TwoArm/CupOnTray-v0"
    assert TASKS[ID].task.startswith("two_arm_tasks.")


def test_gymnasium():
    with gym.make(ID, duration_s=0.2) as env:
        check_env(env.unwrapped, skip_render_check=True)


def test_rows_of_a_vector_are_single_environments():
    envs, env = gym.make_vec(ID, num_envs=2, randomization="mild"), gym.make(ID, randomization="mild")
    rows, _ = envs.reset(seed=[3, 4])
    actions = envs.action_space.sample()
    after, rewards, *_ = envs.step(actions)
    for row in (0, 1):
        assert np.array_equal(rows[row], env.reset(seed=3 + row)[0])
        observation, reward, *_ = env.step(actions[row])
        assert np.array_equal(after[row], observation)
        assert rewards[row] == reward


def test_a_stock_learner_trains_on_the_concise_view():
    learners = pytest.importorskip("stable_baselines3")
    from dual_ur10.envs.api.sb3_bridge import JointVecEnv

    env = JointVecEnv(ID, 2, observation="goals", action_scale=0.5, max_episode_steps=100)
    learners.PPO("MlpPolicy", env, n_steps=4, batch_size=8, n_epochs=1).learn(16)
    assert env.observation_space.contains(env.reset()[0])
    env.close()


def test_pettingzoo():
    parallel_api_test(parallel_env(ID, duration_s=0.2), num_cycles=10)


def test_dm_env():
    env = dm_env(ID, seed=0, duration_s=0.2)
    step, specification = env.reset(), env.action_spec()
    while not step.last():
        step = env.step(np.zeros(specification.shape, specification.dtype))
    assert np.isfinite(step.reward)


def test_the_scripted_policy_succeeds():
    keywords = {"randomization": "mild", **REFUSALS_END}
    assert evaluate(ID, "scripted", episodes=1, env_kwargs=keywords).success_rate == 1.0


class OneArm:
    """Scripted policy of one arm; the other one does not move, and its gripper stays open."""

    def __init__(self, arm):
        self.script, self.other = load("scripted", ID), 1 - arm

    def reset(self):
        self.script.reset()

    def __call__(self, observation):
        action = self.script(observation).reshape(2, 7)
        action[self.other] = [0.0] * 6 + [1.0]
        return action.reshape(-1)


@pytest.mark.parametrize("arm", [0, 1], ids=["left", "right"])
def test_one_arm_alone_cannot_succeed(arm):
    env = gym.make(ID, duration_s=9.0, **REFUSALS_END)
    policy, (observation, _), over = OneArm(arm), env.reset(seed=0), False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        over = terminated or truncated
    assert not info["is_success"]
    assert info["stage"] == 0  # the first stage, which both pass after 7 s at the latest, is to hold with both


def test_loads_and_coupling_follow_the_stages():
    with gym.make(ID) as env:
        env.reset(seed=0)
        task = env.unwrapped.core.task
        for passed, load_kg, coupled in ((0, (0.0, 0.0), False), (1, (0.6, 0.6), True), (3, (0.6, 0.6), True)):
            task.passed[:] = passed
            assert tuple(task.load_kg()[0]) == load_kg
            assert task.coupled().tolist() == [coupled]


def test_the_command_line_evaluates():
    assert "0 of 1" in run("evaluate", "CupOnTray", "--policy", "scripted", "--episodes", 1, "--set", "duration_s=1")


def test_the_command_line_records_and_replays(tmp_path):
    run("rollout", "CupOnTray", "--episodes", 1, "--set", "duration_s=1", "--record", tmp_path)
    (record,) = tmp_path.iterdir()
    assert "as recorded" in run("replay", record, "--no-record")


def test_a_virtual_cell_carries_with_coupled_arms():
    """Two emulated controllers on a virtual clock: adapter, gate, supervisor, trackers, loads and coupled arms."""
    with VirtualCell(task="CupOnTray", plant="mild") as cell:
        env, policy = cell.make(ID), load("scripted", ID, cell=cell)
        observation, info = env.reset(seed=0)
        over, stage = False, 0
        while stage < 2 and not over:  # the tray is lifted
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over, stage = terminated or truncated, info["stage"]
        assert stage == 2, info["end_reason"]
        assert not cell.fault


def test_settings_have_ranges():
    with pytest.raises(SettingsError, match="object_range_m"):
        gym.make(ID, object_range_m=1.0)
