"""Coupling error: how far the relative pose of two arms that hold one object is from the one that is wanted.

The supervisor of two controllers stops both arms by it, and every cell reports it.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.types import Array, Mask

APART_M: Final = 0.01
APART_RAD: Final = math.radians(3.0)
"""Largest coupling error on two controllers: beyond it, both arms stop."""


class RelativePoses(NamedTuple):
    """Poses of the right flange in the frame of the left one.

    Attributes:
        position_m: (..., 3).
        rotation: (..., 3, 3).
    """

    position_m: Array
    rotation: Array


class Coupling:
    """Relative pose of the flanges of two arms, and its error.

    Args:
        mounts: Base poses and kinematics of both arms.
    """

    def __init__(self, mounts: tuple[ArmMount, ArmMount]) -> None:
        frames = Frames(mounts)
        left, right = quat_to_matrix(frames.quat_to_cell(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))))
        origins_m = frames.position_to_cell(np.zeros((2, 3)))
        # Pose of the right `base` frame in the left one.
        self._between, self._offset_m = left.T @ right, (origins_m[1] - origins_m[0]) @ left
        self._dh = [mount.dh for mount in mounts]

    def relative_poses(self, q_rad: Array) -> RelativePoses:
        """Return the poses of the right flange in the frame of the left one, (n, ...), at joint angles (n, 2, 6)."""
        (left_m, left), (right_m, right) = (flange_pose(q_rad[:, arm], dh) for arm, dh in enumerate(self._dh))
        back = left.swapaxes(1, 2)
        away_m = right_m @ self._between.T + (self._offset_m - left_m)
        return RelativePoses((back @ away_m[..., None])[..., 0], back @ (self._between @ right))

    def values(self, q_rad: Array, target_q_rad: Array | None, coupled: Mask) -> dict[str, Array]:
        """Return the coupling error of n cells as values of `info`, (n,) each.

        Args:
            q_rad: (n, 2, 6) joint positions.
            target_q_rad: (n, 2, 6) those that the controllers want at that time; None: the same.
            coupled: (n,) rows whose arms hold one object between them; the others have 0.
        """
        found: Array = np.zeros((2, len(coupled)))
        if target_q_rad is not None and coupled.any():
            position_m, rotation = self.relative_poses(np.concatenate([q_rad[coupled], target_q_rad[coupled]]))
            k = len(position_m) // 2
            found[:, coupled] = pose_errors(
                RelativePoses(position_m[:k], rotation[:k]), RelativePoses(position_m[k:], rotation[k:])
            )
        return {"coupling_error_m": found[0], "coupling_error_rad": found[1]}


def pose_errors(found: RelativePoses, wanted: RelativePoses) -> tuple[Array, Array]:
    """Return the distances of poses, (...), in m and rad."""
    apart_m: Array = np.sqrt(np.square(found.position_m - wanted.position_m).sum(axis=-1))
    # The norm of a difference of two rotations is 2 √2 times the sine of half the angle between them.
    sine = np.sqrt(np.square(found.rotation - wanted.rotation).sum(axis=(-2, -1)) / 8)
    apart_rad: Array = 2 * np.arcsin(np.minimum(sine, 1.0))
    return apart_m, apart_rad


def is_beyond(apart_m: float, apart_rad: float) -> bool:
    """Return True if a coupling error is beyond what two controllers allow."""
    return apart_m > APART_M or apart_rad > APART_RAD
