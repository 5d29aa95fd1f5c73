"""Inverse kinematics: every branch, the nearest solution, and refusals."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.kinematics.reference_arm import assert_reaches, calibration, independent_pose, random_q
from ur_core import kinematics
from ur_core.errors import SettingsError, UnreachableError
from ur_core.kinematics.ur10 import DH_A_M, DH_D_M, JOINT_RANGE_RAD, NOMINAL_DH

TWO_PI = 2 * np.pi


@pytest.mark.parametrize("limit", [JOINT_RANGE_RAD, np.full(6, np.pi)], ids=["two turns", "one turn"])
def test_every_random_pose_is_solved_within_the_range(limit: np.ndarray) -> None:
    q = random_q(1000, 6, limit)
    position, rotation = independent_pose(q)
    found, ok = kinematics.try_nearest(position, rotation, np.zeros((1000, 6)), NOMINAL_DH)
    assert ok.all()
    assert (np.abs(found) <= JOINT_RANGE_RAD).all()
    assert_reaches(found, position, rotation)


def test_all_branches_are_right_and_different() -> None:
    q = random_q(1000, 7, np.full(6, np.pi))
    position, rotation = independent_pose(q)
    solutions, valid = kinematics.inverse(position, rotation, NOMINAL_DH)
    assert valid.any(-1).all()
    assert set(valid.sum(-1)) <= {2, 4, 6, 8}
    assert (valid.sum(-1) == 8).mean() > 0.5
    row, branch = valid.nonzero()
    assert_reaches(solutions[row, branch], position[row], rotation[row])
    assert (solutions[valid] > -np.pi).all()
    assert (solutions[valid] <= np.pi).all()
    assert np.isnan(solutions[~valid]).all()
    # The configuration the pose came from is among them, and no two are the same.
    apart = np.abs(np.angle(np.exp(1j * (solutions - q[:, None])))).max(-1)
    assert np.nanmin(apart, axis=-1).max() < 1e-8
    full = solutions[valid.all(-1)]
    gaps = np.abs(np.angle(np.exp(1j * (full[:, :, None] - full[:, None])))).max(-1) + 10 * np.eye(8)
    assert gaps.min() > 1e-6


def test_branches_keep_their_order() -> None:
    solutions, valid = kinematics.inverse(*independent_pose(random_q(200, 8)), dh=NOMINAL_DH)
    index = np.broadcast_to(np.arange(8), valid.shape)[valid]
    assert ((solutions[valid][:, 2] >= 0) == (index < 4)).all()
    assert ((solutions[valid][:, 4] >= 0) == (index % 4 < 2)).all()


def test_nearest_is_the_nearest_of_all_branches_and_turns() -> None:
    rng = np.random.default_rng(9)
    q, reference = random_q(40, 9), rng.uniform(-JOINT_RANGE_RAD, JOINT_RANGE_RAD, (40, 6))
    position, rotation = independent_pose(q)
    found = kinematics.nearest(position, rotation, reference, NOMINAL_DH)
    solutions, valid = kinematics.inverse(position, rotation, NOMINAL_DH)
    turns = np.stack(np.meshgrid(*[(-1, 0, 1)] * 6, indexing="ij"), -1).reshape(-1, 6) * TWO_PI
    for row in range(40):
        every = (solutions[row, valid[row]][:, None] + turns).reshape(-1, 6)
        every = every[(np.abs(every) <= JOINT_RANGE_RAD).all(-1)]
        best = np.linalg.norm(every - reference[row], axis=-1).min()
        assert np.linalg.norm(found[row] - reference[row]) == pytest.approx(best, abs=1e-9)


joint_angles = st.tuples(*(st.floats(-limit, limit) for limit in JOINT_RANGE_RAD.tolist()))


@settings(max_examples=300)
@given(joint_angles)
# Rounding puts theta6 or theta5 past the end of its range.
@example((0.0, 0.0, 0.0, 0.0, -5.960464477539063e-08, -6.283185307179585))
@example((-1.40087339, 1.2, -2.03411733, 0.0, 6.283185299, 1.57079633))
def test_nearest_stays_on_the_reference(angles: tuple[float, ...]) -> None:
    q = np.array(angles)
    # Where the elbow is straight, theta2 to theta4 move by the root of rounding: more than is allowed past their ends.
    assume(abs(np.sin(q[2])) > 1e-3 or (JOINT_RANGE_RAD - np.abs(q))[1:4].min() > 1e-3)
    position, rotation = independent_pose(q)
    found = kinematics.nearest(position, rotation, q, NOMINAL_DH)
    assert (np.abs(found) <= JOINT_RANGE_RAD).all()
    assert_reaches(found, position, rotation, tolerance=1e-7)
    # Rounding of the pose by e moves theta6 by e over the sine of theta5; where the elbow is stretched or the wrist
    # over the axis, what it has then moved by e moves the other joints by its root.
    sine = abs(np.sin(q[4]))
    assert np.abs(found - q).max() < 30 * np.sqrt(1e-15 / max(sine, 1e-8))


def test_a_path_through_the_wrist_singularity_is_followed() -> None:
    q = np.tile([0.3, -1.2, 1.4, 0.5, 0.0, 0.7], (201, 1))
    q[:, 4] = np.linspace(-0.1, 0.1, 201)  # through zero
    position, rotation = independent_pose(q)
    now = q[0]
    for row in range(201):
        now = kinematics.nearest(position[row], rotation[row], now, NOMINAL_DH)
        assert np.abs(now - q[row]).max() < 1e-6


@pytest.mark.parametrize("end", [TWO_PI, -TWO_PI])
def test_the_ends_of_the_joint_range_are_kept(end: float) -> None:
    q = np.array([end, -1.2, 1.4, end, 0.9, end])
    found = kinematics.nearest(*independent_pose(q), q, dh=NOMINAL_DH)
    np.testing.assert_allclose(found, q, atol=1e-8)
    assert (np.abs(found) <= JOINT_RANGE_RAD).all()


def test_turns_follow_the_reference_but_not_past_the_range() -> None:
    q = np.array([0.5, -1.2, 1.4, 0.5, 0.9, -3.0])
    position, rotation = independent_pose(q)
    turned = q + TWO_PI * np.array([-1, 1, 0, -1, -1, 1])
    np.testing.assert_allclose(kinematics.nearest(position, rotation, turned, NOMINAL_DH), turned, atol=1e-9)
    # The solution one rotation on is nearest to these references, but past the range.
    for joint, at in ((0, 0.5), (2, 3.0), (5, 0.5)):
        q[joint] = at
        position, rotation = independent_pose(q)
        beyond = q - TWO_PI * np.eye(6)[joint] * (1 if joint == 2 else -1)
        found = kinematics.nearest(position, rotation, beyond, NOMINAL_DH)
        assert (np.abs(found) <= JOINT_RANGE_RAD).all()
        assert_reaches(found, position, rotation)


SINGULAR = {
    "wrist at 0": [0.3, -1.2, 1.4, 0.5, 0.0, 0.7],
    "wrist at pi": [0.3, -1.2, 1.4, 0.5, np.pi, 0.7],
    "elbow stretched": [0.3, -1.2, 0.0, 0.5, 0.9, 0.7],
    "elbow folded": [0.3, -1.2, np.pi, 0.5, 0.9, 0.7],
    "all zero": [0.0] * 6,
    "upright": [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0],
}


@pytest.mark.parametrize("name", SINGULAR)
def test_singular_poses_are_solved(name: str) -> None:
    q = np.array(SINGULAR[name])
    position, rotation = independent_pose(q)
    solutions, valid = kinematics.inverse(position, rotation, reference_q_rad=q, dh=NOMINAL_DH)
    assert valid.any()
    for solution in solutions[valid]:
        assert_reaches(solution, position, rotation, tolerance=1e-7)
    found = kinematics.nearest(position, rotation, q, NOMINAL_DH)
    assert_reaches(found, position, rotation, tolerance=1e-7)
    assert np.abs(found - q).max() < 1e-6


def test_poses_beside_two_singularities_are_solved() -> None:
    # A stretched arm with a straight wrist is the upright home configuration of many cells, and paths start from there.
    rng = np.random.default_rng(10)
    q = random_q(2000, 10, np.full(6, 3.0))
    q[:, 4] = 10.0 ** rng.uniform(-16, -2, 2000)
    q[:, 2] = 10.0 ** rng.uniform(-16, -2, 2000)
    position, rotation = independent_pose(q)
    assert_reaches(
        kinematics.nearest(position, rotation, random_q(2000, 11), NOMINAL_DH), position, rotation, tolerance=1e-7
    )
    found = kinematics.nearest(position, rotation, q, NOMINAL_DH)
    assert_reaches(found, position, rotation, tolerance=1e-7)
    assert np.abs(found - q).max() < 1e-5


def test_wrist_over_the_base_axis_is_solved() -> None:
    # Choose theta2 so that the arm's plane holds the wrist centre right over the shoulder: both shoulder branches meet.
    q = np.array([0.4, 0.0, 1.9, -0.8, 1.1, 0.2])
    reach = DH_A_M[1] + DH_A_M[2] * np.exp(1j * q[2]) + DH_D_M[4] * np.exp(1j * (q[2] + q[3] - np.pi / 2))
    q[1] = np.pi / 2 - np.angle(reach)
    position, rotation = independent_pose(q)
    solutions, valid = kinematics.inverse(position, rotation, NOMINAL_DH)
    assert valid.any()
    for solution in solutions[valid]:
        assert_reaches(solution, position, rotation, tolerance=1e-7)
    assert np.abs(kinematics.nearest(position, rotation, q, NOMINAL_DH) - q).max() < 1e-6


def test_a_free_theta6_is_the_references() -> None:
    q = np.array(SINGULAR["wrist at 0"])
    position, rotation = independent_pose(q)
    for theta6 in (-2.0, 0.0, 1.0):
        reference = np.array([*q[:5], theta6])
        solutions, valid = kinematics.inverse(position, rotation, reference_q_rad=reference, dh=NOMINAL_DH)
        free = solutions[valid & (np.abs(solutions[:, 4]) < 1e-9)]
        assert np.abs(free[:, 5] - theta6).min() < 1e-12
        assert_reaches(kinematics.nearest(position, rotation, reference, NOMINAL_DH), position, rotation)
    alone, valid = kinematics.inverse(position, rotation, NOMINAL_DH)
    assert np.abs(alone[valid][:, 5]).min() == 0.0


@pytest.mark.parametrize("exchange_m", [0.0, 0.5, 5.0])
def test_calibrated_arms_are_solved(exchange_m: float) -> None:
    dh = calibration(11, exchange_m)
    q = random_q(300, 11)
    position, rotation = independent_pose(q, dh)
    noise = np.random.default_rng(12).normal(0, 0.02, q.shape)
    found = kinematics.nearest(position, rotation, np.clip(q + noise, -JOINT_RANGE_RAD, JOINT_RANGE_RAD), dh)
    assert_reaches(found, position, rotation, dh)
    assert np.median(np.abs(found - q).max(-1)) < 1e-10
    # And it matters: the nominal solution misses by mm.
    nominal, ok = kinematics.try_nearest(position, rotation, q, NOMINAL_DH)
    assert np.linalg.norm(independent_pose(nominal[ok], dh)[0] - position[ok], axis=-1).max() > 1e-3


def test_branches_of_a_calibrated_arm() -> None:
    dh = calibration(13)
    position, rotation = independent_pose(random_q(200, 13), dh)
    solutions, valid = kinematics.inverse(position, rotation, dh)
    row, branch = valid.nonzero()
    assert len(row) > 1200
    assert_reaches(solutions[row, branch], position[row], rotation[row], dh)


def test_nearest_on_a_calibrated_arm_stays_on_the_reference() -> None:
    dh = calibration(14)
    q = np.concatenate([random_q(100, 14), list(SINGULAR.values())])
    found = kinematics.nearest(*independent_pose(q, dh), q, dh)
    assert np.abs(found - q).max() < 1e-5


def test_too_far_is_named() -> None:
    q = random_q(5, 15)
    position, rotation = independent_pose(q)
    position[3] = [2.0, 0.0, 0.5]
    with pytest.raises(UnreachableError, match=r"1 of 5 .*row 3.*2\.0000, 0\.0000, 0\.5000") as caught:
        kinematics.nearest(position, rotation, q, NOMINAL_DH)
    message = str(caught.value)
    assert "0.0397 to 1.1843 m" in message
    needed = re.search(r"have to be (\d\.\d+) m", message)
    assert needed is not None
    assert 1.184 < float(needed[1]) < 2.5
    assert "towards" in message


def test_too_close_to_the_axis_is_named() -> None:
    down = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(UnreachableError, match=r"is 0\.1000 m from the base's vertical axis.*least 0\.1639 m"):
        kinematics.nearest([0.1, 0.0, 0.6], down, np.zeros(6), NOMINAL_DH)
    with pytest.raises(UnreachableError, match="out of reach"):
        kinematics.nearest([2.0, 0.0, 0.6], down, np.zeros(6), calibration(1))


def test_try_nearest_holds_the_reference() -> None:
    q = random_q(3, 16)
    position, rotation = independent_pose(q)
    position[1, 0] = 5.0
    for dh in (NOMINAL_DH, calibration(1)):
        found, ok = kinematics.try_nearest(position, rotation, q, dh)
        assert not ok[1]
        np.testing.assert_array_equal(found[1], q[1])
    assert kinematics.try_nearest(position, rotation, q, NOMINAL_DH)[1].tolist() == [True, False, True]


@pytest.mark.parametrize("solve", [kinematics.nearest, kinematics.try_nearest])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_is_refused(solve: object, bad: float) -> None:
    q = random_q(2, 17)
    position, rotation = independent_pose(q)
    broken = position.copy()
    broken[1, 2] = bad
    with pytest.raises(SettingsError, match="position of pose 1"):
        solve(broken, rotation, q, NOMINAL_DH)
    broken = rotation.copy()
    broken[1, 2, 0] = bad
    with pytest.raises(SettingsError, match="rotation of pose 1"), np.errstate(invalid="ignore"):
        solve(position, broken, q, NOMINAL_DH)
    broken = q.copy()
    broken[0, 0] = bad
    with pytest.raises(SettingsError, match="reference"):
        solve(position, rotation, broken, NOMINAL_DH)


def test_wrong_shapes_and_no_rotation_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"\(\.\.\., 3\)"):
        kinematics.inverse(np.zeros(4), np.eye(3), NOMINAL_DH)
    with pytest.raises(SettingsError, match="no rotation matrix"):
        kinematics.inverse(np.zeros(3), 1.1 * np.eye(3), NOMINAL_DH)
