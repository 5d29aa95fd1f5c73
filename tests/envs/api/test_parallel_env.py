import re
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.test.state_test import state_test

import dual_ur10
from dual_ur10 import errors
from dual_ur10.envs import aec_env, parallel_env
from dual_ur10.envs.api.agent_dict import AgentDictWrapper
from tests import scripts
from tests.soak import scaled
from ur_core.kinematics.ur10 import ARMS

IDS = dual_ur10.ENV_IDS
SINE = "DualUR10/SineTracking-v0"
REWARDS = ("shared", "individual")
MODES = ("joint_delta", "joint_position", "tcp_delta")
# PettingZoo's checks pass options to reset.
checks = pytest.mark.filterwarnings("ignore:.*reset takes the option")


def joint_actions(space, mode, q_rad, steps, rng):
    """Actions of both arms, (steps, 2, k), that the limits can follow, around the postures q_rad, (2, 6)."""
    size = space.shape[0] // 2
    result = rng.uniform(-0.3, 0.3, (steps, 2, size))
    if mode == "joint_position":
        result[..., :6] = q_rad + 0.03 * result[..., :6]
    return result.astype(np.float32)


def by_agent(action):
    return dict(zip(ARMS, action.reshape(2, -1), strict=True))


def zeros(env):
    return {agent: np.zeros(env.action_space(agent).shape, dtype=np.float32) for agent in env.possible_agents}


@checks
@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("env_id", IDS)
def test_pettingzoo_checks_the_parallel_env(env_id, reward):
    env = pettingzoo.make("parallel", env_id, reward=reward, max_cycles=7)
    parallel_api_test(env, num_cycles=scaled(400))
    parallel_seed_test(lambda: parallel_env(env_id, reward=reward), num_cycles=scaled(400))


@checks
@pytest.mark.filterwarnings("ignore:We recommend agents to be named")  # arms have sides, not numbers
@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("env_id", IDS)
def test_pettingzoo_checks_the_aec_env(env_id, reward):
    api_test(
        pettingzoo.make("aec", env_id, reward=reward, max_cycles=7), num_cycles=scaled(400), verbose_progress=False
    )
    seed_test(lambda: aec_env(env_id, reward=reward), num_cycles=scaled(400))


@pytest.mark.parametrize("env_id", IDS)
def test_pettingzoo_checks_the_state(env_id):
    state_test(aec_env(env_id), parallel_env(env_id), num_cycles=scaled(100))


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # MuJoCo's web viewer leaves its sockets to the collector
def test_pettingzoo_checks_rendering():
    made = []

    def make(render_mode):
        made.append(aec_env(SINE, render_mode=render_mode, width=64, height=48))
        return made[-1]

    render_test(make)
    for env in made:
        env.close()


MODES = [("joint_delta", 0), ("joint_delta", 3), ("joint_position", 0), ("tcp_delta", 3)]


