"""Interpolation between the points of a trajectory: against SciPy, at the points, and outside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.trajectory.interpolation import Interpolation, JointMotion
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory

SEEDS = st.integers(0, 2**31 - 1)


def made(seed, order, arms=("left", "right"), first_s=0.0, count=6):
    rng = np.random.default_rng(seed)
    time = first_s + np.append(0.0, np.cumsum(rng.uniform(0.01, 2.0, count - 1)))
    values = rng.normal(size=(3, count, len(arms), 6))
    return JointTrajectory(arms, time, *values[: 1 + order])


@given(SEEDS, st.integers(0, 2))
def test_segments_are_those_of_scipy(seed, order):
    trajectory = made(seed, order)
    time = np.random.default_rng(seed).uniform(0.0, trajectory.duration_s, 50)
    found = Interpolation(trajectory)(time)
    points = [trajectory.q_rad, trajectory.qd_rad_s, trajectory.qdd_rad_s2][: 1 + order]
    if order == 1:
        expected = CubicHermiteSpline(trajectory.time_s, *points)
    else:
        expected = BPoly.from_derivatives(trajectory.time_s, np.stack(points, axis=1))
    for k, each in enumerate(found):
        np.testing.assert_allclose(each, expected(time, nu=k), atol=1e-6 * np.abs(each).max() + 1e-9)


@given(SEEDS)
def test_points_are_met_with_speed_and_acceleration(seed):
    trajectory = made(seed, 2)
    found = Interpolation(trajectory)(trajectory.time_s)
    np.testing.assert_allclose(found.q_rad, trajectory.q_rad, atol=1e-9)
    np.testing.assert_allclose(found.qd_rad_s[:-1], trajectory.qd_rad_s[:-1], atol=1e-7)
    np.testing.assert_allclose(found.qdd_rad_s2[:-1], trajectory.qdd_rad_s2[:-1], atol=1e-5)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_outside_it_rests_at_its_ends(order):
    trajectory = made(3, order, first_s=0.5)
    found = Interpolation(trajectory)(np.array([0.0, 0.4, trajectory.duration_s, 99.0]))
    np.testing.assert_array_equal(found.q_rad[:2], np.repeat(trajectory.q_rad[:1], 2, axis=0))
    np.testing.assert_allclose(found.q_rad[2:], np.repeat(trajectory.q_rad[-1:], 2, axis=0), atol=1e-12)
    assert not found.qd_rad_s.any()
    assert not found.qdd_rad_s2.any()


@pytest.mark.parametrize("order", [1, 2])
def test_a_later_first_point_is_reached_from_the_start(order):
    trajectory = made(4, order, arms=("right",), first_s=0.5)
    start = JointMotion(*np.random.default_rng(0).normal(size=(3, 1, 6)))
    found = Interpolation(trajectory, start)(np.array([0.0, 0.5]))
    np.testing.assert_allclose(found.q_rad, [start.q_rad, trajectory.q_rad[0]], atol=1e-12)
    np.testing.assert_allclose(found.qd_rad_s, [start.qd_rad_s, trajectory.qd_rad_s[0]], atol=1e-9)
    if order == 2:
        np.testing.assert_allclose(found.qdd_rad_s2[0], start.qdd_rad_s2, atol=1e-9)


def test_a_single_point_holds():
    trajectory = JointTrajectory(("left",), [0.0], np.ones((1, 1, 6)))
    found = Interpolation(trajectory)(np.array([-1.0, 0.0, 1.0]))
    assert (found.q_rad == 1.0).all()
    assert not found.qd_rad_s.any()


def test_one_instant_has_no_axis_of_instants():
    assert Interpolation(made(0, 1))(0.1).qd_rad_s.shape == (2, 6)


def test_a_start_of_other_arms_is_refused():
    with pytest.raises(TrajectoryError, match="shape"):
        Interpolation(made(0, 1, first_s=1.0), JointMotion.at_rest(np.zeros((1, 6))))
