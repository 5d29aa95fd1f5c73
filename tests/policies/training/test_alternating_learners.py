"""Two learners that alternate."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from dual_ur10.envs.api.sb3_bridge import JointVecEnv, TwoAgentVecEnv
from dual_ur10.policies.training.alternating_learners import AlternatingLearners

KEYWORDS = {"duration_s": 1.0}


@pytest.fixture
def env():
    made = TwoAgentVecEnv("SineTracking", 3, **KEYWORDS)
    made.seed(5)
    yield made
    made.close()


def plays(side, seed, steps, seen):
    """Return a learner that acts at random and appends its observations to `seen`."""
    rng = np.random.default_rng(seed)

    def learner():
        seen.append(side.reset().copy())
        for _ in range(steps):
            side.step_async(rng.uniform(-1, 1, (3, 6)).astype(np.float32))
            observation, reward, over, infos = side.step_wait()
            seen.append((observation.copy(), reward.copy(), over.copy(), [sorted(each) for each in infos]))

    return learner


def test_each_learner_sees_the_rows_of_its_arm(env):
    learners, seen = AlternatingLearners(env), ([], [])
    learners.run([plays(learners.sides[k], k, 60, seen[k]) for k in (0, 1)])
    alone = TwoAgentVecEnv("SineTracking", 3, **KEYWORDS)
    alone.seed(5)
    observation = alone.reset()
    rngs = [np.random.default_rng(k) for k in (0, 1)]
    for k in (0, 1):
        np.testing.assert_array_equal(seen[k][0], observation[k::2])
        assert [sorted(each) for each in learners.sides[k].reset_infos] == [
            sorted(each) for each in alone.reset_infos[k::2]
        ]
        assert learners.sides[k].reset_infos[0]
    ends = 0
    for step in range(60):
        actions = np.stack([rng.uniform(-1, 1, (3, 6)).astype(np.float32) for rng in rngs], axis=1).reshape(6, 6)
        alone.step_async(actions)
        observation, reward, over, infos = alone.step_wait()
        ends += over.any()
        for k in (0, 1):
            found = seen[k][step + 1]
            np.testing.assert_array_equal(found[0], observation[k::2])
            np.testing.assert_array_equal(found[1], reward[k::2])
            np.testing.assert_array_equal(found[2], over[k::2])
            assert found[3] == [sorted(each) for each in infos[k::2]]
    assert ends
    alone.close()


def test_an_error_of_one_learner_ends_both_and_is_raised(env):
    learners, seen = AlternatingLearners(env), ([], [])

    def fails():
        plays(learners.sides[1], 1, 5, seen[1])()
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        learners.run([plays(learners.sides[0], 0, 10_000, seen[0]), fails])
    assert len(seen[0]) < 10


def test_the_end_of_one_learner_ends_the_other(env):
    learners, seen = AlternatingLearners(env), ([], [])
    learners.run([plays(learners.sides[0], 0, 3, seen[0]), plays(learners.sides[1], 1, 10_000, seen[1])])
    assert len(seen[0]) == 4
    assert len(seen[1]) <= 5


def test_an_interrupt_ends_both(env, monkeypatch):
    import threading

    learners, seen = AlternatingLearners(env), ([], [])
    real, count = threading.Thread.join, []

    def interrupted(thread, timeout=None):
        count.append(thread)
        if len(count) == 3:
            raise KeyboardInterrupt
        return real(thread, timeout)

    monkeypatch.setattr(threading.Thread, "join", interrupted)
    with pytest.raises(KeyboardInterrupt):
        learners.run([plays(learners.sides[k], k, 1_000_000, seen[k]) for k in (0, 1)])
    monkeypatch.undo()
    assert not [each for each in threading.enumerate() if each.name.startswith("learner")]
    learners.run([plays(learners.sides[k], k, 2, []) for k in (0, 1)])  # and again


def test_learners_out_of_step_are_an_error(env):
    learners = AlternatingLearners(env)

    def resets():
        learners.sides[1].reset()
        learners.sides[1].reset()

    with pytest.raises(RuntimeError, match="same settings"):
        learners.run([plays(learners.sides[0], 0, 5, []), resets])


def test_rows_of_both_arms_together_are_the_gymnasium_environments():
    import gymnasium as gym

    rows = JointVecEnv("SineTracking", 2, **KEYWORDS)
    rows.seed(7)
    observation = rows.reset()
    single = [gym.make("DualUR10/SineTracking-v0", **KEYWORDS) for _ in range(2)]
    rng = np.random.default_rng(0)
    for k, env in enumerate(single):
        np.testing.assert_array_equal(observation[k], env.reset(seed=7 + k)[0])
    for step in range(25):
        actions = rng.uniform(-1, 1, (2, 12)).astype(np.float32)
        observation, reward, over, infos = rows.step(actions)
        for k, env in enumerate(single):
            wanted, value, terminated, truncated, info = env.step(actions[k])
            np.testing.assert_array_equal(infos[k]["terminal_observation"] if over[k] else observation[k], wanted)
            assert reward[k] == value
            assert over[k] == (terminated or truncated) == (step == 24)
            assert infos[k]["is_success"] == info["is_success"]
            assert infos[k]["TimeLimit.truncated"] == (truncated and not terminated)
        if over.all():
            break
    for env in single:
        env.close()
    rows.close()