@pytest.mark.parametrize(
    ("env_id", "mode", "latency"),
    [(SINE, *each) for each in MODES]
    + [(env_id, *MODES[k % len(MODES)]) for k, env_id in enumerate(IDS) if env_id != SINE],
)
def test_all_interfaces_agree_bit_for_bit(env_id, mode, latency):
    keywords = {"action_mode": mode, "action_latency_ticks": latency}
    steps, row, seed = scaled(400), 5, 17
    single = gym.make(env_id, disable_env_checker=True, **keywords)
    pairs = {reward: parallel_env(env_id, reward=reward, **keywords) for reward in REWARDS}
    one = gym.make_vec(env_id, num_envs=1, **keywords)
    eight = gym.make_vec(env_id, num_envs=8, **keywords)
    core, weights = single.unwrapped.core, single.unwrapped.task.weights
    observation, info = single.reset(seed=seed)
    for pair in pairs.values():
        pair.reset(seed=seed)
    first, _ = one.reset(seed=seed)
    many, vector_info = eight.reset(seed=seed - row)
    assert np.array_equal(first[0], observation)
    assert np.array_equal(many[row], observation)
    rng = np.random.default_rng(0)
    others = np.stack(
        [joint_actions(core.action_space, mode, q, steps, rng).reshape(steps, -1) for q in vector_info["q_rad"]], axis=1
    )
    for joint in others:
        action = by_agent(joint[row])
        observation, mean, terminated, truncated, info = single.step(joint[row])
        for batch, k, given in ((one, 0, joint[row : row + 1]), (eight, row, joint)):
            observations, means, ends, overs, _ = batch.step(given)
            assert np.array_equal(observations[k], observation)
            assert (means[k], ends[k], overs[k]) == (mean, terminated, truncated)
        for reward, pair in pairs.items():
            own, rewards, terminations, truncations, infos = pair.step(dict(reversed(action.items())))
            assert np.array_equal(pair.state(), observation)
            assert np.array_equal(np.stack([own[arm] for arm in ARMS]), core.agents.observations[0])
            expected = core.agents.rewards[0].tolist() if reward == "individual" else [mean, mean]
            assert [rewards[arm] for arm in ARMS] == expected
            assert (np.mean(expected)) == pytest.approx(mean, abs=1e-12)
            for k, arm in enumerate(ARMS):
                assert (terminations[arm], truncations[arm]) == (terminated, truncated)
                assert pair.observation_space(arm).contains(own[arm])
                summed = sum(weight * infos[arm][f"reward/{name}"] for name, weight in weights.items())
                assert summed == pytest.approx(rewards[arm], abs=1e-12)
                assert infos[arm].keys() == info.keys()
                assert np.array_equal(infos[arm]["q_rad"], info["q_rad"][k])
                assert infos[arm]["is_success"] is info["is_success"]
        if terminated or truncated:
            assert not any(pair.agents for pair in pairs.values())
            break
    for env in (single, one, eight, *pairs.values()):
        env.close()


@pytest.mark.parametrize("arm", range(2))
@pytest.mark.parametrize("env_id", IDS)
def test_an_action_of_one_agent_moves_only_its_arm(env_id, arm):
    env, control = parallel_env(env_id), parallel_env(env_id)
    _, start = env.reset(seed=0)
    control.reset(seed=0)
    actions = zeros(env)
    actions[ARMS[arm]][0] = 0.1
    for _ in range(4):
        *_, infos = env.step(actions)
        *_, still = control.step(zeros(env))
    acting, other = ARMS[arm], ARMS[1 - arm]
    assert np.abs(infos[acting]["q_rad"] - start[acting]["q_rad"])[0] > 1e-3
    assert np.abs(infos[other]["q_rad"] - still[other]["q_rad"]).max() <= 1e-9


@pytest.mark.parametrize("env_id", IDS)
def test_spaces_are_each_arms_own(env_id):
    env, joint = parallel_env(env_id), gym.make(env_id)
    assert env.possible_agents == list(ARMS)
    assert env.max_num_agents == 2
    assert env.num_agents == 0
    observation, infos = env.reset(seed=3)
    assert env.num_agents == 2
    assert env.state_space == joint.observation_space
    assert np.array_equal(env.state(), joint.reset(seed=3)[0])
    for k, agent in enumerate(ARMS):
        space = env.action_space(agent)
        assert space.dtype == np.float32
        size = joint.action_space.shape[0] // 2
        assert space.shape == (size,)
        assert np.array_equal(space.low, joint.action_space.low[k * size : (k + 1) * size])
        assert np.array_equal(env.observation_space(agent).high, joint.observation_space.high.reshape(2, -1)[k])
        assert env.observation_space(agent).contains(observation[agent])
        assert infos[agent]["q_rad"].shape == (6,)
    assert not np.shares_memory(observation["left"], observation["right"])
    assert not np.shares_memory(observation["left"], env.state())
    assert str(env) == env.metadata["name"] == env_id
    env.state()[:] = 0
    assert env.state().any()


def test_values_of_two_arms_are_divided_and_the_rest_is_shared():
    env, joint = parallel_env(SINE), gym.make(SINE)
    env.reset(seed=0)
    joint.reset(seed=0)
    action = joint_actions(joint.action_space, "joint_delta", None, 1, np.random.default_rng(1))[0]
    *_, info = joint.step(action.reshape(-1))
    *_, infos = env.step(by_agent(action))
    for name in ("q_rad", "flange_m", "flange_error_m", "orientation_error_rad", "reference_m"):
        for k, arm in enumerate(ARMS):
            assert np.array_equal(infos[arm][name], info[name][k])
    for name in ("is_success", "reward/approach", "reward/position", "reward/synchrony"):
        assert infos["left"][name] == infos["right"][name] == info[name]


