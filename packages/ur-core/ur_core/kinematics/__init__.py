"""Kinematics and dynamics of one arm: robot facts, rotations, frames, forward and inverse kinematics.

All functions are batched: joint angles have shape (..., 6) and results keep the leading axes. Units are m, rad, kg, s
and N·m. Every pose is that of the flange (UR's tool with a zero TCP; ``tool0`` in ROS) in UR's own ``base`` frame, the
one the controller's ``getActualTCPPose`` uses. ROS' ``base_link`` is rotated by 180° about z against it: see
[to_base_link][ur_core.kinematics.to_base_link].

Inverse kinematics names its 8 branches by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.

Pinocchio is loaded at the first call of inverse dynamics.
"""

from ur_core.kinematics.dynamics import inverse_dynamics
from ur_core.kinematics.forward import elbow_and_flange_position, flange_pose, flange_pose_quat, jacobian
from ur_core.kinematics.frames import BASE_TO_BASE_LINK, BASE_TO_BASE_LINK_QUAT, quat_to_base_link, to_base_link
from ur_core.kinematics.inverse import inverse, nearest, try_nearest

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


def __dir__() -> list[str]:
    return sorted(__all__)
