"""Paths of chunks: through the knots, to rest, and from one to the next within the limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.policies.chunks.chunk_path import ChunkPath, Splicer
from dual_ur10.sim2real.control.limits import MotionLimits

PERIOD_S = 0.04
LIMITS = MotionLimits(speed_rad_s=(1.2,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.5)
CAPS = np.array([1.2, 10.0, 2000.0])


def wave(dt_s, count, amplitude_rad, rate, phase):
    times = dt_s * np.arange(count)
    return amplitude_rad * np.sin(rate * times[:, None] + phase + np.arange(12) / 4)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 26])
def test_a_path_goes_through_its_knots_and_ends_at_rest(count):
    knots = wave(0.1, count, 0.2, 1.5, 0.3)
    path = ChunkPath(2.0, 0.1, knots)
    times = 2.0 + 0.1 * np.arange(count)
    assert path(times)[0] == pytest.approx(knots, abs=1e-12)
    path.brake_s = 0.1
    position, *rates = path(np.array([path.end_s + 0.051, path.end_s + 9.0]))
    assert position == pytest.approx(np.stack([knots[-1]] * 2))
    assert not np.any(rates)


def test_smooth_motion_is_resampled_within_micrometres():
    knots = wave(0.1, 26, 0.2, np.pi, 0.0)
    times = np.linspace(0.0, 2.5, 400)
    exact = 0.2 * np.sin(np.pi * times[:, None] + np.arange(12) / 4)
    assert np.abs(ChunkPath(0.0, 0.1, knots)(times)[0] - exact).max() < 1e-4


def test_rates_are_the_derivatives_of_the_path():
    path = ChunkPath(0.0, 0.1, wave(0.1, 12, 0.2, 2.0, 0.0))
    path.brake_s = 0.3
    splice = Splicer(LIMITS, PERIOD_S).splice(path, 0.2, np.stack([np.full(12, 0.1), np.full(12, 0.3), np.ones(12)]))
    times = np.linspace(0.2, 1.4, 6001)
    motion = splice(times)
    for order in range(2):
        assert np.abs(np.gradient(motion[order], times, axis=0) - motion[order + 1])[1:-1].max() < 0.02
    # The acceleration has corners at knots, and where the path begins to slow down and rests.
    wrong = np.abs(np.gradient(motion[2], times, axis=0) - motion[3]).max(axis=1)
    assert (wrong > 0.5).sum() < 60


@given(
    offset=st.floats(-0.3, 0.3),
    speed=st.floats(-0.3, 0.3),
    acceleration=st.floats(-2.0, 2.0),
    amplitude=st.floats(0.0, 0.15),
    phase=st.floats(0.0, 6.0),
)
def test_a_splice_begins_as_the_motion_before_and_keeps_the_limits(offset, speed, acceleration, amplitude, phase):
    splicer, path = Splicer(LIMITS, PERIOD_S), ChunkPath(0.0, 0.1, wave(0.1, 40, amplitude, 2.0, phase))
    state = path(np.array([0.5]))[:3, 0] + np.array([offset, speed, acceleration])[:, None]
    splice = splicer.splice(path, 0.5, state)
    assert splice(np.array([0.5]))[:3, 0] == pytest.approx(state, abs=1e-9)
    assert splice(np.array([0.5 + splice.fade_s]))[:3] == pytest.approx(path(np.array([0.5 + splice.fade_s]))[:3])
    fading = np.abs(splice(np.linspace(0.5, 0.5 + splice.fade_s, 200))[1:]).max(axis=(1, 2))
    assert (fading <= CAPS).all()


@pytest.mark.parametrize("offset_rad", [1e-4, 0.01, 0.05, 0.2, 0.5])
def test_a_fade_is_as_short_as_is_legal(offset_rad):
    rest = ChunkPath(0.0, 0.1, np.zeros((40, 12)))
    away = np.zeros((3, 12))
    away[0, [5, 11]] = offset_rad  # about the axes of the tools, which do not move
    splice = Splicer(LIMITS, PERIOD_S).splice(rest, 0.0, away)
    shortest = max(1.875 * offset_rad / 1.08, np.sqrt(5.774 * offset_rad / 9.0), np.cbrt(60 * offset_rad / 1800.0))
    assert splice.fade_s <= max(1.1 * 1.02 * shortest, 3 * PERIOD_S)
    assert splice.fade_s >= 0.99 * shortest


def test_the_end_of_a_chunk_keeps_the_limits_too():
    splicer = Splicer(LIMITS, PERIOD_S)
    for speed in (0.05, 0.5, 1.0):
        path = ChunkPath(0.0, 0.1, speed * 0.1 * np.arange(26)[:, None] * np.ones(12))
        splicer.end(path)
        motion = np.abs(path(np.linspace(0.0, 3.0, 3000))[1:]).max(axis=(1, 2))
        assert (motion <= CAPS).all()
        assert 3 * PERIOD_S <= path.brake_s <= max(1.1 * 1.02 * 1.5 * speed / 9.0, 3 * PERIOD_S)
