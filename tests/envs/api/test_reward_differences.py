"""Differences of the reward: the return of the task for a learner, times 1 - gamma."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from dual_ur10.envs.api.sb3_bridge import RewardDifferences, TwoAgentVecEnv
from dual_ur10.errors import SettingsError

GAMMA, N = 0.9, 2


def made(refusals=0.0, **keywords):
    """Return both environments, which step the same cells, with the rewards of the task and with the differences."""
    envs = [TwoAgentVecEnv("Handover", N, reward="individual", threads=1, **keywords) for _ in range(2)]
    for env in envs:
        env.seed(0)
    plain, changed = envs[0], RewardDifferences(envs[1], GAMMA, lambda: refusals)
    plain.reset()
    changed.reset()
    return plain, changed


def put(env, cell, position_m):
    block = env.cells.core.cell._physics._props.objects["block"]
    block.position_m[cell], block.quat[cell] = position_m, [1.0, 0.0, 0.0, 0.0]


def stepped(plain, changed, action):
    found = []
    for env in (plain, changed):
        env.step_async(action)
        found.append(env.step_wait())
    assert np.array_equal(found[0][0], found[1][0])
    assert np.array_equal(found[0][2], found[1][2])
    return found[0][1], found[1][1], found[0][2], found[0][3]


def test_the_discounted_return_is_that_of_the_task():
    """Over a whole episode, up to its first step and its time limit."""
    plain, changed = made(duration_s=1.2, max_episode_steps=25)
    rng, states, changes = np.random.default_rng(0), [], []
    for k in range(25):
        state, change, over, _ = stepped(plain, changed, rng.uniform(-0.3, 0.3, (2 * N, 7)))
        states.append(state)
        changes.append(change)
        assert over.all() == (k == 24)
    discount = GAMMA ** np.arange(25)[:, None]
    states, changes = np.array(states), np.array(changes)
    assert np.abs(np.diff(states, axis=0)).max() > 1e-3
    found, asked = (discount * changes).sum(axis=0), (1.0 - GAMMA) * (discount * states)[1:].sum(axis=0)
    rest = GAMMA * discount[-1] * states[-1]  # of the state in which time has run out, which the learner bootstraps
    assert np.allclose(found, asked + rest - GAMMA * states[0], rtol=0, atol=1e-12)
    _, change, _, _ = stepped(plain, changed, np.zeros((2 * N, 7)))
    assert (change == 0.0).all()  # the first step of the next episode


def test_a_lost_block_takes_back_what_was_earned():
    plain, changed = made()
    for _ in range(3):
        before, _, _, _ = stepped(plain, changed, np.zeros((2 * N, 7)))
    for env in (plain, changed):
        put(env, 0, (0.0, 0.0, -0.2))
    state, change, over, infos = stepped(plain, changed, np.zeros((2 * N, 7)))
    assert over.tolist() == [True, True, False, False]
    assert infos[0]["end_reason"] == "block_fell"
    assert np.allclose(change[:2], state[:2] - before[:2] - GAMMA * state[:2], rtol=0, atol=1e-12)
    assert np.allclose(change[2:], state[2:] - before[2:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("duration_s", "most", "refused"), [(20.0, True, False), (0.8, False, False), (0.8, False, True)]
)
def test_a_finish_counts_for_the_time_that_is_left_and_at_most_for_ever(duration_s, most, refused):
    plain, changed = made(duration_s=duration_s)
    for env in (plain, changed):
        core = env.cells.core
        objects = core.cell._physics._props.objects
        core.task.passed[:] = 6
        core._refused[:] = refused
        for part, wanted in zip(objects["block"], objects["target"], strict=True):
            part[:] = wanted
    left, state, over = round(duration_s / 0.04), None, np.zeros(2 * N, dtype=bool)
    while not over.any():
        before = state
        state, change, over, infos = stepped(plain, changed, np.zeros((2 * N, 7)))
        left -= 1
    assert over.all()
    assert infos[0]["end_reason"] == ("solved_after_refusal" if refused else "success")
    spared = np.array([info["reward/finish"] for info in infos])
    assert np.allclose(spared, 1.03 * left, rtol=1e-3)  # as precise as can be
    finish = (1.0 - GAMMA) * spared
    assert ((finish > 1.0) == most).all()
    assert np.allclose(change, (state - spared - before) + np.minimum(finish, 1.0), rtol=0, atol=1e-9)


@pytest.mark.parametrize("refusals", [0.0, 0.5, 1.0])
def test_a_refused_motion_costs_its_time_and_a_part_of_its_term(refusals):
    plain, changed = made(refusals, at_limits="refuse")
    rng, before, refused = np.random.default_rng(0), None, 0
    for _ in range(60):
        reward, change, over, infos = stepped(plain, changed, rng.uniform(-1.0, 1.0, (2 * N, 7)))
        assert not over.any()
        refusal = np.array([info["reward/refusal"] for info in infos])
        refused += int(refusal.sum())
        state = reward + refusal
        asked = (0.0 if before is None else state - before) - (1.0 - GAMMA) * refusals * refusal
        assert np.allclose(change, asked, rtol=0, atol=1e-12)
        before = state
    assert refused > 0


@pytest.mark.parametrize("gamma", [1.0, -0.1, float("nan")])
def test_a_discount_without_effect_is_refused(gamma):
    with pytest.raises(SettingsError, match="below 1"):
        RewardDifferences(None, gamma)
