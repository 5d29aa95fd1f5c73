"""What scripted policies that handle objects share: reading an arm's numbers, and acting on joint positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.kinematics import nearest
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import quat_to_matrix
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.types import Array

TAUGHT_HIGHER_M: Final = 0.013
"""How much higher than a task names it a teacher grips: fingers pass the table at 4 and 7 mm, less than pupils err."""


def lying(pose: Poses, mounts: Sequence[ArmMount], height_m: float) -> Poses:
    """Poses as measured, (..., 2, ...) in the arms' `base` frames, of things that are known to lie on the table.

    Args:
        pose: Measured, with errors.
        mounts: Where the arms stand, upright.
        height_m: Height of the thing's centre above the table.
    """
    position, quat = pose.position_m.copy(), np.zeros_like(pose.quat)
    position[..., 2] = height_m - np.array([mount.position_m[2] for mount in mounts])
    quat[..., 0], quat[..., 3] = pose.quat[..., 0], pose.quat[..., 3]
    return Poses(position, quat / np.linalg.norm(quat, axis=-1, keepdims=True))


def postures(flanges: Poses, near_q_rad: Array, dh: Sequence[DHParameters]) -> Array:
    """Joint positions, (n, 2, 6), nearest to others that put the flanges at poses in the arms' `base` frames.

    Raises:
        UnreachableError: A pose cannot be reached.
    """
    rotation = quat_to_matrix(flanges.quat)
    if dh[0] == dh[1]:
        # One call for arms with the same kinematics: it costs little more than for a single pose.
        return nearest(flanges.position_m, rotation, near_q_rad, dh[0])
    arms = [nearest(flanges.position_m[:, k], rotation[:, k], near_q_rad[:, k], dh[k]) for k in (0, 1)]
    return np.stack(arms, axis=1)
