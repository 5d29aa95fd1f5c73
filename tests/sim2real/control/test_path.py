"""Interpolated path: smooth at the joins, exact at the commanded positions, and back on them after a jump."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10.sim2real.control import path
from dual_ur10.sim2real.control.path import Meeting, meetings

MEETINGS = meetings(0.04)

PERIOD_S = 0.04


def follow(commands: np.ndarray, meeting: Meeting, times_s: np.ndarray, period_s: float = PERIOD_S) -> np.ndarray:
    """Return position, speed and acceleration within each period, (k, 3, t), after three initial commands."""
    rows = path.path(period_s, times_s, meeting)
    values, result = np.zeros(path.VALUES), []
    values[:3] = commands[:3]
    values[path.POSITION] = commands[2]
    for command in commands[3:]:
        values[path.GOAL] = command
        result.append([rows.position @ values, rows.speed @ values, rows.acceleration @ values])
        values[path.STATE] = rows.end @ values
        values[:3] = values[1:4].copy()
    return np.array(result)


def resting_then(moves: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros(3), moves])


@pytest.mark.parametrize("meeting", MEETINGS)
def test_the_path_is_twice_continuously_differentiable(meeting: Meeting) -> None:
    commands = resting_then(np.random.default_rng(0).normal(size=30))
    parts = follow(commands, meeting, np.array([0.0, PERIOD_S]))
    for order in range(3):
        scale = np.abs(parts[:, order]).max()
        np.testing.assert_allclose(parts[1:, order, 0], parts[:-1, order, 1], atol=1e-11 * scale)


@pytest.mark.parametrize("meeting", MEETINGS)
def test_speed_and_acceleration_are_derivatives_of_the_position(meeting: Meeting) -> None:
    commands = resting_then(np.random.default_rng(1).normal(size=3))
    times = np.linspace(0.0, PERIOD_S, 2001)
    for position, speed, acceleration in follow(commands, meeting, times):
        step = times[1]
        np.testing.assert_allclose(np.gradient(position, step)[1:-1], speed[1:-1], atol=2e-5 * np.abs(speed).max())
        change = np.gradient(speed, step)[1:-1]
        np.testing.assert_allclose(change, acceleration[1:-1], atol=2e-5 * np.abs(acceleration).max())


def test_the_first_meeting_is_exact_at_every_command() -> None:
    commands = resting_then(np.random.default_rng(2).normal(size=40))
    parts = follow(commands, MEETINGS[0], np.array([PERIOD_S]))
    np.testing.assert_allclose(parts[:, 0, 0], commands[3:], atol=1e-12)


@pytest.mark.parametrize("meeting", MEETINGS)
def test_a_steady_motion_is_followed_exactly(meeting: Meeting) -> None:
    times = np.array([0.0, 0.3, 1.0]) * PERIOD_S
    rows = path.path(PERIOD_S, times, meeting)
    # Commanded so far: position 2 now, 0.5 rad/s.
    values = np.array([2 - 2 * 0.5 * PERIOD_S, 2 - 0.5 * PERIOD_S, 2.0, 2 + 0.5 * PERIOD_S, 2.0, 0.5, 0.0, 0.0])
    np.testing.assert_allclose(rows.position @ values, 2 + 0.5 * times, atol=1e-12)
    np.testing.assert_allclose(rows.speed @ values, 0.5, atol=1e-11)
    np.testing.assert_allclose(rows.end @ values, [2 + 0.5 * PERIOD_S, 0.5, 0.0, 0.0], atol=1e-7)


def test_a_sine_at_25_hz_is_off_by_less_than_3_micrometres() -> None:
    # 0.25 rad at an arm of 0.4 m are the 0.1 m of the sine task.
    times, omega = np.linspace(0.0, PERIOD_S, 21), 2 * np.pi * 0.5
    starts = np.arange(200) * PERIOD_S
    commands = 0.25 * np.sin(omega * np.arange(-2, 201) * PERIOD_S)
    commands[:3] -= commands[2]
    parts = follow(commands, MEETINGS[0], times)[:, 0]
    wanted = 0.25 * np.sin(omega * (starts[:, None] + times))
    settled = starts > 0.5  # it starts from rest, not with the sine's speed
    assert np.abs(parts - wanted)[settled].max() * 0.4 < 3e-6


@pytest.mark.parametrize("meeting", MEETINGS[1:])
def test_after_a_jump_the_later_meetings_converge(meeting: Meeting) -> None:
    parts = follow(resting_then(np.ones(80)), meeting, np.linspace(0.0, PERIOD_S, 11))
    position = parts[:, 0]
    assert np.abs(position[40:] - 1.0).max() < 1e-3
    assert np.abs(parts[-1] - np.array([[1.0], [0.0], [0.0]])).max() < 1e-4
    assert position.max() < 2.5


def test_a_later_meeting_takes_a_jump_with_less_acceleration() -> None:
    times = np.linspace(0.0, PERIOD_S, 11)
    peaks = [np.abs(follow(resting_then(np.ones(1)), meeting, times)[:, 2]).max() for meeting in MEETINGS]
    assert peaks[0] > peaks[1] > 3 * peaks[2] > 15 * peaks[3]
