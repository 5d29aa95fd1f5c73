"""Slowing down near things, through all processes: rows 49 and 50 of the table of faults."""

import numpy as np
import pytest

from dual_ur10.sim2real.control.clearance import MINIMUM_M
from dual_ur10.sim2real.control.proximity import LEAST_SCALING, LEAST_SPEED_M_S, NEAR_M, NEAR_SPEED_M_S
from tests.virtual.faults.lab import ARMS

WAYS = [  # an arm and itself are pairs like these
    pytest.param(((0, 0, -0.3), (1, 0, 0.3)), "right/", id="49-arms"),
    pytest.param(((0, 1, 0.3),), "table", id="50-table"),
]


@pytest.mark.parametrize(("moves", "other"), WAYS)
def test_49_50_both_arms_slow_down_together_and_are_fast_again_on_the_way_back(lab, moves, other):
    lab.begin(steps=0, at_limits="refuse")
    cell = lab.runner.cell
    action = np.zeros((2, 6), dtype=np.float32)
    for arm, joint, share in moves:
        action[arm, joint] = share
    over = False
    while not over:
        assert cell.largest_scaling >= LEAST_SCALING
        _, _, over, _, info = lab.env.step(action.reshape(-1))
    assert other in info["safety"].subject.partition(" and ")[2]
    lab.runner.wait_for(lab.runner.end)
    assert LEAST_SCALING <= cell.largest_scaling <= 0.5
    assert cell.time_scaling.goal == cell.largest_scaling
    lab.clock.sleep(0.5)
    for arm in ARMS:
        assert np.abs(lab.ask(arm, "actual_qd")[0]).max() < 1e-3
    q_rad, time_s = lab.measured()
    clearance = lab.env.unwrapped.core.cell._clearance
    pair = [" and ".join(each) for each in clearance.pairs].index(info["safety"].subject)
    distance = clearance.measure(q_rad.reshape(-1, 12)).distances_m[:, pair]
    # The first state may be there more than once.
    speed = -np.diff(distance) / np.maximum(np.diff(time_s), lab.tick_s)
    near = distance[1:] < NEAR_M
    assert near.any()
    assert distance.min() >= MINIMUM_M - 1e-4
    room = (distance[1:] - MINIMUM_M) / (NEAR_M - MINIMUM_M)
    assert (speed <= LEAST_SPEED_M_S + room * (NEAR_SPEED_M_S - LEAST_SPEED_M_S))[near].all()
    lab.assert_within_limits()
    index = [dict(zip(*_sent(memory), strict=True)) for memory in lab.runner.arms]
    common = sorted(set(index[0]) & set(index[1]))
    assert len(common) > 50
    np.testing.assert_allclose([index[0][k] for k in common], [index[1][k] for k in common], atol=1e-9)
    assert lab.latch.read() is None  # it is no fault
    lab.reset(seed=1)
    assert cell.largest_scaling == cell.time_scaling.goal == 1.0


def _sent(memory):
    """Return control periods and target numbers that one arm was sent last."""
    sent, _ = memory.sent(memory.sent_count - 100)
    return sent.period.tolist(), sent.index.tolist()
