"""Samples for imitation."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.errors import UnreachableError
from dual_ur10.policies import evaluate
from dual_ur10.policies.training.gather import Expert, gather

SINE, HANDOVER = "DualUR10/SineTracking-v0", "DualUR10/Handover-v0"
KEYWORDS = {"duration_s": 2.0, "action_latency_ticks": 5, "randomization": "mild"}


def run(learner=None, *, expert_ratio=0.0, within=1, noise=0.0, patience=np.inf, cells=3, seed=0, **given):
    env = DualArmVectorEnv(cells, "SineTracking", autoreset_mode="Disabled", **KEYWORDS)
    low, high = env.core.action_space.low, env.core.action_space.high
    try:
        rng = np.random.default_rng(seed)
        expert = Expert(SINE, cells, low, high, **KEYWORDS)
        given |= {"expert_ratio": expert_ratio, "within": within, "noise": noise, "patience": patience, "rng": rng}
        return gather(env, expert, learner, range(cells), **given)
    finally:
        env.close()


def test_a_driving_expert_acts_as_it_does_alone():
    counted = []
    found = run(on_step=counted.append)
    policy = policies.load("scripted", SINE, **KEYWORDS)
    policy.teach()
    alone = evaluate(SINE, policy, episodes=3, num_envs=3, env_kwargs=KEYWORDS)
    assert found.returns.tolist() == pytest.approx([each.total_reward for each in alone.episodes], abs=1e-9)
    assert found.successes.tolist() == [each.success for each in alone.episodes]
    assert found.steps == sum(each.steps for each in alone.episodes) == counted[-1]
    assert found.observation.shape == (found.steps, 94)
    assert found.action.shape == (found.steps, 12)
    assert found.observation.dtype == found.action.dtype == np.float32


def test_rows_that_idle_leave_no_sample_and_change_no_other_row():
    both, first = run(noise=0.1), run(noise=0.1, rows=2)
    assert first.steps == 2 * 50
    assert len(first.returns) == len(first.successes) == 2
    assert np.array_equal(first.observation.reshape(50, 2, 94), both.observation.reshape(50, 3, 94)[:, :2])
    assert np.array_equal(first.action.reshape(50, 2, 12), both.action.reshape(50, 3, 12)[:, :2])


def test_the_expert_labels_states_that_the_learner_led_to():
    away = np.full(12, 0.05, dtype=np.float32)
    found = run(lambda observation: np.tile(away, (len(observation), 1)), expert_ratio=0.0)
    # The learner drifts away, and the expert's labels lead back.
    assert (found.action[-3:] < -0.5).all()
    assert found.returns.max() < run().returns.min()


def test_the_expert_begins_some_episodes_and_hands_over():
    def learner(observation):
        return np.full((len(observation), 12), 0.02)

    found = run(learner, expert_ratio=0.5, within=25, cells=8, seed=1)
    rng = np.random.default_rng(1)
    begun = rng.random(8) < 0.5
    handed = np.where(begun, rng.integers(1, 26, 8), 0)
    assert 0 < begun.sum() < 8
    assert len(found.returns) == (~begun).sum()  # only those that it drove from the beginning are judged
    alone = run(cells=8, seed=1)
    assert found.longest == alone.longest == 50
    # Up to where it is handed over, a row is as with the expert alone; from there on it is not.
    for row in range(8):
        ours, theirs = (each.observation.reshape(50, 8, 94)[:, row] for each in (found, alone))
        same = (ours == theirs).all(axis=1)
        assert same[: handed[row] + 1].all()
        assert not same[handed[row] + 2 :].any()


def test_the_expert_helps_a_learner_that_differs_too_much():
    def learner(observation):
        return np.full((len(observation), 12), 0.5)

    lost, helped = run(learner, cells=4), run(learner, patience=0.4, rows=4)
    assert helped.returns.min() > lost.returns.max()
    assert not helped.successes.any()  # none is its own
    assert np.abs(helped.action).max() < 1.0
    # One who does much the same is left alone.
    calm = run(lambda observation: np.zeros((len(observation), 12)), cells=4)
    again = run(lambda observation: np.zeros((len(observation), 12)), patience=2.0, cells=4)
    assert calm.observation.tobytes() == again.observation.tobytes()


def test_noise_is_in_the_motion_and_not_in_the_labels():
    calm, noisy = run(), run(noise=0.3)
    first = calm.action[:3]
    np.testing.assert_allclose(noisy.action[:3], first, atol=1e-6)  # nothing has been done yet
    assert np.abs(noisy.action - calm.action).max() > 0.01
    assert np.abs(noisy.observation - calm.observation)[:, :6].max() < 0.1  # joints: it comes back


def test_the_same_seeds_give_the_same_samples():
    first, second = run(noise=0.2, seed=5), run(noise=0.2, seed=5)
    assert first.observation.tobytes() == second.observation.tobytes()
    assert first.action.tobytes() == second.action.tobytes()


def test_a_lost_row_leaves_the_others_alone(monkeypatch):
    rows, low, high = 3, -np.ones(12, np.float32), np.ones(12, np.float32)
    expert = Expert(SINE, rows, low, high, **KEYWORDS)

    class Lost:
        def __init__(self, answers):
            self._answers = iter(answers)

        def reset(self):
            pass

        def __call__(self, observation):
            answer = next(self._answers)
            if isinstance(answer, Exception):
                raise answer
            return answer

    good = np.full(12, 2.0)
    expert._policies = [
        Lost([good] * 3),
        Lost([UnreachableError("no"), good, good]),
        Lost([np.full(12, np.nan), good, good]),
    ]
    live = np.array([True, True, True])
    action, knows = expert(np.zeros((3, 94)), live)
    assert knows.tolist() == [True, False, False]
    assert action[0].tolist() == [1.0] * 12  # within bounds
    assert action[1:].tolist() == [[0.0] * 12] * 2
    assert expert(np.zeros((3, 94)), live)[1].tolist() == [True, False, False]  # once lost, lost
    expert.begin(1)
    assert expert(np.zeros((3, 94)), live)[1].tolist() == [True, True, False]
    assert expert(np.zeros((3, 94)), np.zeros(3, dtype=bool))[1].tolist() == [False] * 3


def test_a_resting_expert_has_no_noise(monkeypatch):
    monkeypatch.setattr(
        Expert, "__call__", lambda self, seen, live: (np.zeros((len(seen), 12), np.float32), live.copy())
    )
    calm, noisy = run(), run(noise=1.0)
    assert calm.observation.tobytes() == noisy.observation.tobytes()


def test_fingers_have_no_noise():
    keywords = {"action_latency_ticks": 5, "max_time_s": 2.0}
    env = DualArmVectorEnv(2, "Handover", autoreset_mode="Disabled", action_latency_ticks=5, max_episode_steps=30)
    del keywords["max_time_s"]
    seen = []
    step = env.step
    env.step = lambda action: seen.append(action.copy()) or step(action)
    low, high = env.core.action_space.low, env.core.action_space.high
    found = gather(
        env,
        Expert(HANDOVER, 2, low, high, **keywords),
        None,
        range(2),
        expert_ratio=0.0,
        within=1,
        noise=1.0,
        patience=np.inf,
        rng=np.random.default_rng(3),
    )
    env.close()
    done = np.array(seen).reshape(-1, 2, 2, 7)
    assert np.isin(done[..., 6], (-1.0, 1.0)).all()
    assert np.abs(done.reshape(-1, 14) - found.action.reshape(-1, 14)).max() > 0.05
    assert policies.load("scripted", HANDOVER, **keywords) is not None
