"""Frames: mounts of the arms, and poses between the cell frame, `base_link` and each arm's own `base` frame.

UR's controller reports its TCP in `base`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ur_core.errors import SettingsError
from ur_core.kinematics.robots import RobotModel, robot_model
from ur_core.kinematics.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
)
from ur_core.kinematics.ur10 import NOMINAL_DH, DHParameters, nominal_dh
from ur_core.types import Array, Vector3, constant


def finite_floats(name: str, values: Any, length: int) -> tuple[Any, ...]:
    """Return plain finite floats, so that equal settings hash alike.

    Raises:
        SettingsError: They are not `length` finite numbers.
    """
    try:
        found = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        found = ()
    if len(found) != length or not all(map(math.isfinite, found)):
        raise SettingsError(f"{name} must be {length} finite number{'s' * (length > 1)}, found {values!r}")
    return found


BASE_TO_BASE_LINK: Final = constant([[-1, 0, 0], [0, -1, 0], [0, 0, 1]])
"""Rotation from coordinates in ``base`` to coordinates in ``base_link``; it is its own inverse. No offset."""

BASE_TO_BASE_LINK_QUAT: Final = constant([0, 0, 0, 1])
"""The same as a quaternion (w, x, y, z); its inverse is the same rotation."""


def to_base_link(position_m: ArrayLike, rotation: ArrayLike) -> tuple[Array, Array]:
    """Convert poses in ``base`` to ``base_link``; the function is its own inverse.

    Args:
        position_m: (..., 3).
        rotation: (..., 3, 3).

    Returns:
        Position (..., 3) and rotation (..., 3, 3).
    """
    return np.asarray(position_m) @ BASE_TO_BASE_LINK, BASE_TO_BASE_LINK @ np.asarray(rotation)


def quat_to_base_link(quat: ArrayLike) -> Array:
    """Convert orientations (..., 4) in ``base`` to ``base_link``; applying it twice negates the quaternion."""
    return quat_multiply(BASE_TO_BASE_LINK_QUAT, quat)


FLOOR_Z_M: Final = -0.75
"""Height of the floor in the cell frame; the table's top is at 0."""

MAX_MOUNT_M: Final = 3.0
"""Largest absolute coordinate of a base in the cell frame."""


MAX_TILT_RAD: Final = math.radians(5)
"""Largest tilt of a base about each axis: tables are more level, and arms on walls are another cell."""


@dataclass(frozen=True)
class ArmMount:
    """Pose of one arm's base, and the arm's kinematics.

    Attributes:
        position_m: (3,) position of `base_link` in the cell frame.
        yaw_rad: Rotation of `base_link` about the cell's z axis; 0 faces +x.
        tilt_rad: (2,) tilt of `base_link` after that: x and y of a rotation vector in the cell frame, whose z is 0.
        dh: Kinematics of this arm, nominal or as calibrated. Left out: the nominal ones of its model.
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.

    Raises:
        UnknownNameError: There is no such model.
        SettingsError: A number is not finite, more than 3 m from the cell's origin, below the floor, or beyond ±2π; the
            tilt exceeds 5° about an axis; or the kinematics are those of another model.
    """

    position_m: Vector3
    yaw_rad: float = 0.0
    dh: DHParameters = NOMINAL_DH
    robot: str = "ur10"
    tilt_rad: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        position = finite_floats("mount position_m", self.position_m, 3)
        (yaw,) = finite_floats("mount yaw_rad", (self.yaw_rad,), 1)
        tilt = finite_floats("mount tilt_rad", self.tilt_rad, 2)
        if max(map(abs, position)) > MAX_MOUNT_M or position[2] < FLOOR_Z_M:
            raise SettingsError(
                f"mount position_m is {position}: each coordinate must be within ±{MAX_MOUNT_M} m and z not below "
                f"the floor at {FLOOR_Z_M} m"
            )
        if abs(yaw) > 2 * math.pi:
            raise SettingsError(f"mount yaw_rad is {yaw:.6g}: must be within ±2π (radians, not degrees)")
        if max(map(abs, tilt)) > MAX_TILT_RAD:
            raise SettingsError(
                f"mount tilt_rad is {tilt}: at most {math.degrees(MAX_TILT_RAD):g}° about each axis are allowed "
                f"(±{MAX_TILT_RAD:.4f} rad). Level the base"
            )
        if not isinstance(self.dh, DHParameters):
            raise SettingsError(f"mount dh must be DHParameters, found {type(self.dh).__name__}")
        model = robot_model(self.robot)
        if self.dh == NOMINAL_DH:
            object.__setattr__(self, "dh", nominal_dh(self.robot))
        elif self.dh.robot != self.robot:
            raise SettingsError(
                f"mount dh is of a {robot_model(self.dh.robot).title}, robot of a {model.title}: name one model in both"
            )
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "yaw_rad", yaw)
        object.__setattr__(self, "tilt_rad", tilt)

    @property
    def model(self) -> RobotModel:
        """Facts of the arm's model."""
        return robot_model(self.robot)

    @property
    def tilt_quat(self) -> Array:
        """(4,) tilt of `base_link` as a quaternion, in the cell frame."""
        return quat_from_rotvec(np.array([*self.tilt_rad, 0.0]))

    @property
    def quat(self) -> Array:
        """(4,) orientation of `base_link` in the cell frame."""
        return quat_multiply(self.tilt_quat, quat_from_rotvec(np.array([0.0, 0.0, self.yaw_rad])))


