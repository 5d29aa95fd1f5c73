"""Kinematics of one UR10: flange pose, Jacobian, inverse kinematics in closed form, inverse dynamics.

All functions are batched: joint angles have shape (..., 6) and results keep the leading axes. Units are m, rad, kg, s
and N·m. Every pose is that of the flange (UR's tool with a zero TCP; ``tool0`` in ROS) in UR's own ``base`` frame, the
one the controller's ``getActualTCPPose`` uses. ROS' ``base_link`` is turned by 180° about z against it: see
[to_base_link][dual_ur10.kinematics.to_base_link].

Inverse kinematics names its 8 branches by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.

This is the module to import from. The work is done next door, in ``forward_kinematics``, ``inverse_kinematics`` with
its ``closed_form``, and ``dynamics``, which loads pinocchio at its first call.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from dual_ur10.dynamics import inverse_dynamics
from dual_ur10.forward_kinematics import elbow_and_flange_position, flange_pose, flange_pose_quat, jacobian
from dual_ur10.inverse_kinematics import inverse, nearest, try_nearest
from dual_ur10.rotations import quat_multiply
from dual_ur10.ur10 import Array, constant

__all__ = [
    "BASE_TO_BASE_LINK",
    "BASE_TO_BASE_LINK_QUAT",
    "elbow_and_flange_position",
    "flange_pose",
    "flange_pose_quat",
    "inverse",
    "inverse_dynamics",
    "jacobian",
    "nearest",
    "quat_to_base_link",
    "to_base_link",
    "try_nearest",
]

BASE_TO_BASE_LINK: Final = constant([[-1, 0, 0], [0, -1, 0], [0, 0, 1]])
"""Rotation from coordinates in ``base`` to coordinates in ``base_link``; it is its own inverse. No offset."""

BASE_TO_BASE_LINK_QUAT: Final = constant([0, 0, 0, 1])
"""The same as a quaternion (w, x, y, z); its inverse is the same rotation."""


def to_base_link(position_m: ArrayLike, rotation: ArrayLike) -> tuple[Array, Array]:
    """Turn poses in ``base`` into ``base_link``; the same function leads back.

    Args:
        position_m: (..., 3).
        rotation: (..., 3, 3).

    Returns:
        Position (..., 3) and rotation (..., 3, 3).
    """
    return np.asarray(position_m) @ BASE_TO_BASE_LINK, BASE_TO_BASE_LINK @ np.asarray(rotation)


def quat_to_base_link(quat: ArrayLike) -> Array:
    """Turn orientations (..., 4) in ``base`` into ``base_link``; twice gives the opposite sign of the same rotation."""
    return quat_multiply(BASE_TO_BASE_LINK_QUAT, quat)
