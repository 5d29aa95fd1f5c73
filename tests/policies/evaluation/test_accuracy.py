"""Accuracy of records with known errors."""

from __future__ import annotations

from dataclasses import asdict, replace

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.envs.tasks.sine_tracking.settings import TOOL_DOWN_QUAT
from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.accuracy import (
    accuracy,
    along_axis,
    delay_s,
    errors,
    flange_positions,
    lag_s,
    skew_s,
)
from dual_ur10.policies.evaluation.rollout import Record, rollout
from dual_ur10.policies.scripted.sine_tracking import SineTrackingPolicy
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import ArmMount, to_base
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix
from ur_core.kinematics.ur10 import NOMINAL_DH

Array = NDArray[np.float64]

PERIOD_S = 0.04
MOUNTS = (ArmMount((-0.75, 0.6, 0.0)), ArmMount((-0.92, -0.45, 0.08), yaw_rad=0.3))
CENTER = np.array([[0.0, 0.6, 0.4], [0.0, -0.6, 0.4]])


def made(position: Array, reference: Array, rotvec_rad: Array | None = None) -> Record:
    """Return a record of flanges at `position`, (k, 2, 3), rotated by (2, 3) rotation vectors from tool down."""
    base_m, from_cell = to_base(MOUNTS)
    q = np.empty((len(position), 2, 6))
    for arm in range(2):
        rotvec = np.zeros(3) if rotvec_rad is None else rotvec_rad[arm]
        rotation = quat_to_matrix(quat_multiply(quat_from_rotvec(rotvec), TOOL_DOWN_QUAT))
        near = HOME_Q_RAD[arm]
        for k, point in enumerate((position[:, arm] - base_m[arm]) @ from_cell[arm].T):
            near = q[k, arm] = nearest(point, rotation, near, NOMINAL_DH)
    nothing = np.full(position.shape, np.nan)  # the simulator's flange positions must have no effect
    return Record(PERIOD_S, MOUNTS, q, nothing, np.zeros(len(position)), True, reference_m=reference)


