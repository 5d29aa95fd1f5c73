"""Between the cell frame and each arm's own `base` frame, the one in which UR's controller reports its TCP."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.settings import ArmMount
from dual_ur10.kinematics import BASE_TO_BASE_LINK
from dual_ur10.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_to_matrix

Array = NDArray[np.float64]


def to_base(mounts: tuple[ArmMount, ArmMount]) -> tuple[Array, Array]:
    """Position, (2, 3), and rotation, (2, 3, 3), that turn cell frame vectors into each arm's own `base` frame."""
    turns = quat_to_matrix(quat_from_rotvec(np.array([[0.0, 0.0, mount.yaw_rad] for mount in mounts])))
    rotation = (turns @ BASE_TO_BASE_LINK).swapaxes(-1, -2)
    return np.array([mount.position_m for mount in mounts]), rotation


def left_product(quat: Array) -> Array:
    """Matrix M, (4, 4), such that `q @ M` is the product of `quat` and a quaternion q, (..., 4)."""
    unit = np.eye(4)
    return np.array([quat_multiply(quat, unit[k]) for k in range(4)])


class Frames:
    """Poses of a batch of cells from the cell frame to the arms' `base` frames and back.

    Every product is one small one per cell, so that a cell's numbers do not depend on how many others there are.

    Args:
        mounts: Where the arms stand.
    """

    def __init__(self, mounts: tuple[ArmMount, ArmMount]) -> None:
        self.base_m, self.rotation = to_base(mounts)
        turns = [quat_from_rotvec(np.array([0.0, 0.0, -np.pi - mount.yaw_rad])) for mount in mounts]
        self._quat = np.stack([left_product(turn) for turn in turns])
        self._back = np.stack([left_product(quat_conjugate(turn)) for turn in turns])

    def position_to_base(self, position_m: Array) -> Array:
        """Cell frame positions, (..., 2, 3), in each arm's own `base` frame."""
        away = (position_m - self.base_m)[..., None, :]
        result: Array = (away @ self.rotation.swapaxes(-1, -2))[..., 0, :]
        return result

    def position_to_cell(self, position_m: Array) -> Array:
        """Positions in each arm's own `base` frame, (..., 2, 3), in the cell frame."""
        result: Array = (position_m[..., None, :] @ self.rotation)[..., 0, :] + self.base_m
        return result

    def vector_to_base(self, vector: Array) -> Array:
        """Cell frame vectors, (..., 2, 3), in each arm's own `base` frame."""
        result: Array = (vector[..., None, :] @ self.rotation.swapaxes(-1, -2))[..., 0, :]
        return result

    def vector_to_cell(self, vector: Array) -> Array:
        """Vectors in each arm's own `base` frame, (..., 2, 3), in the cell frame."""
        result: Array = (vector[..., None, :] @ self.rotation)[..., 0, :]
        return result

    def quat_to_base(self, quat: Array) -> Array:
        """Cell frame orientations, (..., 2, 4), in each arm's own `base` frame."""
        result: Array = (quat[..., None, :] @ self._quat)[..., 0, :]
        return result

    def quat_to_cell(self, quat: Array) -> Array:
        """Orientations in each arm's own `base` frame, (..., 2, 4), in the cell frame."""
        result: Array = (quat[..., None, :] @ self._back)[..., 0, :]
        return result

    @property
    def others_pose(self) -> Array:
        """(2, 8, 7): `[position, orientation, 1] @ matrix[k]` is the pose of arm k's other one in k's `base` frame.

        The row vector is that of the other arm's pose in its own `base` frame.
        """
        result = np.zeros((2, 8, 7))
        for own, other in ((0, 1), (1, 0)):
            result[own, :3, :3] = self.rotation[other] @ self.rotation[own].T
            result[own, 3:7, 3:] = self._back[other] @ self._quat[own]
            result[own, 7, :3] = (self.base_m[other] - self.base_m[own]) @ self.rotation[own].T
        return result
