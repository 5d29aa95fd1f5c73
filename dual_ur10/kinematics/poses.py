"""Poses of a batch, and how they follow each other. Every product is one small one per pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dual_ur10.kinematics.rotations import quat_conjugate, quat_multiply, rotate
from dual_ur10.types import Array


class Poses(NamedTuple):
    """Positions in the cell frame, (..., 3), and orientations (w, x, y, z), (..., 4)."""

    position_m: Array
    quat: Array


def after(first: Poses, second: Poses) -> Poses:
    """`second`, given in the frame of `first`, in the frame that `first` is given in."""
    return Poses(first.position_m + rotate(first.quat, second.position_m), quat_multiply(first.quat, second.quat))


def seen_from(frame: Poses, pose: Poses) -> Poses:
    """`pose` in the frame of `frame`, both given in one frame."""
    back = quat_conjugate(frame.quat)
    return Poses(rotate(back, pose.position_m - frame.position_m), quat_multiply(back, pose.quat))


def angle(quat: Array) -> Array:
    """Angle in rad, (...), of quaternions, (..., 4), accurate near zero."""
    vector = quat[..., 1:]
    result: Array = 2 * np.arctan2(np.sqrt(np.add.reduce(vector * vector, axis=-1)), np.abs(quat[..., 0]))
    return result


def length(vector: Array) -> Array:
    """Lengths, (...), of vectors, (..., 3)."""
    result: Array = np.sqrt(np.add.reduce(vector * vector, axis=-1))
    return result


def yawed(yaw_rad: Array) -> Array:
    """Quaternions, (..., 4), of turns about the vertical."""
    quat = np.zeros((*np.shape(yaw_rad), 4))
    quat[..., 0], quat[..., 3] = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    return quat
