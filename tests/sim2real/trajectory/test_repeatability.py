"""Repeatability after random paths."""

import itertools
import math
import re

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.trajectory.repeatability import returns, spread_of
from tests.cli.command import run
from tests.sim2real.trajectory.following import check_sent, made


def test_the_spread_is_that_of_iso_9283():
    positions = np.zeros((4, 2, 3))
    positions[:, 0, 0] = [0.001, -0.001, 0.001, -0.001]  # all equally far from the mean
    positions[:, 1] = [[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.004, 0.0]]
    spread = spread_of(positions + np.array([0.3, -0.2, 1.0]))
    distances = np.array([0.001, 0.001, 0.001, 0.003])
    np.testing.assert_allclose(spread.iso_9283_m, [0.001, distances.mean() + 3 * distances.std(ddof=1)])
    np.testing.assert_allclose(spread.largest_m, [0.001, 0.003])
    with pytest.raises(TrajectoryError, match="a spread of 1 positions means nothing: measure 2 or more"):
        spread_of(positions[:1])


def moved_ticks(settle_s):
    """Return the targets of one path away and back."""
    executor = made()
    next(returns(executor, 1, np.random.default_rng(0), settle_s))
    return executor.cell.sent


def test_the_arms_leave_and_return_along_released_paths():
    executor = made()
    found = list(returns(executor, 3, np.random.default_rng(0)))
    np.testing.assert_allclose(found, np.tile(HOME_Q_RAD, (3, 1, 1)), atol=1e-4)
    assert np.abs(np.array(executor.cell.sent) - HOME_Q_RAD).max() > 0.5
    check_sent(executor)
    arrived, settled = (len(moved_ticks(settle_s)) for settle_s in (0.0, 0.5))
    assert settled - arrived == 2 * math.ceil(0.5 / executor.law.period_s)
    executor.cell.offset_rad = np.full((2, 6), 0.2)
    with pytest.raises(TrajectoryError, match="a random path was not followed to its end"):
        list(returns(executor, 1, np.random.default_rng(0)))


def test_a_path_that_was_stopped_for_lateness_is_planned_again():
    executor, periods = made(5), itertools.count()
    advance, late = executor.cell.advance, {30, 130}

    def busy(command):
        executor.cell.pauses = int(next(periods) in late)
        return advance(command)

    executor.cell.advance = busy
    (found,) = returns(executor, 1, np.random.default_rng(0))
    np.testing.assert_allclose(found, HOME_Q_RAD, atol=1e-4)
    assert next(periods) > max(late)
    check_sent(executor)
    late.update(range(0, 10_000, 5))
    with pytest.raises(TrajectoryError, match="missed the deadline"):
        list(returns(executor, 1, np.random.default_rng(0)))


def test_the_command_prints_both_arms():
    code, text = run("repeatability", "--paths", "2", "--perturbed")
    assert code == 0, text
    rows = [line.split("│")[1:-1] for line in text.splitlines() if line.startswith("│")]
    assert [row[0].strip() for row in rows] == ["left", "right"]
    assert all(0.0 < float(row[1]) < 5.0 for row in rows)
    assert re.search("2 returns, 1 s after each, from encoders and forward kinematics", text)
    code, text = run("repeatability", "--paths", "1")
    assert code == 2
