"""Batches of poses: composition, relative poses and angles.

A row's result does not depend on the other rows, in any bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ur_core.kinematics.rotations import quat_between, quat_conjugate, quat_multiply, rotate
from ur_core.types import Array, Vector3


class Poses(NamedTuple):
    """Positions (..., 3) in m and orientations (w, x, y, z), (..., 4), in one frame; mostly the cell frame."""

    position_m: Array
    quat: Array


def pose(position_m: Vector3, quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)) -> Poses:
    """Return one pose from plain numbers; the quaternion (w, x, y, z) may have any length."""
    orientation = np.array(quat, dtype=np.float64)
    return Poses(np.array(position_m, dtype=np.float64), orientation / np.linalg.norm(orientation))


def compose(frame: Poses, pose: Poses) -> Poses:
    """Return `pose`, given in the frame `frame`, in the frame in which `frame` is given."""
    return Poses(frame.position_m + rotate(frame.quat, pose.position_m), quat_multiply(frame.quat, pose.quat))


def relative_to(frame: Poses, pose: Poses) -> Poses:
    """Return `pose` in the frame `frame`; both are given in the same frame."""
    away = rotate(quat_conjugate(frame.quat), pose.position_m - frame.position_m)
    return Poses(away, quat_between(frame.quat, pose.quat))


def rotation_angle(quat: Array) -> Array:
    """Return the angles (...) in rad of quaternions (..., 4), accurate near zero."""
    vector = quat[..., 1:]
    result: Array = 2 * np.arctan2(np.sqrt(np.add.reduce(vector * vector, axis=-1)), np.abs(quat[..., 0]))
    return result


def length(vector: Array) -> Array:
    """Return the lengths (...) of vectors (..., 3)."""
    result: Array = np.sqrt(np.add.reduce(vector * vector, axis=-1))
    return result


def yaw_quat(yaw_rad: Array) -> Array:
    """Return the quaternions (..., 4) of rotations about the vertical."""
    quat = np.zeros((*np.shape(yaw_rad), 4))
    quat[..., 0], quat[..., 3] = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    return quat


def yaw_of(quat: Array) -> Array:
    """Return orientations (..., 4) without their tilt: their rotations about the vertical."""
    level: Array = quat * [1.0, 0.0, 0.0, 1.0]
    return level / length(level)[..., None]