def yaw_and_tilt(quat: Array) -> tuple[float, tuple[float, float]]:
    """Return the `yaw_rad` and `tilt_rad` of a mount whose `base_link` has an orientation, (4,), in the cell frame."""
    yaw_rad = math.remainder(2.0 * math.atan2(quat[3], quat[0]), 2.0 * math.pi)
    x, y, _ = quat_to_rotvec(quat_multiply(quat, quat_from_rotvec(np.array([0.0, 0.0, -yaw_rad])))).tolist()
    return yaw_rad, (x, y)


def to_base(mounts: tuple[ArmMount, ArmMount]) -> tuple[Array, Array]:
    """Return base positions (2, 3), and rotations (2, 3, 3) of cell frame vectors into each arm's own `base` frame."""
    links = quat_to_matrix(np.stack([mount.quat for mount in mounts]))
    rotation = (links @ BASE_TO_BASE_LINK).swapaxes(-1, -2)
    return np.array([mount.position_m for mount in mounts]), rotation


def left_product(quat: Array) -> Array:
    """Return the matrix M (4, 4) such that `q @ M` is the product of `quat` and a quaternion q, (..., 4)."""
    unit = np.eye(4)
    return np.array([quat_multiply(quat, unit[k]) for k in range(4)])


class Frames:
    """Poses of a batch of cells from the cell frame to the arms' `base` frames and back.

    Every product is one small product per cell, so that a cell's values do not depend on the number of cells.

    Args:
        mounts: Mounts of both arms.

    Attributes:
        base_m: (2, 3) positions of the bases.
        rotation: (2, 3, 3) rotations of cell frame vectors into each arm's own `base` frame.
        quat_products: (2, 4, 4) matrices M: `q @ M` is the orientation q in that frame.
    """

    def __init__(self, mounts: tuple[ArmMount, ArmMount]) -> None:
        self.base_m, self.rotation = to_base(mounts)
        rotations = [
            quat_multiply(
                quat_from_rotvec(np.array([0.0, 0.0, -np.pi - mount.yaw_rad])), quat_conjugate(mount.tilt_quat)
            )
            for mount in mounts
        ]
        self.quat_products = np.stack([left_product(each) for each in rotations])
        self._back = np.stack([left_product(quat_conjugate(each)) for each in rotations])

    def position_to_base(self, position_m: Array) -> Array:
        """Convert cell frame positions (..., 2, 3) to each arm's own `base` frame."""
        away = (position_m - self.base_m)[..., None, :]
        result: Array = (away @ self.rotation.swapaxes(-1, -2))[..., 0, :]
        return result

    def position_to_cell(self, position_m: Array) -> Array:
        """Convert positions (..., 2, 3) in each arm's own `base` frame to the cell frame."""
        result: Array = (position_m[..., None, :] @ self.rotation)[..., 0, :] + self.base_m
        return result

    def vector_to_base(self, vector: Array) -> Array:
        """Convert cell frame vectors (..., 2, 3) to each arm's own `base` frame."""
        result: Array = (vector[..., None, :] @ self.rotation.swapaxes(-1, -2))[..., 0, :]
        return result

    def vector_to_cell(self, vector: Array) -> Array:
        """Convert vectors (..., 2, 3) in each arm's own `base` frame to the cell frame."""
        result: Array = (vector[..., None, :] @ self.rotation)[..., 0, :]
        return result

    def quat_to_base(self, quat: Array) -> Array:
        """Convert cell frame orientations (..., 2, 4) to each arm's own `base` frame."""
        result: Array = (quat[..., None, :] @ self.quat_products)[..., 0, :]
        return result

    def quat_to_cell(self, quat: Array) -> Array:
        """Convert orientations (..., 2, 4) in each arm's own `base` frame to the cell frame."""
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
            result[own, 3:7, 3:] = self._back[other] @ self.quat_products[own]
            result[own, 7, :3] = (self.base_m[other] - self.base_m[own]) @ self.rotation[own].T
        return result
