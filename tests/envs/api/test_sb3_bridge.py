import itertools
import re

import numpy as np
import pytest

import dual_ur10
from dual_ur10 import errors
from dual_ur10.envs import parallel_env
from tests.envs.equality import equal
from tests.soak import scaled
from ur_core.kinematics.ur10 import ARMS

IDS = dual_ur10.ENV_IDS
SINE = "DualUR10/SineTracking-v0"
WAYS = [("joint_delta", 0, "shared"), ("joint_delta", 3, "individual"), ("tcp_delta", 0, "individual")]


stable_baselines3 = pytest.importorskip("stable_baselines3", reason="needs the extra train")

from stable_baselines3.common.monitor import Monitor  # noqa: E402  # skipped above
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize  # noqa: E402  # as above

from dual_ur10.envs.api.sb3_bridge import JointVecEnv, TwoAgentVecEnv, hide, scale  # noqa: E402  # as above


def zeros(env):
    return np.zeros((env.num_envs, *env.action_space.shape), dtype=np.float32)


def measured(info):
    """What a reset measures, to the bit."""
    return [info[name].tobytes() for name in ("q_rad", "flange_m")]


@pytest.mark.parametrize(
    ("env_id", "mode", "latency", "reward"),
    [(each, *way) for each, way in zip(IDS, itertools.cycle(WAYS), strict=False)],
)
def test_rows_are_the_agents_bit_for_bit_over_episodes(env_id, mode, latency, reward):
    keywords = {"action_mode": mode, "action_latency_ticks": latency, "reward": reward}
    cells, seed, limit = 3, 40, 9
    env = TwoAgentVecEnv(env_id, cells, max_episode_steps=limit, **keywords)
    singles = [parallel_env(env_id, max_cycles=limit, **keywords) for _ in range(cells)]
    assert env.seed(seed) == [40, 40, 41, 41, 42, 42]
    observation = env.reset()
    for cell, single in enumerate(singles):
        own, infos = single.reset(seed=seed + cell)
        for arm, agent in enumerate(ARMS):
            assert np.array_equal(observation[2 * cell + arm], own[agent])
            assert measured(env.reset_infos[2 * cell + arm]) == measured(infos[agent])
    rng, ends = np.random.default_rng(0), 0
    for _ in range(scaled(500)):
        actions = rng.uniform(-0.4, 0.4, (env.num_envs, *env.action_space.shape)).astype(np.float32)
        observation, rewards, dones, infos = env.step(actions)
        for cell, single in enumerate(singles):
            rows = (2 * cell, 2 * cell + 1)
            own, reward_of, terminated, truncated, infos_of = single.step(
                {a: actions[r] for a, r in zip(ARMS, rows, strict=True)}
            )
            over, fresh, ended = not single.agents, None, single.info
            if over:
                ends += 1
                fresh, begun = single.reset()
            for agent, row in zip(ARMS, rows, strict=True):
                assert rewards[row] == reward_of[agent]
                assert dones[row] == over
                info = dict(infos[row])
                assert info.pop("TimeLimit.truncated") is (truncated[agent] and not terminated[agent])
                if over:
                    assert np.array_equal(info.pop("terminal_observation"), own[agent])
                    assert np.array_equal(observation[row], fresh[agent])
                    assert measured(env.reset_infos[row]) == measured(begun[agent])
                else:
                    assert np.array_equal(observation[row], own[agent])
                assert equal({name: info.pop(name) for name in infos_of[agent]}, infos_of[agent])
                assert info == {name: value for name, value in ended.items() if name in info}
                assert ("end_reason" in info) is over
    assert ends >= 2 * cells
    env.close()


def test_types_and_shapes():
    env = TwoAgentVecEnv("SineTracking", 2)
    assert env.num_envs == 4
    observation = env.reset()
    assert env.observation_space.shape == (47,)
    assert observation.shape == (4, 47)
    observation, rewards, dones, infos = env.step(zeros(env))
    assert all(env.observation_space.contains(row) for row in observation)
    assert rewards.shape == dones.shape == (4,)
    assert dones.dtype == bool
    assert len(infos) == 4
    assert infos[0]["q_rad"].shape == (6,)
    assert "terminal_observation" not in infos[0]


def test_one_cell_ends_alone():
    env = TwoAgentVecEnv(
        SINE, 3, action_mode="joint_position", randomize=False, on_refusal="terminate", at_limits="refuse"
    )
    env.seed(0)
    env.reset()
    start = np.array([info["q_rad"] for info in env.reset_infos])
    goal = start.copy()
    goal[3, 1] += 1.2  # the right arm of cell 1, into the table
    dones = np.zeros(6, dtype=bool)
    while not dones.any():
        before = env.reset_infos[0]
        observation, _, dones, infos = env.step(goal.astype(np.float32))
    assert dones.tolist() == [False, False, True, True, False, False]
    for row in (2, 3):
        assert "right/" in infos[row]["safety"].subject
        assert infos[row]["TimeLimit.truncated"] is False
        assert infos[row]["terminal_observation"].shape == (47,)
    assert "safety" not in infos[0]
    assert env.reset_infos[0] is before
    assert np.abs(observation[2:4, :6] - start[2:4]).max() < 1e-9