def test_individual_rewards_differ_and_have_their_own_terms():
    env = parallel_env(SINE, reward="individual")
    env.reset(seed=0)
    actions = zeros(env)
    actions["left"][:] = 0.3
    for _ in range(4):
        _, rewards, *_, infos = env.step(actions)
    assert rewards["left"] < rewards["right"]
    assert infos["left"]["reward/position"] < infos["right"]["reward/position"]
    assert infos["left"]["reward/synchrony"] == infos["right"]["reward/synchrony"]


@pytest.mark.parametrize("env_id", IDS)
def test_max_cycles_truncates_each_episode(env_id):
    env = pettingzoo.make("parallel", env_id, max_cycles=3)
    for _ in range(2):
        env.reset()
        flags = []
        while env.agents:
            _, _, terminations, truncations, _ = env.step(zeros(env))
            flags.append((terminations, truncations))
        no, yes = dict.fromkeys(ARMS, False), dict.fromkeys(ARMS, True)
        assert flags == [(no, no), (no, no), (no, yes)]
    assert pettingzoo.make("parallel", env_id).max_cycles is None


def test_a_refused_motion_ends_both_agents_with_its_reason():
    keywords = {"action_mode": "joint_position", "on_refusal": "terminate", "at_limits": "refuse"}
    env = parallel_env(SINE, randomize=False, **keywords)
    _, infos = env.reset(seed=0)
    down = {arm: infos[arm]["q_rad"].astype(np.float32) for arm in ARMS}
    down["right"][1] += 1.2  # into the table
    while env.agents:
        _, _, terminations, truncations, infos = env.step(down)
    assert terminations == {"left": True, "right": True}
    assert truncations == {"left": False, "right": False}
    assert "right/" in env.info["safety"].subject
    assert env.info["end_reason"] == "refused/distance"
    assert not infos["left"]["is_success"]


@pytest.mark.parametrize("env_id", IDS)
def test_infos_are_numbers_with_the_same_keys_from_reset_to_end(env_id):
    env = parallel_env(env_id, max_cycles=2, randomization="mild", reward="individual")
    for _ in range(2):
        _, begun = env.reset(seed=0)
        assert "randomization" in env.info
        begun["left"]["q_rad"][:] = 1e3  # a caller may change its infos
        while env.agents:
            *_, infos = env.step(zeros(env))
        assert env.info["end_reason"] == "time"
        for agent in ARMS:
            assert begun[agent].keys() == infos[agent].keys()
            for name, value in infos[agent].items():
                first = np.asarray(begun[agent][name])
                assert (first.shape, first.dtype) == (np.shape(value), np.asarray(value).dtype), name
                assert first.dtype.kind in "fib"
        if "object_m" in infos["left"]:
            assert np.allclose(begun["left"]["object_m"], infos["left"]["object_m"], atol=1e-3)
            assert np.abs(begun["left"]["object_m"]).max() > 0.01


def test_diverged_physics_ends_both_agents():
    env = parallel_env(SINE)
    env.reset(seed=0)
    env.step(zeros(env))
    env.core.cell._physics._arms_qd[0, 0, 3] = np.nan
    observation, _, terminations, _, _ = env.step(zeros(env))
    assert terminations == {"left": True, "right": True}
    assert "diverged" in env.info["physics_error"]
    assert np.isfinite(observation["left"]).all()


def test_the_generator_continues_and_a_seed_restarts_it():
    env = parallel_env(SINE)
    starts = [env.reset(seed=seed)[0]["left"] for seed in (5, None, 5, None)]
    assert np.array_equal(starts[0], starts[2])
    assert np.array_equal(starts[1], starts[3])
    assert not np.array_equal(starts[0], starts[1])


