"""Points of a path and the cubics between them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.trajectory.point_path import PointPath, check_targets

TICK_S = 0.008


def targets(seed=0, duration_s=3.0, tick_s=TICK_S):
    """Return smooth targets from rest to rest."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(duration_s / tick_s) + 1) * tick_s
    s = time_s / duration_s
    window = s**3 * (1 - s) ** 3 * 64
    waves = np.sin(2 * np.pi * rng.uniform(0.1, 0.5, 12) * time_s[:, None] + rng.uniform(0, 6, 12))
    return 0.2 * (window[:, None] * waves).reshape(-1, 2, 6) + HOME_Q_RAD


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.1, 0.2, 0.0832]))
def test_cubics_pass_the_points_and_stay_near_the_targets(seed, interval_s):
    given_rad = targets(seed)
    path = PointPath.of_targets(given_rad, TICK_S, interval_s)
    np.testing.assert_array_equal(path.q_rad[0], given_rad[0])
    np.testing.assert_array_equal(path.q_rad[-1], given_rad[-1])
    assert not path.qd_rad_s[[0, -1]].any()
    np.testing.assert_allclose(path.targets(interval_s)[: len(path.q_rad)], path.q_rad, atol=1e-12)
    assert path.deviation_rad(given_rad, TICK_S) < 0.5 * interval_s**3


@given(st.integers(0, 2**32 - 1))
def test_points_at_every_control_period_are_the_targets(seed):
    given_rad = targets(seed)
    path = PointPath.of_targets(given_rad, TICK_S, TICK_S)
    np.testing.assert_array_equal(path.targets(TICK_S), given_rad)


def test_stretched_targets_are_slower():
    fast, slow = (PointPath.of_targets(targets(), TICK_S / factor, 0.1) for factor in (1.0, 0.5))
    assert slow.duration_s == pytest.approx(2 * fast.duration_s, abs=0.1)
    assert np.abs(slow.qd_rad_s).max() == pytest.approx(0.5 * np.abs(fast.qd_rad_s).max(), rel=0.05)


def test_moves_rest_at_each_point():
    path = PointPath.of_targets(targets(), TICK_S, 0.496)
    stops = path.stops(TICK_S)
    speed = np.abs(np.diff(stops, axis=0)).max(axis=(1, 2)) / TICK_S
    at = np.arange(len(path.q_rad) - 1) * 62
    np.testing.assert_allclose(stops[at], path.q_rad[:-1], atol=1e-12)
    assert speed[at].max() < 0.01 * speed.max()


@pytest.mark.parametrize(
    ("given_rad", "words"),
    [
        (np.zeros((5, 6)), "shape"),
        (np.zeros((1, 2, 6)), "shape"),
        (np.full((5, 2, 6), np.nan), "finite"),
        (np.linspace(0.0, 1.0, 5)[:, None, None] * np.ones((1, 2, 6)), "first target"),
        (np.array([0.0, 0.0, 0.0, 0.1])[:, None, None] * np.ones((1, 2, 6)), "last target"),
    ],
)
def test_bad_targets_are_refused(given_rad, words):
    with pytest.raises(TrajectoryError, match=words):
        PointPath.of_targets(given_rad, TICK_S, 0.1)


@pytest.mark.parametrize("interval_s", [0.0, 0.007, -1.0, float("nan")])
def test_bad_intervals_are_refused(interval_s):
    with pytest.raises(TrajectoryError, match="interval_s"):
        PointPath.of_targets(targets(), TICK_S, interval_s)


def test_the_gate_sees_what_the_controller_will_interpolate():
    clearance, path = Clearance(SceneSettings()), PointPath.of_targets(targets(), TICK_S, 0.1)
    check_targets(path.targets(TICK_S), MotionLimits(), TICK_S, 12, clearance)
    bulging = PointPath(0.1, path.q_rad, path.qd_rad_s * 8.0)  # the same points, another way between them
    bulging.qd_rad_s[[0, -1]] = 0.0
    with pytest.raises(TrajectoryError, match=r"refused at \d\.\d\d s: left/|refused at \d\.\d\d s: right/"):
        check_targets(bulging.targets(TICK_S), MotionLimits(), TICK_S, 12, clearance)
