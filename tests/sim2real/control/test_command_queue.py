"""Delay of commands by the action's latency."""

import pickle

import numpy as np
import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.command_queue import MAX_LATENCY_TICKS, CommandQueue

TICKS = 5


def commands(n, periods, *, gripper=True):
    rng = np.random.default_rng(0)
    for _ in range(periods):
        widths = rng.uniform(0, 0.08, (n, TICKS, 2)) if gripper else None
        yield Command(rng.uniform(-1, 1, (n, TICKS, 2, 6)), widths)


@pytest.mark.parametrize("latency", [-1, MAX_LATENCY_TICKS + 1, 2.0, "3", None, float("nan")])
def test_an_invalid_latency_is_refused(latency):
    with pytest.raises(SettingsError, match="action_latency_ticks"):
        CommandQueue(1, latency)


@pytest.mark.parametrize("latency", [0, 1, 3, 5, 7, 12, MAX_LATENCY_TICKS])
@pytest.mark.parametrize("gripper", [True, False])
def test_commands_come_later_by_exactly_the_latency(latency, gripper):
    n, periods = 2, 40
    queue, start = CommandQueue(n, latency), np.arange(24.0).reshape(2, 2, 6)
    queue.reset(start, np.arange(n), np.full((n, 2), 0.03))
    given = list(commands(n, periods, gripper=gripper))
    acting = [queue(each) for each in given]
    sent, then = (np.concatenate([each.targets_rad for each in some], axis=1) for some in (given, acting))
    assert then.shape == sent.shape
    np.testing.assert_array_equal(then[:, :latency], np.broadcast_to(start[:, None], (n, latency, 2, 6)))
    np.testing.assert_array_equal(then[:, latency:], sent[:, : TICKS * periods - latency])
    if not gripper:
        assert all(each.gripper_m is None for each in acting)
        return
    sent, then = (np.concatenate([each.gripper_m for each in some], axis=1) for some in (given, acting))
    np.testing.assert_array_equal(then[:, latency:], sent[:, : TICKS * periods - latency])
    np.testing.assert_array_equal(then[:, :latency], 0.03)


def test_a_payload_passes():
    queue = CommandQueue(1, 3)
    command = next(commands(1, 1))._replace(payload_kg=np.array([[0.5, 1.0]]))
    np.testing.assert_array_equal(queue(command).payload_kg, [[0.5, 1.0]])


def test_a_reset_empties_the_queue_of_its_rows_only():
    queue, other = CommandQueue(3, 7), CommandQueue(3, 7)
    for each in commands(3, 4):
        queue(each)
        other(each)
    start = np.full((1, 2, 6), 0.25)
    queue.reset(start, np.array([1]))
    some, other = (np.concatenate([each(c).targets_rad for c in commands(3, 4)], axis=1) for each in (queue, other))
    np.testing.assert_array_equal(some[[0, 2]], other[[0, 2]])
    np.testing.assert_array_equal(some[1, :7], np.full((7, 2, 6), 0.25))
    np.testing.assert_array_equal(some[1, 7:], other[1, 7:])


def test_a_queue_continues_after_pickling():
    queue = CommandQueue(2, 8)
    first, *others = commands(2, 6)
    queue(first)
    restored = pickle.loads(pickle.dumps(queue))
    for each in others:
        np.testing.assert_array_equal(queue(each).targets_rad, restored(each).targets_rad)
