"""Keywords of the reward: weights of terms, and the sparse reward."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10 import policies
from dual_ur10.envs import parallel_env
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import SettingsError, TaskError, UnknownNameError

SINE = "DualUR10/SineTracking-v0"
ACTION = np.full(12, 0.2, dtype=np.float32)


@given(st.dictionaries(st.sampled_from(["approach", "position", "synchrony", "refusal"]), st.floats(-10, 10)))
def test_given_weights_replace_those_of_the_task(weights):
    setup = EnvSetup.resolve(SINE, {"reward_weights": weights})
    assert setup.weights == {**EnvSetup.resolve(SINE, {}).weights, **weights}
    assert list(setup.weights) == list(EnvSetup.resolve(SINE, {}).weights)


def test_the_reward_is_the_sum_of_terms_by_the_given_weights():
    plain, other = gym.make(SINE), gym.make(SINE, reward_weights={"position": 0.0, "synchrony": 3.0})
    for env in (plain, other):
        env.reset(seed=0)
    for _ in range(5):
        before, *_, terms = plain.step(ACTION)[1:]
        reward, *_, info = other.step(ACTION)[1:]
        assert reward == pytest.approx(before - 0.75 * terms["reward/position"] + 2.9 * terms["reward/synchrony"])
        assert info["reward/position"] == terms["reward/position"]


def test_agents_rewards_follow_the_given_weights():
    env = parallel_env(SINE, reward_weights={"approach": 0.0, "position": 0.0}, reward="individual")
    env.reset(seed=0)
    _, rewards, *_, infos = env.step(dict.fromkeys(env.agents, ACTION[:6]))
    assert rewards["left"] == rewards["right"] == pytest.approx(0.1 * infos["left"]["reward/synchrony"])


def test_a_sparse_reward_is_the_success_of_the_episode():
    core = Core(SINE, {"reward": "sparse", "duration_s": 1.0})
    observation, _ = core.reset([np.random.default_rng(0)])
    script, rewards = policies.load("scripted", SINE), []
    while True:
        step = core.step(script(observation))
        observation = step.observation
        rewards.append(float(step.reward[0]))
        assert step.info["reward/success"][0] == step.reward[0] == core.agents.rewards[0, 0]
        if step.terminated[0] or step.truncated[0]:
            break
    assert step.info["is_success"][0]
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert step.info[f"reward/{next(iter(core.task.weights))}"][0] > 0.0


def test_both_agents_earn_a_sparse_reward():
    env = parallel_env(SINE, reward="sparse", duration_s=0.2, success_rms_m=1.0)
    env.reset(seed=0)
    rewards = []
    while env.agents:
        _, found, *_ = env.step(dict.fromkeys(env.agents, np.zeros(6, dtype=np.float32)))
        rewards.append(found)
    assert rewards == [{"left": 0.0, "right": 0.0}] * 4 + [{"left": 1.0, "right": 1.0}]


def test_an_episode_without_success_earns_nothing():
    env = gym.make(SINE, reward="sparse", duration_s=0.5, success_rms_m=1e-6)
    env.reset(seed=0)
    rewards = [env.step(ACTION)[1] for _ in range(12)]
    assert rewards == [0.0] * 12


@pytest.mark.parametrize(
    ("keywords", "error", "text"),
    [
        ({"reward_weights": {"positon": 1.0}}, UnknownNameError, "did you mean 'position'"),
        ({"reward_weights": {"refusal": 0.0}, "on_refusal": "terminate"}, UnknownNameError, "'approach', 'position'"),
        ({"reward_weights": {"position": float("nan")}}, SettingsError, "finite"),
        ({"reward_weights": {"position": float("inf")}}, SettingsError, "finite"),
        ({"reward_weights": {"position": True}}, SettingsError, "finite"),
        ({"reward_weights": {"position": "much"}}, SettingsError, "finite"),
        ({"reward_weights": [0.1]}, SettingsError, "mapping"),
        ({"reward": "shaped"}, UnknownNameError, "'dense', 'sparse'"),
        ({"reward": "sparse", "reward_weights": {"position": 1.0}}, SettingsError, "leave out one"),
    ],
)
def test_bad_keywords_of_the_reward_are_refused_by_name(keywords, error, text):
    with pytest.raises(error, match=text):
        gym.make(SINE, **keywords)


@pytest.mark.parametrize(("change", "found"), [(1, "4 terms"), (-1, "2 terms")])
def test_terms_without_a_weight_each_are_refused(change, found):
    core = Core("SineTracking", {})
    core.reset([np.random.default_rng(0)])
    evaluate = core.task.evaluate
    core.task.evaluate = lambda *args: (it := evaluate(*args))._replace(
        terms=np.zeros((1, 2, it.terms.shape[2] + change))
    )
    with pytest.raises(TaskError, match=f"SineTracking returned {found}: return 3, one for each"):
        core.step(np.zeros(12))


def test_new_progress_is_what_an_arm_earns_beyond_its_best_step():
    core = Core(SINE, {"progress_weight": 2.0}, n=2)
    core.reset([np.random.default_rng(seed) for seed in range(2)])
    rng, best = np.random.default_rng(0), np.full((2, 2), np.inf)
    for k in range(30):
        if k == 15:  # the other row goes on
            core.reset([np.random.default_rng(5)], np.array([0]))
            best[0] = np.inf
        step = core.step(rng.uniform(-1.0, 1.0, (2, 12)))
        *terms, _, found = np.moveaxis(core.agents.terms, -1, 0)
        income = sum(term * core.weights[name] for term, name in zip(terms, core.task.weights, strict=True))
        np.testing.assert_allclose(found, np.maximum(income - best, 0.0), atol=1e-12)
        best = np.where(np.isinf(best), income, np.maximum(best, income))
        np.testing.assert_allclose(step.info["reward/progress"], found.mean(axis=1))
