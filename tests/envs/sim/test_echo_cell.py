"""Dry run: the state is what was commanded, through the same adapter and safety gate, and it is flagged as such."""

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import ClosedError, SettingsError
from dual_ur10.policies import load
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.recording.reader import read_run

ID = "DualUR10/SineTracking-v0"


def episode(cell, **keywords):
    env = gym.make(ID, cell=cell, duration_s=2.0, disable_env_checker=True, **keywords)
    policy = load("scripted", ID, cell=cell, duration_s=2.0)
    observation, info = env.reset(seed=0)
    policy.reset()
    infos, done = [info], False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        infos.append(info)
        done = terminated or truncated
    env.close()
    return infos


def test_it_is_where_an_ideal_arm_is_and_says_so():
    echoed, simulated = episode("echo"), episode("mujoco")
    assert all(info["state_is_commanded"] for info in echoed)
    assert not any("state_is_commanded" in info for info in simulated)
    assert echoed[-1]["is_success"]
    a, b = (np.array([info["q_rad"] for info in infos]) for infos in (echoed, simulated))
    assert np.abs(a - a[0]).max() > 0.1
    np.testing.assert_allclose(a, b, atol=2e-4)  # the simulated servos follow, nearly


def test_the_safety_gate_is_in_force():
    keywords = {"action_mode": "joint_position", "on_refusal": "terminate", "at_limits": "refuse"}
    env = gym.make(ID, cell="echo", disable_env_checker=True, **keywords)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(200):
        _, _, terminated, _, info = env.step(action)
        if terminated:
            break
    assert "safety" in info
    env.close()


def test_its_record_says_what_it_is(tmp_path):
    env = gym.make(ID, cell="echo", disable_env_checker=True, record=tmp_path)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.full(env.action_space.shape, 0.1, dtype=np.float32))
    env.close()
    run = read_run(next(tmp_path.iterdir()))
    assert run.header.source == "echo"
    assert len(run.arms[0].state["q_rad"]) == 15


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_speeds_are_those_of_the_positions(factor):
    env = gym.make(ID, cell=CellConfig(kind="echo", speed_factor=factor), policy_rate_hz=125, disable_env_checker=True)
    env.reset(seed=0)
    cell, last = env.unwrapped.core.cell, None
    for step in range(60):
        env.step(np.full(env.action_space.shape, 0.2 * np.sin(step / 8), dtype=np.float32))
        state = env.unwrapped.core._state
        if last is not None:
            np.testing.assert_allclose((state.q_rad - last[0]) / 0.008, (state.qd_rad_s + last[1]) / 2, atol=0.02)
        last = state.q_rad.copy(), state.qd_rad_s.copy()
    assert np.abs(last[1]).max() > 0.01
    env.close()
    env.close()
    with pytest.raises(ClosedError):
        cell.model_and_data(0)


@pytest.mark.parametrize(
    ("env_id", "keywords", "words"),
    [
        (ID, {"cell": CellConfig(kind="echo").with_perturbation(latency_s=0.01)}, "perturbation"),
        (ID, {"cell": "echo", "randomization": "mild"}, "randomization"),
    ],
)
def test_what_it_cannot_show_is_refused(env_id, keywords, words):
    with pytest.raises(SettingsError, match=words):
        gym.make(env_id, disable_env_checker=True, **keywords)


def test_objects_stay_where_an_episode_begins():
    env = gym.make("DualUR10/Handover-v0", cell="echo", disable_env_checker=True)
    twin = gym.make("DualUR10/Handover-v0", disable_env_checker=True)
    seen, wanted = env.reset(seed=5)[0], twin.reset(seed=5)[0]
    split = env.unwrapped.task.layout.split
    assert np.allclose(split(seen)["block_base_m"], split(wanted)["block_base_m"], atol=1e-9)
    for _ in range(3):
        observation, *_, info = env.step(env.action_space.sample())
    assert np.array_equal(split(observation)["block_base_m"], split(seen)["block_base_m"])
    assert info["state_is_commanded"]
    env.close()
    twin.close()


def test_it_is_one_cell():
    with pytest.raises(SettingsError, match="one cell"):
        gym.make_vec(ID, num_envs=2, cell="echo")


def test_it_can_be_rendered_from():
    env = gym.make(ID, cell="echo", disable_env_checker=True)
    env.reset(seed=0)
    _, data = env.unwrapped.core.cell_data(0)
    assert np.isfinite(data.qpos).all()
    env.close()
