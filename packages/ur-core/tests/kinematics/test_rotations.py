"""Quaternion helpers against scipy and exact cases."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ur_core.kinematics import rotations

RANDOM = Rotation.random(1000, rng=np.random.default_rng(3))
OTHER = Rotation.random(1000, rng=np.random.default_rng(4))


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, -1)


def test_multiply_is_the_second_rotation_then_the_first() -> None:
    product = rotations.quat_multiply(wxyz(RANDOM), wxyz(OTHER))
    np.testing.assert_allclose(rotations.quat_to_matrix(product), (RANDOM * OTHER).as_matrix(), atol=1e-14)


def test_multiply_follows_hamilton() -> None:
    i, j, k = np.eye(4)[1:]
    np.testing.assert_array_equal(rotations.quat_multiply(i, j), k)
    np.testing.assert_array_equal(rotations.quat_multiply(j, i), -k)
    np.testing.assert_array_equal(rotations.quat_multiply(k, k), [-1, 0, 0, 0])


def test_conjugate_undoes() -> None:
    quat = wxyz(RANDOM)
    identity = rotations.quat_multiply(quat, rotations.quat_conjugate(quat))
    np.testing.assert_allclose(identity, np.tile([1.0, 0, 0, 0], (1000, 1)), atol=1e-15)


def test_between_leads_from_the_first_to_the_second() -> None:
    between = rotations.quat_between(wxyz(RANDOM), wxyz(OTHER))
    np.testing.assert_allclose(rotations.quat_multiply(wxyz(RANDOM), between), wxyz(OTHER), atol=1e-14)


def test_matrix_both_ways() -> None:
    quat = wxyz(RANDOM)
    quat *= np.copysign(1.0, quat[:, :1])
    np.testing.assert_allclose(rotations.quat_to_matrix(quat), RANDOM.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotations.quat_from_matrix(RANDOM.as_matrix()), quat, atol=1e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 3)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi / 2, np.pi - 1e-9, np.pi])
def test_from_matrix_is_accurate_at_every_angle(axis: tuple[float, ...], angle: float) -> None:
    rotation = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    quat = rotations.quat_from_matrix(rotation.as_matrix())
    assert quat[0] >= 0.0
    assert np.linalg.norm(quat) == pytest.approx(1.0, abs=1e-15)
    back = Rotation.from_quat(np.roll(quat, -1)) * rotation.inv()
    assert back.magnitude() < 1e-15


def test_rotvec_both_ways() -> None:
    rotvec = RANDOM.as_rotvec()
    quat = rotations.quat_from_rotvec(rotvec)
    np.testing.assert_allclose(rotations.quat_to_matrix(quat), RANDOM.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotations.quat_to_rotvec(quat), rotvec, atol=1e-14)
    np.testing.assert_allclose(rotations.quat_to_rotvec(-quat), rotvec, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-160, 1e-20, 1e-8])
def test_rotvec_is_exact_near_zero(size: float) -> None:
    rotvec = np.array([size, -size / 2, size / 4])
    quat = rotations.quat_from_rotvec(rotvec)
    np.testing.assert_allclose(quat[1:], rotvec / 2, rtol=1e-15)
    np.testing.assert_allclose(rotations.quat_to_rotvec(quat), rotvec, rtol=1e-15)


def test_rotvec_is_the_shorter_rotation() -> None:
    quat = rotations.quat_from_rotvec([0.0, 0.0, 1.5 * np.pi])
    np.testing.assert_allclose(rotations.quat_to_rotvec(quat), [0.0, 0.0, -0.5 * np.pi], atol=1e-15)
    half_rotation = rotations.quat_to_rotvec([0.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(half_rotation, [0.0, np.pi, 0.0], atol=1e-15)


def test_rotate_matches_scipy() -> None:
    vector = np.random.default_rng(5).normal(size=(1000, 3))
    np.testing.assert_allclose(rotations.rotate(wxyz(RANDOM), vector), RANDOM.apply(vector), atol=1e-14)


def test_batch_axes_broadcast() -> None:
    quat, one = wxyz(RANDOM)[:30].reshape(5, 6, 4), wxyz(OTHER)[0]
    assert rotations.quat_multiply(one, quat).shape == (5, 6, 4)
    np.testing.assert_allclose(
        rotations.quat_multiply(one, quat)[2, 3], rotations.quat_multiply(one, quat[2, 3]), atol=1e-15
    )
    np.testing.assert_allclose(
        rotations.rotate(quat, [1.0, 2.0, 3.0])[4, 5], RANDOM[29].apply([1.0, 2.0, 3.0]), atol=1e-14
    )
    matrices = rotations.quat_to_matrix(quat)
    assert matrices.shape == (5, 6, 3, 3)
    assert rotations.quat_from_matrix(matrices).shape == (5, 6, 4)
    assert rotations.quat_to_rotvec(quat).shape == (5, 6, 3)
    assert rotations.quat_from_rotvec(np.ones((5, 6, 3))).shape == (5, 6, 4)


def test_cross_is_numpys():
    first, second = np.random.default_rng(0).normal(size=(2, 4, 2, 3))
    np.testing.assert_array_equal(rotations.cross(first, second), np.cross(first, second))