def test_a_terminated_episode_is_no_timeout():
    env = TwoAgentVecEnv(SINE, 2, max_episode_steps=2)
    env.reset()
    env.step(zeros(env))
    env.cells.core.cell._physics._arms_qd[0, 0, 3] = np.nan
    _, _, dones, infos = env.step(zeros(env))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False, True, True]
    assert ["physics_error" in info for info in infos] == [True, True, False, False]


def test_the_generators_continue_and_seeds_are_used_once():
    env = TwoAgentVecEnv(SINE, 2)
    env.seed(7)
    first, second = env.reset(), env.reset()
    assert not np.array_equal(first, second)
    env.seed(7)
    assert np.array_equal(env.reset(), first)
    assert np.array_equal(env.reset(), second)
    assert len(set(env.seed())) == 2
    unseeded = [TwoAgentVecEnv(SINE, 1).reset() for _ in range(2)]
    assert not np.array_equal(*unseeded)


def test_a_seed_gives_the_lengths_of_staggered_episodes_of_all_resets():
    env = TwoAgentVecEnv(SINE, 6, max_episode_steps=50, staggered=True)
    drawn = []
    for _ in range(2):
        env.seed(7)
        for _ in range(2):
            env.reset()
            drawn.append(env.cells.elapsed_steps.tolist())
    assert drawn[:2] == drawn[2:]
    assert drawn[0] != drawn[1]
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_ppo_learns_with_one_policy_for_both_arms(env_id):
    env = VecMonitor(
        TwoAgentVecEnv(env_id, 2, reward="individual", max_episode_steps=16), info_keywords=("is_success",)
    )
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(scaled(5000))
    assert any(not value.equal(before[name]) for name, value in model.policy.state_dict().items())
    assert {episode["l"] for episode in model.ep_info_buffer} <= set(range(1, 17))
    assert len(model.ep_info_buffer) >= 4
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)
    env.close()


def test_normalising_wrapper():
    env = VecNormalize(TwoAgentVecEnv(SINE, 2))
    env.seed(0)
    env.reset()
    assert np.abs(env.step(zeros(env))[0]).max() <= 10.0


def test_attributes_and_methods_of_all_rows():
    env = TwoAgentVecEnv(SINE, 2)
    assert env.get_attr("num_envs") == [2] * 4
    assert env.get_attr("render_mode", indices=[0, 3]) == [None, None]
    assert env.get_attr("core", indices=2) == [env.cells.core]
    assert env.has_attr("core")
    assert not env.has_attr("nothing")
    assert env.env_is_wrapped(Monitor) == [False] * 4
    assert env.env_is_wrapped(Monitor, indices=[1]) == [False]
    env.set_attr("note", "a")
    assert env.get_attr("note", 0) == ["a"]
    assert env.env_method("render") == [None] * 4
    with pytest.raises(errors.SettingsError, match=r"'note'.*indices=None"):
        env.set_attr("note", "b", indices=[0])
    with pytest.raises(errors.SettingsError, match=r"'render'.*indices=None"):
        env.env_method("render", indices=0)


def test_bad_actions_options_and_order():
    env = TwoAgentVecEnv(SINE, 2)
    with pytest.raises(errors.ResetNeededError):
        env.step(zeros(env))
    env.reset()
    for bad in (np.zeros((2, 12)), np.zeros((4, 7)), np.zeros(24), None):
        with pytest.raises(errors.ActionError, match=re.escape("(4, 6)")):
            env.step(bad)
    actions = zeros(env)
    actions[3, 2] = np.nan
    with pytest.raises(errors.ActionError, match=r"number 2 of the right arm's action is nan \(cell 1\)"):
        env.step(actions)
    env.step(zeros(env))
    env.set_options({"phase": 1})
    with pytest.raises(errors.SettingsError, match="phase"):
        env.reset()
    env.close()
    env.close()
    with pytest.raises(errors.ClosedError):
        env.step(zeros(env))


