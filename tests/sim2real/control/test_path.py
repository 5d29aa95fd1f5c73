"""Interpolated path: smooth at the joins, exact at the commanded positions, and back on them after a jump."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dual_ur10.sim2real.control import path
from dual_ur10.sim2real.control.path import Meeting, meetings

PERIOD_S = 0.04

MEETINGS = meetings(PERIOD_S)


def follow(commands: np.ndarray, meeting: Meeting, times_s: np.ndarray) -> np.ndarray:
    """Return position, speed and acceleration within each period, (k, 3, t), after three initial commands."""
    rows = path.path(PERIOD_S, times_s, meeting.periods)
    meets = path.continuation(PERIOD_S, meeting.periods, path.POINTS if meeting.curved else 2)
    values, result = np.zeros(path.VALUES), []
    values[path.POSITION] = commands[2]
    for k in range(3, len(commands)):
        values[path.MEETING :] = meets @ commands[k - 3 : k + 1]
        result.append([rows.position @ values, rows.speed @ values, rows.acceleration @ values])
        values[: path.MEETING] = rows.end @ values
    return np.array(result)


def resting_then(moves: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros(3), moves])


def test_meetings_begin_with_the_next_command_and_leave_no_gap() -> None:
    for period_s in (0.008, 0.04, 0.2):
        periods = [each.periods for each in meetings(period_s)]
        assert meetings(period_s)[0] == Meeting(1, True)
        lines = [1] + [each.periods for each in meetings(period_s) if not each.curved]
        assert all(after <= max(before + 1, 1.3 * before + 0.5) for before, after in pairwise(lines))
        assert max(periods) * period_s >= 0.5


@pytest.mark.parametrize("meeting", MEETINGS)
def test_the_path_is_twice_continuously_differentiable(meeting: Meeting) -> None:
    commands = resting_then(np.random.default_rng(0).normal(size=30))
    parts = follow(commands, meeting, np.array([0.0, PERIOD_S]))
    for order in range(3):
        scale = np.abs(parts[:, order]).max()
        np.testing.assert_allclose(parts[1:, order, 0], parts[:-1, order, 1], atol=1e-10 * scale)


@pytest.mark.parametrize("meeting", MEETINGS)
@pytest.mark.parametrize("free", [False, True])
def test_speed_and_acceleration_are_derivatives_of_the_position(meeting: Meeting, free: bool) -> None:
    times = np.linspace(0.0, PERIOD_S * (meeting.periods + 1), 4001)  # as far as beyond the meeting
    rows = path.path(PERIOD_S, times, meeting.periods, free)
    values = np.random.default_rng(1).normal(size=path.VALUES) * (PERIOD_S * meeting.periods) ** -np.tile(
        np.arange(4), 2
    )
    position, speed, acceleration = (each @ values for each in (rows.position, rows.speed, rows.acceleration))
    step = times[1]
    np.testing.assert_allclose(np.gradient(position, step)[1:-1], speed[1:-1], atol=1e-4 * np.abs(speed).max())
    change = np.gradient(speed, step)[1:-1]
    np.testing.assert_allclose(change, acceleration[1:-1], atol=1e-3 * np.abs(acceleration).max())


@pytest.mark.parametrize("periods", [1, 2, 7])
def test_the_path_meets_the_continuation_with_its_derivatives(periods: int) -> None:
    values = np.random.default_rng(2).normal(size=path.VALUES)
    at = np.array([0.0, periods * PERIOD_S])
    rows = path.path(PERIOD_S, at, periods)
    for order, each in enumerate((rows.position, rows.speed, rows.acceleration)):
        np.testing.assert_allclose(each[0] @ values, values[path.POSITION + order], rtol=1e-9)
        np.testing.assert_allclose(each[1] @ values, values[path.MEETING + order], rtol=1e-7)
    if periods == 1:
        np.testing.assert_allclose(rows.end @ values, values[path.MEETING :], rtol=1e-6)


def test_a_free_path_does_not_depend_on_the_continuations_position() -> None:
    rows = path.path(PERIOD_S, np.linspace(0, 0.3, 20), 5, free=True)
    assert np.abs(rows.position[:, path.MEETING]).max() == 0.0
    assert np.abs(rows.position[-1, path.MEETING + 1]) > 0.05


def test_the_first_meeting_is_exact_at_every_command() -> None:
    commands = resting_then(np.random.default_rng(2).normal(size=40))
    parts = follow(commands, MEETINGS[0], np.array([PERIOD_S]))
    np.testing.assert_allclose(parts[:, 0, 0], commands[3:], atol=1e-12)


@pytest.mark.parametrize("meeting", MEETINGS)
def test_a_steady_motion_is_followed_exactly(meeting: Meeting) -> None:
    times = np.array([0.0, 0.3, 1.0]) * PERIOD_S
    rows = path.path(PERIOD_S, times, meeting.periods)
    # Commanded so far: position 2 now, 0.5 rad/s.
    commands = 2 + 0.5 * PERIOD_S * np.arange(-2, 2)
    values = np.zeros(path.VALUES)
    values[:2] = 2.0, 0.5
    values[path.MEETING :] = path.continuation(PERIOD_S, meeting.periods, 4 if meeting.curved else 2) @ commands
    np.testing.assert_allclose(rows.position @ values, 2 + 0.5 * times, atol=1e-12)
    np.testing.assert_allclose(rows.speed @ values, 0.5, atol=1e-10)
    np.testing.assert_allclose(rows.end @ values, [2 + 0.5 * PERIOD_S, 0.5, 0.0, 0.0], atol=1e-6)


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


@pytest.mark.parametrize("meeting", [each for each in MEETINGS if not each.curved])
def test_after_a_jump_later_meetings_converge(meeting: Meeting) -> None:
    parts = follow(resting_then(np.ones(150)), meeting, np.linspace(0.0, PERIOD_S, 11))
    position = parts[:, 0]
    assert np.abs(position[100:] - 1.0).max() < 1e-3
    assert np.abs(parts[-1] - np.array([[1.0], [0.0], [0.0]])).max() < 1e-4


def test_a_later_meeting_takes_a_jump_with_less_acceleration() -> None:
    times = np.linspace(0.0, PERIOD_S, 11)
    lines = [Meeting(1, False), *(each for each in MEETINGS if not each.curved)]
    peaks = [np.abs(follow(resting_then(np.array([0.0, 1.0])), meeting, times)[-1, 2]).max() for meeting in lines]
    assert all(later < 0.9 * sooner for sooner, later in pairwise(peaks))
