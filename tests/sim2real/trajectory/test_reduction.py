"""Reduction of trajectories to few points."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import TrajectoryError, UnknownNameError
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.reduction import reduce_points
from tests.sim2real.trajectory.following import wave
from tests.soak import scaled
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.inverse import nearest
from ur_core.kinematics.ur10 import NOMINAL_DH

KINDS = pytest.mark.parametrize("kind", ["cubic", "linear"])


def largest_deviation_rad(trajectory, reduced, samples=2000):
    """Return the largest deviation at random times and at all points."""
    time = np.random.default_rng(0).uniform(trajectory.time_s[0], trajectory.duration_s, samples)
    time = np.concatenate([time, trajectory.time_s[:-1], (trajectory.time_s[1:] + trajectory.time_s[:-1]) / 2])
    return np.abs(Interpolation(trajectory)(time).q_rad - Interpolation(reduced)(time).q_rad).max()


@st.composite
def random_paths(draw):
    """Paths of one arm or both, with or without speeds and accelerations, some of them wild."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count, arms = draw(st.integers(2, 40)), draw(st.sampled_from([("left",), ("right",), ("left", "right")]))
    time = draw(st.sampled_from([0.0, 0.7])) + np.append(0.0, np.cumsum(rng.uniform(0.01, 0.5, count - 1)))
    shape, order = (count, len(arms), 6), draw(st.integers(0, 2))
    size = draw(st.sampled_from([1e-4, 0.1, 3.0]))
    if draw(st.booleans()):
        values = [size * rng.uniform(-1, 1, shape) for _ in range(1 + order)]
    else:
        phase, pulse = rng.uniform(0, 6, (2, *shape[1:]))
        angle = time[:, None, None] * pulse + phase
        values = [size * np.sin(angle), size * pulse * np.cos(angle), -size * pulse**2 * np.sin(angle)][: 1 + order]
    return JointTrajectory(arms, time, *values)


@given(random_paths(), st.sampled_from(["cubic", "linear"]), st.integers(2, 12))
@settings(deadline=None, max_examples=scaled(10_000, 100))
def test_the_bound_holds_at_all_times(trajectory, kind, points):
    reduced, deviation_rad = reduce_points(trajectory, points, None, kind)
    assert len(reduced) <= points
    found = largest_deviation_rad(trajectory, reduced, 200)
    assert found <= deviation_rad
    assert (reduced.qd_rad_s is None) == (kind == "linear")
    assert np.isin(reduced.time_s, trajectory.time_s).all()
    for at in (0, -1):
        assert reduced.time_s[at] == trajectory.time_s[at]
        np.testing.assert_array_equal(reduced.q_rad[at], trajectory.q_rad[at])


@given(random_paths(), st.sampled_from(["cubic", "linear"]), st.floats(1e-5, 1.0))
@settings(deadline=None, max_examples=scaled(2000, 40))
def test_a_given_bound_is_kept_or_the_reachable_one_named(trajectory, kind, bound_rad):
    try:
        reduced, deviation_rad = reduce_points(trajectory, 5, bound_rad, kind)
    except TrajectoryError as error:
        reachable = float(re.search(r"deviate by up to (\S+) mrad", str(error))[1]) * 1.001e-3
        assert reachable > bound_rad
        assert len(reduce_points(trajectory, 5, reachable, kind).trajectory) <= 5
    else:
        assert largest_deviation_rad(trajectory, reduced, 100) <= deviation_rad <= bound_rad


def circle(duration_s=10.0, amplitude_m=0.1, rate_hz=0.5, tick_s=0.008):
    """Return a sine of both flanges along y, from rest to rest."""
    time = np.arange(0.0, duration_s + tick_s / 2, tick_s)
    ramp = np.clip(np.minimum(time, duration_s - time), 0.0, 1.0)
    ramp = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    q = []
    for arm in range(2):
        position, rotation = flange_pose(HOME_Q_RAD[arm], NOMINAL_DH)
        here, rows = HOME_Q_RAD[arm], []
        for wanted in amplitude_m * ramp * np.sin(2 * np.pi * rate_hz * time):
            here = nearest(position + wanted * np.eye(3)[1], rotation, here, NOMINAL_DH)
            rows.append(here)
        q.append(rows)
    q = np.stack(q, axis=1)
    speeds = np.gradient(q, time, axis=0)
    speeds[[0, -1]] = 0.0
    return JointTrajectory(("left", "right"), time, q, speeds)


def test_a_sine_of_ten_seconds_needs_fewer_points_than_a_buffer_of_36_holds():
    trajectory = circle()
    reduced, deviation_rad = reduce_points(trajectory, 36, 1e-3)
    assert len(reduced) <= 36
    assert largest_deviation_rad(trajectory, reduced) <= deviation_rad <= 1e-3
    best, least_rad = reduce_points(trajectory, 36, None)
    assert largest_deviation_rad(trajectory, best) <= least_rad < deviation_rad
    with pytest.raises(TrajectoryError, match=r"36 points joined by linear polynomials deviate by up to \d"):
        reduce_points(trajectory, 36, 1e-3, "linear")


def test_the_bound_is_hardly_above_the_deviation():
    trajectory = wave(points=100)
    reduced, deviation_rad = reduce_points(trajectory, 6, None)
    assert deviation_rad < 1.01 * largest_deviation_rad(trajectory, reduced)


@KINDS
def test_points_on_a_line_are_left_out(kind):
    time = np.linspace(0.0, 1.0, 50)
    q = np.tile(time[:, None, None], (1, 2, 6))
    trajectory = JointTrajectory(("left", "right"), time, q, np.ones_like(q))
    if kind == "linear":
        trajectory = JointTrajectory(("left", "right"), time, q)
    reduced, deviation_rad = reduce_points(trajectory, 2, 1e-9, kind)
    assert len(reduced) == 2
    assert deviation_rad < 1e-10


@KINDS
def test_one_point_stays_one(kind):
    trajectory = JointTrajectory(("left",), [1.0], np.ones((1, 1, 6)))
    assert len(reduce_points(trajectory, 2, kind=kind).trajectory) == 1


def test_what_cannot_be_reduced_is_refused():
    trajectory = wave()
    with pytest.raises(TrajectoryError, match="to 1 points: it needs 2 or more"):
        reduce_points(trajectory, 1)
    for bound_rad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(TrajectoryError, match=f"bound_rad is {bound_rad}: it must be above 0 and finite"):
            reduce_points(trajectory, 5, bound_rad)
    with pytest.raises(UnknownNameError, match="unknown interpolation 'spline': use one of 'cubic', 'linear'"):
        reduce_points(trajectory, 5, kind="spline")