def sine(steps: int, delays_s: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Both flanges on a sine along y, each delayed."""
    time_s = PERIOD_S * np.arange(1, steps + 1)
    position = np.tile(CENTER, (steps, 1, 1))
    for arm, delay in enumerate(delays_s):
        position[:, arm, 1] += 0.1 * np.sin(np.pi * (time_s - delay))
    return position


def still(steps: int = 6) -> Array:
    return np.tile(CENTER, (steps, 1, 1))


def test_perfect_tracking_has_no_error() -> None:
    reference = sine(30)
    assert all(value < 1e-6 for value in asdict(accuracy(made(reference, reference))).values())


def test_an_error_along_the_connecting_line_counts_in_all_figures() -> None:
    position = still()
    position[:, 0, 1] += 1e-3
    figures = accuracy(made(position, still()))
    for value in (figures.flange_max_mm, figures.flange_rms_mm, figures.distance_max_mm, figures.vector_max_mm):
        assert value == pytest.approx(1.0, abs=1e-6)
    assert figures.orientation_max_deg < 1e-6


def test_the_vector_shows_an_error_that_the_distance_hides() -> None:
    position = still()
    position[:, 1, 0] -= 2e-3
    figures = accuracy(made(position, still()))
    assert figures.distance_max_mm < 0.002
    assert figures.vector_max_mm == pytest.approx(2.0, abs=1e-6)


def test_a_common_error_shows_in_the_flange_error_alone() -> None:
    figures = accuracy(made(still() + np.array([3e-3, 0.0, 4e-3]), still()))
    assert figures.flange_max_mm == pytest.approx(5.0, abs=1e-6)
    assert figures.distance_max_mm < 1e-6
    assert figures.vector_max_mm < 1e-6


def test_rms_is_that_of_the_worse_arm() -> None:
    position = still(4)
    position[0, 0, 2] += 4e-3  # sqrt(16 / 4) = 2
    position[:, 1, 2] += 1e-3
    figures = accuracy(made(position, still(4)))
    assert figures.flange_rms_mm == pytest.approx(2.0, abs=1e-6)
    assert figures.flange_max_mm == pytest.approx(4.0, abs=1e-6)


def test_orientation_is_the_angle_of_the_worse_arm() -> None:
    record = made(still(), still(), np.array([[0.0, 0.004, 0.0], [0.006, 0.0, 0.008]]))
    assert accuracy(record).orientation_max_deg == pytest.approx(np.degrees(0.01), rel=1e-6)
    assert errors(record).orientation_rad[0] == pytest.approx([0.004, 0.01], rel=1e-6)


def test_ripple_is_the_difference_of_the_speeds() -> None:
    steps = PERIOD_S * np.arange(8)[:, None]
    position, reference = still(8), still(8)
    position[:, :, 0] -= 0.10 * steps
    reference[:, :, 2] += 0.07 * steps  # the direction does not matter
    assert accuracy(made(position, reference)).ripple_max_m_s == pytest.approx(0.03, abs=1e-6)


def test_accuracy_can_leave_out_the_beginning() -> None:
    position = still(10)
    position[2, 0, 2] += 1e-3
    record = made(position, still(10))
    assert accuracy(record, after_s=3 * PERIOD_S).flange_max_mm == pytest.approx(1.0, abs=1e-6)
    assert accuracy(record, after_s=4 * PERIOD_S).flange_max_mm < 1e-6
    with pytest.raises(SettingsError, match="nothing after"):
        accuracy(record, after_s=1.0)


@pytest.mark.parametrize("delay", [0.0, 0.002, -0.013, 0.034])
def test_delay_between_samples_is_found(delay: float) -> None:
    time_s = PERIOD_S * np.arange(250)
    late, early = np.sin(np.pi * (time_s - delay)), np.sin(np.pi * time_s)
    assert delay_s(late, early, PERIOD_S) == pytest.approx(delay, abs=1e-4)


def test_equal_signals_have_exactly_no_delay() -> None:
    signal = np.cumsum(np.random.default_rng(3).normal(size=200))
    assert abs(delay_s(signal, signal, PERIOD_S)) < 1e-12


def test_delay_of_a_constant_or_a_short_signal_is_nan() -> None:
    assert np.isnan(delay_s(np.ones(100), np.arange(100.0), PERIOD_S))
    assert np.isnan(delay_s(np.arange(5.0), np.arange(5.0), PERIOD_S))


def test_lag_and_skew_of_two_arms() -> None:
    record = made(sine(150, (0.012, 0.004)), sine(150))
    assert lag_s(record) == pytest.approx([0.012, 0.004], abs=2e-4)
    assert skew_s(record) == pytest.approx(0.008, abs=2e-4)


def test_a_static_arm_has_neither_lag_nor_skew() -> None:
    path = sine(60)
    path[:, 1] = CENTER[1]
    record = made(path, path)
    assert np.isnan(lag_s(record)).tolist() == [False, True]
    assert np.isnan(skew_s(record))
    assert np.ptp(along_axis(record)[0], axis=0) == pytest.approx([0.2, 0.0], abs=1e-3)


def test_a_record_without_a_reference_is_refused() -> None:
    with pytest.raises(SettingsError, match="reference"):
        accuracy(replace(made(still(), still()), reference_m=None))


def test_kinematics_and_simulator_agree_on_an_episode() -> None:
    env = gym.make("DualUR10/SineTracking-v0", duration_s=2.0)
    record = rollout(env, SineTrackingPolicy(env.unwrapped.core.timing), seed=5)  # type: ignore[attr-defined]
    env.close()
    assert record.steps == 50
    assert np.abs(flange_positions(record) - record.flange_m).max() < 1e-9
    found = errors(record)
    assert record.flange_error_m is not None
    assert record.orientation_error_rad is not None
    assert np.abs(found.flange_m - record.flange_error_m).max() < 1e-9
    assert np.abs(found.orientation_rad - record.orientation_error_rad).max() < 1e-7