@pytest.mark.parametrize(
    ("keywords", "error", "text"),
    [
        ({"task": "Nothing"}, errors.UnknownNameError, SINE),
        ({"num_cells": 0}, errors.SettingsError, "num_cells"),
        ({"num_cells": 1.5}, errors.SettingsError, "num_cells"),
        ({"reward": "mean"}, errors.UnknownNameError, "individual"),
        ({"observation": "both"}, errors.SettingsError, "observation='state'"),
        ({"max_episode_steps": 0}, errors.SettingsError, "max_episode_steps"),
        ({"staggered": True}, errors.SettingsError, "max_episode_steps"),
        ({"render_mode": "human"}, errors.UnknownNameError, "rgb_array"),
    ],
)
def test_bad_keywords(keywords, error, text):
    with pytest.raises(error, match=re.escape(text)):
        TwoAgentVecEnv(**{"task": SINE, **keywords})


def test_images_are_one_per_cell():
    env = TwoAgentVecEnv(SINE, 2, render_mode="rgb_array", width=64, height=48)
    env.seed(0)
    env.reset()
    assert [image.shape for image in env.get_images()] == [(48, 64, 3)] * 2
    assert env.render().shape == (96, 64, 3) or env.render().shape == (48, 128, 3)
    assert TwoAgentVecEnv(SINE).get_images() == []


@pytest.mark.parametrize("kind", [JointVecEnv, TwoAgentVecEnv])
def test_observations_have_the_type_of_their_space(kind):
    env, control = kind(SINE, 2, observation_dtype="float32"), kind(SINE, 2)
    for each in (env, control):
        each.seed(3)
    found, expected = env.reset(), control.reset()
    for _ in range(3):
        assert env.observation_space.dtype == found.dtype == np.float32
        assert np.array_equal(found, expected.astype(np.float32))
        found, expected = env.step(zeros(env))[0], control.step(zeros(control))[0]
    for each in (env, control):
        each.close()


@pytest.mark.parametrize("kind", [JointVecEnv, TwoAgentVecEnv])
def test_columns_are_those_of_the_fields(kind):
    env = kind("Handover", 2, threads=1, observation="goals")
    env.seed(0)
    row = env.reset()[0]
    layout = env.cells.core.layout
    arms = row.reshape(-1, layout.size)
    for name, value in (("role", [1.0 / 1.2]), ("goal_opening", None)):
        found = row[env.columns([name])]
        assert found.tolist() == arms[:, layout.indices([name])].ravel().tolist()
        assert len(found) == len(arms)
        assert value is None or np.allclose(found[:1], value)
    assert env.columns(["role", "progress"]) == sorted(env.columns(["progress"]) + env.columns(["role"]))
    with pytest.raises(errors.UnknownNameError, match="rol"):
        env.columns(["rol"])
    env.close()


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "TD3"])
def test_hidden_columns_change_values_and_no_actions(algorithm):
    """Before and after updates of the network."""
    torch = pytest.importorskip("torch")
    env = TwoAgentVecEnv("Handover", 2, threads=1, observation="goals")
    settings = {"n_steps": 8, "batch_size": 16} if algorithm == "PPO" else {"learning_starts": 8}
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=0, device="cpu", **settings)
    hidden = env.columns(["role", "progress"])
    hide(model, hidden)
    rng = np.random.default_rng(0)
    for _ in range(2):
        seen = rng.uniform(-1.0, 1.0, (8, env.observation_space.shape[0])).astype(np.float32)
        other = seen.copy()
        other[:, hidden] = rng.uniform(-1.0, 1.0, (8, len(hidden)))
        assert np.array_equal(*(model.predict(each, deterministic=True)[0] for each in (seen, other)))
        first, second = (torch.as_tensor(each) for each in (seen, other))
        if algorithm == "TD3":
            assert torch.equal(model.actor_target(first), model.actor_target(second))
        action = torch.zeros((8, *env.action_space.shape))
        with torch.no_grad():
            if algorithm == "PPO":
                values = model.policy.predict_values(first), model.policy.predict_values(second)
            else:
                values = model.critic(first, action)[0], model.critic(second, action)[0]
        assert not torch.equal(*values)
        model.learn(64)
    env.close()


def test_a_policy_without_layers_of_its_own_is_refused():
    env = TwoAgentVecEnv("Handover", 1, threads=1)
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, policy_kwargs={"net_arch": []})
    with pytest.raises(errors.SettingsError, match="MlpPolicy"):
        hide(model, [0])
    env.close()


def test_other_columns_than_those_that_are_scaled_stay_as_they_are():
    env = VecNormalize(TwoAgentVecEnv(SINE, 4))
    columns = env.venv.columns(["commanded_q_rad"])
    scale(env, columns)
    env.reset()
    for _ in range(20):
        seen = env.step(zeros(env))[0]
    before = env.get_original_obs()
    others = np.setdiff1d(np.arange(before.shape[1]), columns)
    assert np.allclose(seen[:, others], np.clip(before[:, others], -env.clip_obs, env.clip_obs), atol=1e-6)
    assert abs(env.obs_rms.mean[columns]).max() > 0.1
    assert not np.allclose(seen[:, columns], before[:, columns], atol=0.1)
