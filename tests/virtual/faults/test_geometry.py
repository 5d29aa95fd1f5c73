"""Forbidden configurations: rows 48 to 52 of the table of faults in `docs/reference/faults.md`."""

import numpy as np
import pytest

from dual_ur10.sim2real.control.cartesian_step import HALT_CONDITION, SLOW_CONDITION, condition
from tests.virtual.faults.lab import ARMS
from ur_core.kinematics.ur10 import NOMINAL_DH

WALL = {"name": "wall", "kind": "plane", "point_m": [0.35, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}


def drive(lab, *moves, most=300):
    """Rotate joints, given as arm, joint and speed, until the episode ends; return the last `info`."""
    action = np.zeros((2, 6))
    for arm, joint, share in moves:
        action[arm, joint] = share
    for _ in range(most):
        _, _, over, _, info = lab.env.step(action.reshape(-1))
        if over:
            return info
    raise AssertionError("nothing was in the way")


WAYS = [
    pytest.param(((1, 2, 1.0), (1, 1, -0.5)), ("right/wrist", "right/"), id="48-self"),
    pytest.param(((0, 0, -1.0), (1, 0, 1.0)), ("left/", "right/"), id="49-arms"),
    pytest.param(((0, 1, 1.0),), ("left/", "table"), id="50-table"),
]


@pytest.mark.parametrize(("moves", "words"), WAYS)
def test_48_49_50_the_gate_brakes_before_anything_meets(lab, moves, words):
    lab.begin(steps=0, at_limits="refuse")
    info = drive(lab, *moves)
    first, _, second = info["safety"].subject.partition(" and ")
    assert info["safety"].kind == "distance"
    assert first.startswith(words[0])
    assert second.startswith(words[1])
    lab.runner.wait_for(lab.runner.end)
    lab.clock.sleep(0.5)
    for arm in ARMS:
        assert np.abs(lab.ask(arm, "actual_qd")[0]).max() < 1e-3
    assert 0.0199 <= lab.nearest_m() < 0.2
    lab.assert_within_limits()
    assert lab.latch.read() is None  # it is no fault


@pytest.mark.parametrize(
    ("mode", "action", "along"),
    [
        pytest.param("joint_delta", [-0.7, 0, 0, 0, 0, 0, 0.7, 0, 0, 0, 0, 0], 0, id="49-arms"),
        pytest.param("tcp_delta", [0, 0.2, -1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 0, id="50-table"),
        pytest.param("tcp_delta", [1.0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0, 0], None, id="51-reach"),
    ],
)
def test_49_50_51_arms_are_led_along_what_is_in_their_way(lab, mode, action, along):
    lab.begin(steps=0, action_mode=mode)
    pipeline, led, moved = lab.env.unwrapped.core.pipeline, 0, []
    for _ in range(60):
        before = pipeline.gate.last_targets_rad
        _, _, over, _, info = lab.env.step(np.array(action, dtype=np.float32))
        assert not over
        led += bool(info["led"])
        if info["led"]:
            moved.append(np.abs(pipeline.gate.last_targets_rad - before)[0, along or 0].max())
    assert lab.latch.read() is None
    if along is not None:
        assert led > 10
        assert np.median(moved) > 1e-3  # rad per period: it goes on, along it
    lab.assert_within_limits()
    assert lab.nearest_m() >= 0.0199


def test_50_an_obstacle_of_the_cell_file_is_one(lab):
    lab.configure(obstacle=[WALL])
    lab.begin(steps=0, at_limits="refuse")
    info = drive(lab, (0, 1, 0.5), (0, 2, -1.0), (0, 3, 0.5))
    assert "wall" in info["safety"].subject, info["safety"]
    lab.clock.sleep(0.5)
    assert lab.nearest_m() >= 0.0199


def test_51_cartesian_actions_end_before_a_singularity(lab):
    lab.make(action_mode="tcp_delta")
    lab.env.reset(seed=0)
    action = np.zeros((2, 6))
    action[0, 0] = 1.0  # outwards, until the arm is stretched
    ended = False
    for _ in range(90):
        _, _, ended, _, info = lab.env.step(action.reshape(-1))
        if ended:
            break
    assert not ended or info["safety"].kind == "distance"
    assert lab.latch.read() is None
    lab.assert_within_limits()
    found = condition(lab.executed("left"), NOMINAL_DH)
    assert SLOW_CONDITION < found.max() <= HALT_CONDITION
    assert found[-1] == pytest.approx(found.max(), rel=0.1)  # all but stretched, there it waits
