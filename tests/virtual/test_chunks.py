"""Chunks on a virtual cell, whose arms lag behind: late, lost and missing ones stop no arm and are refused nowhere."""

import itertools
import math

import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.policies import rollout
from dual_ur10.policies.chunks.executor import executor_for
from dual_ur10.testing import VirtualCell
from tests.policies.chunks.sources import Once, Sway

DELAYS_S = (0.7, 0.08, math.inf, 0.0, 0.5, 0.16)


def raising(rows):
    raise ConnectionError("the server is gone")


def run(source, delays, late=()):
    """Return the episode of a chunk policy, its environment's core and the text of a latched stop."""
    with VirtualCell(task="SineTracking") as cell:
        env = cell.make("DualUR10/SineTracking-v0", duration_s=3.0)
        executor = executor_for(source, env.unwrapped.core.setup, latency_s=lambda: next(delays))
        steps = itertools.count()

        def step(_):
            if next(steps) in late:
                cell.clock.sleep(0.06)

        try:
            return rollout(env, executor, seed=0, on_step=step), env.unwrapped.core, cell.fault
        except ConnectionError as error:
            return error, env.unwrapped.core, cell.fault


def test_late_and_lost_chunks_stop_no_arm():
    episodes = []
    for _ in range(2):
        found, core, fault = run(Sway(count=12), itertools.cycle(DELAYS_S))
        assert (found.ended_by, core.late_actions, fault) == ("", 0, "")
        episodes.append(found.q_rad)
    assert np.array_equal(*episodes)
    assert np.ptp(episodes[0], axis=0).min() > 0.05


def test_arms_that_a_late_action_stopped_come_back_to_their_path():
    found = []
    for late in ((), (30,)):
        episode, core, fault = run(Sway(), itertools.repeat(0.08), late)
        assert (core.late_actions, fault) == (len(late), "")
        found.append(episode.q_rad)
    apart = np.abs(found[1] - found[0]).max(axis=(1, 2))
    assert apart.max() > 0.01
    assert apart[30:].argmax() < 5  # the stop; nothing overshoots later
    assert apart[44:].max() < 1e-3


def test_a_server_that_is_gone_latches_a_stop_of_arms_that_rest():
    error, core, fault = run(Once(raising), itertools.repeat(0.08))
    assert str(error) == "the server is gone"
    assert "the policy failed: ConnectionError: the server is gone" in fault
    targets = core.pipeline.adapter.targets_rad
    assert np.ptp(targets, axis=1).max() == pytest.approx(0.0, abs=1e-5)
