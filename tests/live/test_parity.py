"""The switch: what controllers receive is what the simulation sends, bit for bit."""

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.emulated.emulated_cell import EmulatedCell
from tests import soak
from tests.parity import TASK, simulated

pytestmark = pytest.mark.streams

ARMS = ("left", "right")
TICKS = soak.scaled(10_000)
LATENCY = 100  # so long that no machine is too slow, and nothing else changes by it
AHEAD = 13  # targets that may be left out in a row, because their time had passed: 0.1 s later arms are stopped
TRIES = 3
SHARE = 0.9  # of all targets that controllers receive, however busy the machine is


def test_the_same_actions_give_the_same_targets_to_the_last_bit(tmp_path):
    keywords, actions, expected = simulated(tmp_path, TICKS, LATENCY)
    for number in range(TRIES):
        received, shifted = received_by_controllers(tmp_path / str(number), keywords, actions)
        whole = all(tuple(expected[-1, arm]) in {tuple(each) for each in received[arm]} for arm in range(2))
        if whole and not shifted:
            break
    assert not shifted, "a machine that stalls again and again: clocks were shifted in every try"
    assert whole, "a machine that stalls again and again: the last targets missed their deadline in every try"
    for arm in range(2):
        found, followed = aligned(received[arm], expected[:, arm])
        assert found[-1] == len(expected) - 1
        # A busy machine leaves some out; none is another.
        assert len(set(found)) >= SHARE * len(expected)
        assert not followed or len(found) > 100  # what follows is the brake


def received_by_controllers(folder, keywords, actions):
    """Targets that each emulated controller received, and whether a stall has shifted a clock against them.

    Where a controller stalls its periods lie between targets afterwards, until the shift is gone.
    """
    folder.mkdir()
    with EmulatedCell(plant="mild", seed=5, cell=str(folder / "lab.toml")) as cell:
        for arm in ARMS:
            cell.wait_until(arm, "robot_mode", 7)
        env = gym.make(TASK, cell=str(folder / "lab.toml"), disable_env_checker=True, **keywords)
        received = [[], []]
        seen = [0, 0]

        def collect():
            for arm, name in enumerate(ARMS):
                rows = cell.packages(name, seen[arm])
                seen[arm] += len(rows)
                received[arm] += [each[2] for each in rows]

        try:
            seen = [cell.ask("received", arm=arm)["motion"] for arm in ARMS]
            env.reset(seed=3)
            shifted = False
            arms = env.unwrapped.core.cell.runner.arms
            for step, action in enumerate(actions):
                env.step(action)
                if step % 20 == 0:
                    collect()
                    index = np.concatenate([each.sent()[0].index for each in arms])
                    shifted |= bool((np.abs(index - np.rint(index)) > 1e-9).any())
            core = env.unwrapped.core
            assert core.late_actions == 0, "an action came late: this machine is too busy"
            # The last targets are still to come.
            core.cell.runner.wait_for(core.cell.runner.now + LATENCY)
            collect()
        finally:
            env.close()
    return received, shifted


def aligned(executed, expected):
    """Numbers of the expected targets in the order in which they were executed, and how many others followed them."""
    known = [tuple(each) for each in expected.tolist()]
    begin = next(k for k, each in enumerate(executed) if tuple(each) == known[0])
    found = [0]
    for k, target in enumerate(executed[begin + 1 :], start=begin + 1):
        near = range(found[-1], min(found[-1] + AHEAD, len(known)))
        number = next((each for each in near if known[each] == tuple(target)), None)
        if number is None:
            assert found[-1] == len(known) - 1, f"{target} is none of the targets behind number {found[-1]}"
            return found, len(executed) - k
        found.append(number)
    return found, 0


@pytest.mark.parametrize("tick", [0, 7, 199])
def test_one_wrong_bit_is_seen(tick):
    expected = np.random.default_rng(0).uniform(-1, 1, (200, 6))
    executed = expected.copy()
    assert aligned(executed.tolist(), expected)[0] == list(range(200))
    executed[tick, 3] = np.nextafter(executed[tick, 3], 2.0)
    try:
        numbers, _ = aligned(executed.tolist(), expected)
    except (AssertionError, StopIteration):
        return
    assert numbers[-1] < 199
