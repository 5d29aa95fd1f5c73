"""Reaction to motions that the safety gate refuses: the episode ends, or continues after a brake."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.core import Core
from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.control.limits import HISTORY

TOWARDS_EACH_OTHER = np.tile([1.0, 0, 0, 0, 0, 0], 2).astype(np.float32) * np.repeat([-1.0, 1.0], 6).astype(np.float32)
"""Pans of both shoulders with which the arms meet within two seconds."""


def begun(**keywords):
    core = Core("SineTracking", {"at_limits": "refuse", **keywords})
    core.reset([np.random.default_rng(0)])
    return core


def until_refused(core, action=TOWARDS_EACH_OTHER):
    for sign in (1.0, -1.0):
        for _ in range(120):
            step = core.step(sign * action)
            if step.verdicts:
                return step, sign * action
    raise AssertionError("nothing was refused")


def test_a_refusal_ends_an_episode_if_wanted():
    core = begun(on_refusal="terminate")
    step, _ = until_refused(core)
    assert step.terminated[0]
    assert step.ends[0].startswith("refused")
    assert "reward/refusal" not in step.info


def test_an_episode_continues_after_the_brake():
    core = begun()
    step, towards = until_refused(core)
    braking = 0
    while step.verdicts:
        braking += 1
        assert not step.terminated[0]
        assert step.info["reward/refusal"][0] == (braking == 1)  # once per refusal, however long the brake takes
        assert (step.reward[0] < 0.0) == (braking == 1)
        # The observed command is that of the brake, not what the policy wanted.
        commanded = core.task.layout.split(step.observation)["commanded_q_rad"][0]
        assert (commanded == core.pipeline.gate.last_targets_rad[0]).all()
        step = core.step(-towards)  # without effect until the arms rest; away from each other nothing is refused
    assert 2 <= braking <= 25
    before = core.pipeline.adapter.commanded_q_rad.copy()
    for _ in range(5):
        step = core.step(-towards)
        assert not step.verdicts
        assert step.info["reward/refusal"][0] == 0.0
    assert np.abs(core.pipeline.adapter.commanded_q_rad - before).max() > 0.05


def test_a_motion_that_is_refused_again_and_again_costs_once_until_another_is_released():
    core = begun()
    _, towards = until_refused(core)
    costs, refused = [], [True]
    for action in [towards] * 40 + [-towards] * 3 + [towards] * 40:
        step = core.step(action)
        costs.append(step.info["reward/refusal"][0])
        refused.append(bool(step.verdicts))
    assert costs == [now and not before for before, now in itertools.pairwise(refused)]
    assert sum(costs) >= 1.0  # beside the first one
    assert sum(costs[:40]) == 0.0
    assert sum(refused) > 50
    core.reset([np.random.default_rng(0)])
    assert until_refused(core)[0].info["reward/refusal"][0] == 1.0


def test_an_episode_with_a_refusal_is_no_success():
    core = begun(success_rms_m=1.0, duration_s=8.0)
    _, towards = until_refused(core)
    while not (step := core.step(-towards * 0.1)).truncated[0]:
        pass
    assert not step.info["is_success"][0]
    assert step.ends[0] == "solved_after_refusal"
    core.reset([np.random.default_rng(0)])
    while not (step := core.step(np.zeros(12))).truncated[0]:
        pass
    assert step.info["is_success"][0]


@pytest.mark.parametrize("task", ["SineTracking", "Handover"])
def test_targets_keep_all_limits_across_brakes(task):
    core = Core(task, {"at_limits": "refuse"})
    core.reset([np.random.default_rng(0)])
    envelope, rng = core.pipeline.gate.envelope, np.random.default_rng(1)
    targets = [np.repeat(core.pipeline.gate.last_targets_rad[0][None], HISTORY, axis=0)]
    advance, refused = core.cell.advance, 0

    def noted(command):
        targets.append(command.targets_rad[0])
        return advance(command)

    core.cell.advance = noted
    for _ in range(400):
        refused += bool(core.step(rng.uniform(-1.0, 1.0, core.action_space.shape)).verdicts)
    assert refused > 10
    path, tick_s, limits = np.concatenate(targets), core.config.servoj.tick_s, core.pipeline.gate.limits
    for order, limit in enumerate((limits.speed_rad_s, limits.acceleration_rad_s2, limits.jerk_rad_s3), start=1):
        used = np.abs(np.diff(path, n=order, axis=0)) / tick_s**order / limit
        assert used.max() < 1.02, order  # the rest of a brake ends at once
    assert envelope is core.pipeline.gate.envelope


def test_a_row_equals_a_single_environment_across_brakes():
    rng = np.random.default_rng(2)
    vector = DualArmVectorEnv(3, "SineTracking", autoreset_mode="Disabled", at_limits="refuse")
    single = gym.make("DualUR10/SineTracking-v0", at_limits="refuse")
    vector.reset(seed=5)
    single.reset(seed=6)
    refused = 0
    for number in range(300):
        if number % 20 == 0:
            actions = rng.uniform(-1.0, 1.0, (3, 12)).astype(np.float32)
        rows, reward, *_ = vector.step(actions)
        row, own, *_, info = single.step(actions[1])
        assert (rows[1] == row).all()
        assert reward[1] == own
        refused += "safety" in info
    assert refused > 5
    vector.close()
    single.close()


def test_an_unknown_reaction_names_the_choices():
    with pytest.raises(UnknownNameError, match="'brake', 'terminate'"):
        gym.make("DualUR10/SineTracking-v0", on_refusal="ignore")


def test_led_motion_names_the_pair_of_bodies_that_has_the_least_room():
    envs = gym.make_vec("DualUR10/SineTracking-v0", num_envs=2, action_mode="tcp_delta")
    envs.reset(seed=0)
    down = np.zeros((2, 12), dtype=np.float32)
    down[1, 2] = -1.0
    for _ in range(100):
        *_, info = envs.step(down)
        if info["led"][1]:
            break
    assert info["led"].tolist() == info["_led_by"].tolist() == [False, True]
    assert info["led_by"][1].startswith("left/")
    assert info["led_by"][1].endswith(" and table")
