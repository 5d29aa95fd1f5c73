"""Forward kinematics of one arm: flange pose, Jacobian, and positions of elbow, flange and TCP.

Joint angles have shape (..., 6) and results keep the leading axes. Poses are those of the flange in UR's own ``base``
frame; see [kinematics][ur_core.kinematics].
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from ur_core.errors import SettingsError
from ur_core.kernel import Constants, call
from ur_core.kinematics.rotations import quat_from_matrix
from ur_core.kinematics.ur10 import DHParameters, nominal_dh
from ur_core.types import Array


def fixed_transforms(dh: DHParameters) -> Array:
    """Return the transforms (6, 4, 4) after each joint's rotation, ``Tz(d) Tx(a) Rx(alpha)``."""
    cos, sin = np.cos(dh.alpha_rad), np.sin(dh.alpha_rad)
    fixed = np.tile(np.eye(4), (6, 1, 1))
    fixed[:, 0, 3], fixed[:, 2, 3] = dh.a_m, dh.d_m
    fixed[:, 1, 1], fixed[:, 1, 2], fixed[:, 2, 1], fixed[:, 2, 2] = cos, -sin, sin, cos
    return fixed


def links(dh: DHParameters) -> Array:
    """Return the chain as the kernel takes it, (6, 13): theta offset, and rotation and offset behind each joint."""
    fixed = fixed_transforms(dh)
    result = np.empty((6, 13))
    result[:, 0] = dh.theta_rad
    result[:, 1:10], result[:, 10:] = fixed[:, :3, :3].reshape(6, 9), fixed[:, :3, 3]
    return result


@lru_cache(maxsize=32)
def _links(dh: DHParameters) -> Constants:
    return Constants(links(dh))


def lengths_m(dh: DHParameters) -> Array:
    """Return d1, a2, a3, d4, d5 and d6, (6,), which place an arm with exactly parallel and perpendicular axes."""
    a, d = dh.a_m, dh.d_m
    return np.array([d[0], a[1], a[2], d[1] + d[2] + d[3], d[4], d[5]])


def checked_joints(q_rad: ArrayLike) -> Array:
    """Return joint angles as an array.

    Raises:
        SettingsError: Not six joints.
    """
    q = np.asarray(q_rad, dtype=np.float64)
    if q.shape[-1:] != (6,):
        raise SettingsError(f"joint angles need the shape (..., 6), found {q.shape}")
    return q


def flange_pose(q_rad: ArrayLike, dh: DHParameters) -> tuple[Array, Array]:
    """Return the flange pose in ``base``.

    Args:
        q_rad: (..., 6) joint angles.
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        Position (..., 3) in m and rotation matrix (..., 3, 3).

    Raises:
        SettingsError: Not six joints.
    """
    block = _block(checked_joints(q_rad), 18)
    call("forward_pose", _links(dh), block, block.size // 18)
    return block[..., 6:9], _matrices(block[..., 9:18])


def _block(q: Array, size: int) -> Array:
    """Return a row of the kernel's input and output, (..., size), for each configuration, (..., 6)."""
    block: Array = np.empty((*q.shape[:-1], size))
    block[..., :6] = q
    return block


def _matrices(values: Array) -> Array:
    matrices: Array = values.reshape(*values.shape[:-1], 3, 3)
    return matrices


def flange_pose_quat(q_rad: ArrayLike, dh: DHParameters) -> tuple[Array, Array]:
    """Return the flange pose in ``base`` as position (..., 3) and quaternion (..., 4), w >= 0; see ``flange_pose``."""
    position, rotation = flange_pose(q_rad, dh)
    return position, quat_from_matrix(rotation)


def jacobian(q_rad: ArrayLike, dh: DHParameters) -> Array:
    """Return the geometric Jacobian of the flange in ``base``.

    Args:
        q_rad: (..., 6) joint angles.
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        (..., 6, 6): three rows of m/s, then three rows of rad/s, per rad/s of each joint.

    Raises:
        SettingsError: Not six joints.
    """
    return pose_and_jacobian(checked_joints(q_rad), dh)[2]


def pose_and_jacobian(q: Array, dh: DHParameters) -> tuple[Array, Array, Array]:
    """Return flange position, rotation and Jacobian, which share most of their work; unchecked."""
    block = _block(q, 54)
    call("forward_jacobian", _links(dh), block, block.size // 54)
    return block[..., 6:9], _matrices(block[..., 9:18]), block[..., 18:].reshape(*q.shape[:-1], 6, 6)


def elbow_and_flange_position(q_rad: ArrayLike, robot: str) -> tuple[Array, Array]:
    """Return the positions of elbow and flange of a nominal arm, in ``base``.

    Args:
        q_rad: (..., 6) joint angles.
        robot: Model of the arm.

    Returns:
        Elbow position (..., 3), the origin of DH frame 2, and flange position (..., 3), in m.

    Raises:
        SettingsError: Not six joints.
    """
    points = _points(checked_joints(q_rad), robot, (0.0, 0.0, 0.0))
    return points[..., 0, :], points[..., 1, :]


def elbow_flange_and_tcp(q_rad: Array, tcp_m: Sequence[Sequence[float]], robots: tuple[str, str]) -> Array:
    """Return the positions of elbow, flange and tool centre point of both nominal arms.

    Args:
        q_rad: (..., 2, 6) joint angles of both arms.
        tcp_m: (2, 3) tool centre points in the flange frames; zeros: at the flange.
        robots: Models of both arms.

    Returns:
        (..., 2, 3, 3) positions in each arm's `base`, in m.

    Raises:
        SettingsError: Not six joints.
    """
    q = checked_joints(q_rad)
    return np.stack([_points(q[..., arm, :], robots[arm], tuple(tcp_m[arm])) for arm in range(2)], axis=-3)


def _points(q: Array, robot: str, tcp_m: Sequence[float]) -> Array:
    """Return elbow, flange and tool centre point, (..., 3, 3)."""
    block = _block(q, 15)
    call("forward_points", _arm_with_tool(robot, tuple(tcp_m)), block, block.size // 15)
    return _matrices(block[..., 6:])


@lru_cache(maxsize=32)
def _arm_with_tool(robot: str, tcp_m: tuple[float, ...]) -> Constants:
    return Constants(np.concatenate([lengths_m(nominal_dh(robot)), tcp_m]))