BAD_ACTIONS = {
    "missing": (lambda a: {"left": a["left"]}, r"without \['right'\]"),
    "extra": (lambda a: {**a, "middle": a["left"]}, r"with unknown \['middle'\]"),
    "renamed": (lambda a: {"left": a["left"], "Right": a["left"]}, r"without \['right'\] and with unknown \['Right'\]"),
    "array": (lambda a: np.zeros(12), "dict"),
    "none": (lambda a: {**a, "right": None}, "'right'"),
    "short": (lambda a: {"left": np.zeros(5), "right": np.zeros(7)}, "'left'.*shape"),
    "rank": (lambda a: {**a, "right": a["right"][None]}, "'right'.*shape"),
    "text": (lambda a: {**a, "right": np.array(["0"] * 6)}, "'right'.*numbers"),
    "bool": (lambda a: {**a, "left": np.zeros(6, dtype=bool)}, "'left'.*bool"),
    "ragged": (lambda a: {**a, "left": [[0], [0, 0]]}, "'left'.*numbers"),
    "nan": (lambda a: {**a, "right": np.r_[np.zeros(5), np.nan]}, "number 5 of the right arm's action is nan"),
    "inf": (lambda a: {**a, "left": np.r_[np.inf, np.zeros(5)]}, "number 0 of the left arm's action is inf"),
}


@pytest.mark.parametrize("kind", list(BAD_ACTIONS))
def test_malformed_actions_are_refused_by_agent_and_nothing_moves(kind):
    env, control = parallel_env(SINE, max_cycles=2), parallel_env(SINE, max_cycles=2)
    env.reset(seed=0)
    control.reset(seed=0)
    spoil, text = BAD_ACTIONS[kind]
    with pytest.raises(errors.ActionError, match=text):
        env.step(spoil(zeros(env)))
    for _ in range(2):
        assert env.agents
        ours, theirs = env.step(zeros(env)), control.step(zeros(env))
        assert np.array_equal(ours[0]["left"], theirs[0]["left"])
    assert env.agents == []


@pytest.mark.parametrize("bad", [np.zeros(5), np.full(6, np.nan), None], ids=["shape", "nan", "none"])
def test_an_agent_can_act_again_after_a_malformed_action(bad):
    env, control = aec_env(SINE), aec_env(SINE)
    env.reset(seed=0)
    control.reset(seed=0)
    with pytest.raises(errors.ActionError, match="'left'"):
        env.step(bad)
    for _ in range(2):
        assert env.agent_selection == control.agent_selection
        env.step(np.full(6, 0.1))
        control.step(np.full(6, 0.1))
    assert np.array_equal(env.last()[0], control.last()[0])


def test_steps_without_an_episode_are_refused():
    env = parallel_env(SINE, max_cycles=1)
    with pytest.raises(errors.ResetNeededError, match="reset"):
        env.step(zeros(env))
    with pytest.raises(errors.ResetNeededError, match="reset"):
        env.state()
    env.reset(seed=0)
    env.step(zeros(env))
    with pytest.raises(errors.ResetNeededError, match="reset"):
        env.step(zeros(env))
    env.reset()
    env.close()
    env.close()
    with pytest.raises(errors.ClosedError, match="new one"):
        env.step(zeros(env))
    with pytest.raises(errors.ClosedError):
        env.reset()
    with pytest.raises(errors.ResetNeededError):  # a reset that failed leaves no episode
        env.step(zeros(env))


def test_unknown_reset_options_warn():
    env = parallel_env(SINE)
    with pytest.warns(UserWarning, match=r"\['phase'\] is ignored"):
        env.reset(seed=0, options={"phase": 1})


@pytest.mark.parametrize(
    ("keywords", "error", "text"),
    [
        ({"reward": "mean"}, errors.UnknownNameError, "'shared', 'individual'"),
        ({"max_cycles": 0}, errors.SettingsError, "max_cycles is 0"),
        ({"max_cycles": 2.0}, errors.SettingsError, "max_cycles is 2.0"),
        ({"max_cycles": True}, errors.SettingsError, "max_cycles is True"),
        ({"observation": "pixels"}, errors.SettingsError, "observation='state'"),
        ({"observation": "smell"}, errors.UnknownNameError, "'pixels'"),
        ({"amplitud_m": 0.1}, errors.UnknownNameError, "amplitude_m"),
        ({"render_mode": "ansi"}, errors.UnknownNameError, "rgb_array"),
        ({"policy_rate_hz": 30}, errors.RateError, "31.25 Hz"),
    ],
)
def test_bad_keywords_are_refused_by_name(keywords, error, text):
    with pytest.raises(error, match=re.escape(text)):
        parallel_env(SINE, **keywords)


