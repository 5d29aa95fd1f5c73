"""Two arms that hold one object: rows 34, 50 and 52 of the table of faults in `docs/reference/faults.md`."""

import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.sim2real.control.coupling import Coupling, pose_errors
from tests import soak
from tests.virtual.faults.lab import ARMS, VirtualLab

ROD = {"name": "rod", "kind": "capsule", "from_m": [-0.6, 0.0, 0.25], "to_m": [0.6, 0.0, 0.25], "radius_m": 0.01}


@pytest.fixture
def lab():
    made = VirtualLab(task="SyncCarry")
    made.policy = policies.load("scripted", "DualUR10/SyncCarry-v0")
    yield made
    made.close()


def go(lab, observation, steps):
    for _ in range(steps):
        observation, _, terminated, _, info = lab.env.step(lab.policy(observation))
        assert not terminated, info
    return observation


@pytest.mark.parametrize(("joint", "away"), [(5, 0.06), (0, 0.03)])
def test_52_coupled_arms_stop_on_an_error_of_their_relative_pose(lab, joint, away):
    go(lab, lab.begin(steps=0), 5)
    hold = np.zeros(14, dtype=np.float32)
    lab.policy = lambda observation=None: hold
    for _ in range(25):
        lab.env.step(hold)
    told = list(lab.ask("left", "actual_q")[0])
    told[joint] += away
    lab.override("left", actual_q=told)
    error = lab.step_until_faulted()
    lab.assert_stopped(error, "the arms, which hold one object, are ", "allowed are 10 mm and 3°", seen_ticks=7)


def test_arms_are_coupled_from_the_first_action_until_they_rest(lab, monkeypatch):
    """Not on the way to a start, on which they hold nothing, nor when a person is asked."""
    asked = []
    observation = lab.begin(steps=0, confirm=lambda text: asked.append(memory.coupled if asked else None) or True)
    memory, runner = lab.runner.cell, lab.runner
    assert not memory.coupled
    for _ in range(10):
        observation, _, _, _, info = lab.env.step(lab.policy(observation))
        assert memory.coupled
        assert 0.0 < info["coupling_error_m"] < 1e-3
    end, wait, waited = runner.end, runner.wait_for, []

    def wait_for(period):
        wait(period)
        waited.append((period, memory.coupled))

    monkeypatch.setattr(runner, "wait_for", wait_for)
    lab.env.reset()
    assert waited[0] == (end, True)  # what they hold is guarded until the brake ends
    assert asked == [None, False]
    assert not any(coupled for _, coupled in waited[1:])


def test_50_what_is_carried_meets_nothing(lab):
    """The bar's middle would, half a metre from both grippers."""
    lab.configure(obstacle=[ROD])
    observation, terminated = lab.begin(steps=0, at_limits="refuse"), False
    for _ in range(300):
        observation, _, terminated, _, info = lab.env.step(lab.policy(observation))
        for wire in lab.wires:
            wire.note()
        if terminated:
            break
    assert terminated
    assert "held_bar and obstacle/rod" in info["safety"].subject
    assert lab.latch.read() is None  # it is no fault
    lab.assert_within_limits()


def test_34_a_slider_does_not_tear_a_held_object(lab):
    observation = go(lab, lab.begin(steps=0), 10)
    lab.cell.ask("slider", arm="left", fraction=0.1)
    observation = go(lab, observation, 5)
    lab.cell.ask("slider", arm="left", fraction=1.0)
    observation = go(lab, observation, 15)
    lab.cell.ask("slider", arm="right", fraction=0.5)
    go(lab, observation, 20)
    assert lab.latch.read() is None
    mounts = (lab.env.unwrapped.core.config.left, lab.env.unwrapped.core.config.right)
    sent = [memory.sent()[0] for memory in lab.runner.arms]
    low = max(each.period[0] for each in sent)
    periods = np.arange(low, min(each.period[-1] for each in sent) + 1)
    indices = [np.interp(periods, each.period, each.index) for each in sent]
    # What each was sent, and what it should have been sent were both as far as the left one.
    arms = list(zip(lab.runner.arms, indices, strict=True))
    was, should = (
        np.array([[memory.target(at[row]) for memory, at in pairs] for row in range(0, len(periods), 5)])
        for pairs in (arms, [(memory, indices[0]) for memory in lab.runner.arms])
    )
    coupling = Coupling(mounts)
    apart_m, apart_rad = pose_errors(coupling.relative_poses(was), coupling.relative_poses(should))
    assert apart_m.max() < 1e-3
    assert apart_rad.max() < np.radians(0.3)


@pytest.mark.skipif(not soak.SOAK, reason="takes a minute: in a soak")
def test_34_a_carry_succeeds_whatever_the_slider_does(lab):
    observation, over, steps = lab.begin(steps=0), False, 0
    while not over:
        if steps % 50 == 25:
            lab.cell.ask("slider", arm=ARMS[steps // 50 % 2], fraction=(0.25, 1.0)[steps // 100 % 2])
        observation, _, terminated, truncated, info = lab.env.step(lab.policy(observation))
        over, steps = terminated or truncated, steps + 1
    assert info["is_success"]
