import logging
import subprocess
import sys
import unittest

import gymnasium as gym
import numpy as np
import pytest
from dm_env import StepType, specs, test_utils

import dual_ur10
from dual_ur10 import errors
from dual_ur10.envs import dm_env
from tests.soak import scaled

IDS = dual_ur10.ENV_IDS
SINE = "DualUR10/SineTracking-v0"
ZERO = np.zeros(12, dtype=np.float32)


@pytest.mark.parametrize("env_id", IDS)
def test_dm_envs_own_tests_pass(env_id, caplog):
    class Checks(test_utils.EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self):
            # Full speed at the same time in all joints: an end of the episode is reached, and checked.
            return dm_env(env_id, seed=0, action_mode="joint_position", on_refusal="terminate", at_limits="refuse")

        def make_action_sequence(self):
            spec = self.environment.action_spec()
            low, high = spec.minimum[:6], spec.maximum[:6]
            for _ in range(120):
                action = self.environment.env.core.pipeline.adapter.commanded_q_rad.reshape(2, 6).copy()
                action[:, 1] = np.clip(action[:, 1] + 0.3, low[1], high[1])  # down, into the table
                full = np.zeros((2, spec.shape[0] // 2), dtype=spec.dtype)
                full[:, :6] = action
                yield full.reshape(-1)

    result = unittest.TestResult()
    with caplog.at_level(logging.INFO):
        unittest.defaultTestLoader.loadTestsFromTestCase(Checks).run(result)
    assert result.testsRun >= 4
    assert not result.errors, result.errors[0][1]
    assert not result.failures, result.failures[0][1]
    assert "Successfully checked end of episode" in caplog.text


@pytest.mark.parametrize("env_id", IDS)
def test_steps_are_those_of_gymnasium_bit_for_bit(env_id):
    ours, theirs = dm_env(env_id, seed=8), gym.make(env_id)
    first = ours.reset()
    observation, info = theirs.reset(seed=8)
    assert first.step_type is StepType.FIRST
    assert first.reward is None
    assert first.discount is None
    assert np.array_equal(first.observation, observation)
    assert np.array_equal(ours.info["q_rad"], info["q_rad"])
    rng = np.random.default_rng(0)
    for _ in range(scaled(400)):
        action = rng.uniform(-0.3, 0.3, theirs.action_space.shape).astype(np.float32)
        step = ours.step(action)
        observation, reward, terminated, truncated, info = theirs.step(action)
        assert np.array_equal(step.observation, observation)
        assert step.reward == reward
        assert step.last() == (terminated or truncated)
        assert step.discount == (0.0 if terminated else 1.0)
        assert ours.info.keys() == info.keys()
        if step.last():
            break
    assert np.array_equal(ours.reset().observation, theirs.reset()[0])  # the generator went on


def test_truncation_keeps_the_discount_and_the_next_step_resets():
    env = dm_env(SINE, seed=0, duration_s=0.2)
    control = gym.make(SINE, duration_s=0.2)
    assert np.array_equal(env.step(np.full(12, np.nan)).observation, control.reset(seed=0)[0])
    steps = [env.step(ZERO) for _ in range(5)]
    assert [step.step_type for step in steps] == [StepType.MID] * 4 + [StepType.LAST]
    assert [step.discount for step in steps] == [1.0] * 5
    assert "is_success" in env.info
    begun = env.step(np.full(12, np.nan))  # whatever its action
    assert begun.first()
    assert begun.reward is None
    assert np.array_equal(begun.observation, control.reset()[0])
    assert "is_success" not in env.info
    assert env.step(ZERO).mid()


def test_the_gate_ends_without_discount():
    keywords = {"action_mode": "joint_position", "on_refusal": "terminate", "at_limits": "refuse"}
    env = dm_env(SINE, seed=0, randomize=False, **keywords)
    env.reset()
    down = env.info["q_rad"].copy()
    down[:, 1] += 1.2
    step = env.step(down.reshape(12))
    while not step.last():
        assert step.discount == 1.0
        step = env.step(down.reshape(12))
    assert step.discount == 0.0
    assert env.info["safety"].kind == "distance"


def test_diverged_physics_ends_without_discount():
    env = dm_env(SINE, seed=0)
    env.reset()
    env.step(ZERO)
    env.env.core.cell._physics._arms_qd[0, 0, 3] = np.nan
    step = env.step(ZERO)
    assert step.last()
    assert step.discount == 0.0
    assert "diverged" in env.info["physics_error"]


@pytest.mark.parametrize("env_id", IDS)
def test_specs_have_the_bounds_of_the_spaces(env_id):
    env = dm_env(env_id)
    for spec, space, name in (
        (env.observation_spec(), env.env.observation_space, "observation"),
        (env.action_spec(), env.env.action_space, "action"),
    ):
        assert isinstance(spec, specs.BoundedArray)
        assert (spec.shape, spec.dtype, spec.name) == (space.shape, space.dtype, name)
        assert np.array_equal(spec.minimum, space.low)
        assert np.array_equal(spec.maximum, space.high)
    assert env.reward_spec().dtype == env.discount_spec().dtype == float


def test_malformed_actions_change_nothing():
    env, control = dm_env(SINE, seed=0), dm_env(SINE, seed=0)
    env.reset()
    control.reset()
    with pytest.raises(errors.ActionError, match="left arm's action is nan"):
        env.step(np.full(12, np.nan))
    assert np.array_equal(env.step(ZERO).observation, control.step(ZERO).observation)


def test_a_failed_reset_must_be_repeated():
    env = dm_env(SINE, seed=0)
    env.reset()
    good = env.env.core.task.start
    env.env.core.task.start = lambda rows, rngs: good(rows, rngs)._replace(q_rad=good(rows, rngs).q_rad + 1.0)
    with pytest.raises(errors.CollisionAtStartError):
        env.reset()
    env.env.core.task.start = good
    assert env.step(ZERO).first()


def test_names_and_keywords_are_refused_as_elsewhere():
    for name in ("Nothing", "SineTracking-v7"):
        with pytest.raises(errors.UnknownNameError, match=SINE):
            dm_env(name)
    with pytest.raises(errors.UnknownNameError, match="amplitude_m"):
        dm_env("SineTracking", amplitud_m=1)
    with dm_env("SineTracking-v0", randomize=False) as env:
        env.reset()
    env.close()
    with pytest.raises(errors.ClosedError):
        env.reset()


def test_its_import_loads_nothing_heavy():
    code = (
        "import sys, dual_ur10.envs.api.dm_env; heavy = {'mujoco', 'torch', 'matplotlib', 'dm_control'} "
        "& set(sys.modules);"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