@pytest.mark.parametrize("name", ["Nothing", "SineTracking-v7", "SineTracking-", "dualur10/SineTracking-v0", ""])
def test_unknown_names_are_refused(name):
    with pytest.raises(errors.UnknownNameError, match=SINE):
        parallel_env(name)


@pytest.mark.parametrize("env_id", IDS)
def test_an_environment_has_three_names(env_id):
    for name in (env_id, env_id.split("/")[1], env_id.split("/")[1].rsplit("-v", 1)[0]):
        assert str(parallel_env(name)) == env_id
        assert str(aec_env(name)) == env_id


def test_keywords_reach_the_cell():
    env = parallel_env(SINE, policy_rate_hz=12.5, randomize=False, action_latency_ticks=2)
    assert env.metadata["render_fps"] == 12
    assert env.core.timing.ahead_s == pytest.approx(0.08 + 0.016)
    assert np.array_equal(env.reset(seed=0)[0]["left"], env.reset(seed=1)[0]["left"])


def test_images_and_viewer_are_those_of_the_cell():
    env, joint = (make(SINE, render_mode="rgb_array", width=64, height=48) for make in (parallel_env, gym.make))
    env.reset(seed=0)
    joint.reset(seed=0)
    assert np.array_equal(env.render(), joint.render())


def test_registering_loads_nothing_heavy_and_can_be_repeated():
    code = (
        "import warnings; warnings.simplefilter('error')\n"
        "import sys, importlib, dual_ur10\n"
        "import dual_ur10.envs\n"
        "heavy = {'mujoco', 'torch', 'matplotlib', 'dm_control', 'pygame', 'stable_baselines3'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "importlib.reload(dual_ur10)\n"
        "import pettingzoo\n"
        "for kind in ('parallel', 'aec'):\n"
        "    for env_id in dual_ur10.ENV_IDS:\n"
        "        assert pettingzoo.spec(kind, env_id).id == env_id\n"
        "        assert pettingzoo.spec(kind, env_id.rsplit('-v', 1)[0]).id == env_id\n"
    )
    result = subprocess.run([sys.executable, "-c", code], check=True, timeout=60, capture_output=True, text=True)
    assert result.stdout == result.stderr == ""


def test_the_functions_keep_their_names_whatever_is_imported_first(tmp_path):
    for first in ("dual_ur10.envs.api.parallel_env", "dual_ur10.envs.api.dm_env", "dual_ur10.envs.api.dual_arm_env"):
        path = tmp_path / "first.py"
        path.write_text(
            f"import {first}\n"
            "from dual_ur10.envs.api.parallel_env import DualArmParallelEnv\n"
            "from dual_ur10.envs.api.dm_env import DualArmDmEnv\n"
            "import dual_ur10.envs as envs\n"
            "from types import FunctionType\n"
            "assert all(type(getattr(envs, name)) is FunctionType for name in envs.__all__)\n"
            "import pickle; assert pickle.loads(pickle.dumps(DualArmParallelEnv)) is DualArmParallelEnv\n"
        )
        scripts.run(path, folder=tmp_path, output=tmp_path / "output")


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (np.zeros(5), np.zeros(7)),  # together as many as both
        (np.zeros((1, 6)), np.zeros((1, 6))),
        (0.5, np.zeros(6)),
        ([[0.0], [0.0, 0.0]], np.zeros(6)),
    ],
)
def test_malformed_actions_of_an_agent_in_a_dict_are_refused(left, right):
    env = AgentDictWrapper(gym.make(SINE))
    env.reset(seed=0)
    with pytest.raises(errors.ActionError, match="the action of 'left' must be numbers"):
        env.step({"left": left, "right": right})
    env.step({"left": np.zeros(6), "right": np.zeros(6)})
    env.close()
