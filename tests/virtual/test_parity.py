"""The switch: what controllers receive is what the simulation sends, bit for bit, and every target of it."""

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.testing import VirtualCell
from tests.parity import TASK, simulated
from tests.soak import scaled
from ur_core.kinematics.ur10 import ARMS

TICKS = scaled(2000)


@pytest.mark.parametrize("latency", [5, 8])
def test_the_same_actions_give_the_same_targets_to_the_last_bit(tmp_path, latency):
    keywords, actions, expected = simulated(tmp_path, TICKS, latency)
    with VirtualCell(plant="mild", seed=5) as cell:
        env = gym.make(TASK, cell=cell, disable_env_checker=True, **keywords)
        env.reset(seed=3)
        for action in actions:
            env.step(action)
        core = env.unwrapped.core
        core.cell.runner.wait_for(core.cell.runner.now + latency)
        received = [cell.packages(arm) for arm in ARMS]
        env.close()
    for arm in range(2):
        ticks, targets = np.array([row[0] for row in received[arm]]), [tuple(row[2]) for row in received[arm]]
        begin = targets.index(tuple(expected[0, arm]))
        count = min(len(expected), len(targets) - begin)
        assert count >= TICKS
        assert targets[begin : begin + count] == [tuple(each) for each in expected[:count, arm].tolist()]
        assert set(np.diff(ticks)) == {1}
