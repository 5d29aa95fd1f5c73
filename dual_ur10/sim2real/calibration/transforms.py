"""Homogeneous transforms of calibration: batches of (4, 4) matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.frames import ArmMount, to_base
from ur_core.kinematics.rotations import quat_from_matrix, quat_from_rotvec, quat_to_matrix, quat_to_rotvec
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array


def transform(position_m: ArrayLike, rotation: ArrayLike) -> Array:
    """Return transforms (..., 4, 4) of positions (..., 3) and rotation matrices (..., 3, 3)."""
    position, matrix = np.asarray(position_m, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*np.broadcast_shapes(position.shape[:-1], matrix.shape[:-2]), 4, 4))
    result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = matrix, position, 1.0
    return result


def rotation_of(rotvec: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return quat_to_matrix(quat_from_rotvec(rotvec))


def rotvec_of(rotation: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3) of rotation matrices (..., 3, 3)."""
    return quat_to_rotvec(quat_from_matrix(rotation))


def inverse_of(pose: Array) -> Array:
    """Return the inverse transforms (..., 4, 4)."""
    back = pose[..., :3, :3].swapaxes(-1, -2)
    return transform(-(back @ pose[..., :3, 3:])[..., 0], back)


def skew(vector: Array) -> Array:
    """Return the matrices (..., 3, 3) whose product with a vector is the cross product with it."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def flange(q_rad: ArrayLike, dh: DHParameters) -> Array:
    """Return the flange poses (..., 4, 4) in the arm's own `base` frame at joint angles (..., 6)."""
    return transform(*flange_pose(q_rad, dh))


def base_in_cell(mount: ArmMount) -> Array:
    """Return the pose (4, 4) of an arm's `base` frame in the cell frame."""
    position, rotation = to_base((mount, mount))
    return transform(position[0], rotation[0].T)


def right_in_left(left: ArmMount, right: ArmMount) -> Array:
    """Return the pose (4, 4) of the right `base` frame in the left one, as the mounts have it."""
    return inverse_of(base_in_cell(left)) @ base_in_cell(right)
