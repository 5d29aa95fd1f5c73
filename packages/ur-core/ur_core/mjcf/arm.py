"""One arm's `MjSpec`: ``ur10.xml``, fitted to its model and corrected to its own Denavit-Hartenberg parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.rotations import quat_multiply
from ur_core.kinematics.ur10 import JOINTS, LINKS, DHParameters, nominal_dh
from ur_core.mjcf.arm_shape import fit_bodies, fit_shape
from ur_core.mjcf.gains import Gains, gains_of
from ur_core.types import Array

_ARM_FILE: Final = Path(__file__).with_name("ur10.xml")

_Quat = tuple[float, float, float, float]
_Pose = tuple[Array, _Quat]


def arm_spec(dh: DHParameters, gains: Gains) -> Any:
    """Return the `MjSpec` of one arm.

    Args:
        dh: Kinematics of the arm, which name its model.
        gains: Gains of the joint servos.
    """
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

    arm = mujoco.MjSpec.from_file(str(_ARM_FILE))
    if dh.robot != "ur10":  # whom the file describes
        fit_bodies(arm, robot_model(dh.robot))
        fit_shape(arm, robot_model(dh.robot))
    _apply_dh(arm, dh)
    for joint, kp, kv in zip(JOINTS, *gains_of(dh.robot, gains), strict=True):
        arm.actuator(joint).set_to_position(kp=kp, kv=kv)
    return arm


def remove_visuals(arm: Any) -> None:
    """Remove the visual geoms of one arm's spec."""
    for geom in arm.geoms:
        if geom.classname.name == "visual":
            arm.delete(geom)


def quat_z(angle_rad: float) -> _Quat:
    """Return the quaternion w, x, y, z of a rotation about z."""
    return math.cos(angle_rad / 2), 0.0, 0.0, math.sin(angle_rad / 2)


def _apply_dh(arm: Any, dh: DHParameters) -> None:
    """Move the bodies of one arm to the frames of its own DH parameters, exactly.

    A calibration may shift d2, d3 and d4 by metres against each other, as joints 2 to 4 are nearly parallel. The
    frames of forearm and wrist 1 are shifted back along their own joint axes to their links, which keeps the
    kinematics.
    """
    if dh.is_nominal:
        return  # the file holds the nominal arm
    slide = np.zeros(7)
    slide[2] = -dh.d_m[1] / math.cos(dh.alpha_rad[1])
    slide[3] = (slide[2] - dh.d_m[2]) / math.cos(dh.alpha_rad[2])
    nominal, corrected = _link_ends(nominal_dh(dh.robot), np.zeros(7)), _link_ends(dh, slide)
    arm.body(LINKS[0]).quat = quat_multiply((0.0, 0.0, 0.0, 1.0), quat_z(dh.theta_rad[0]))
    for i, link in enumerate(LINKS):
        body = arm.body(link)
        position, twist = corrected[i]
        if i < 5:
            child = arm.body(LINKS[i + 1])
            child.pos, child.quat = position, quat_multiply(twist, quat_z(dh.theta_rad[i + 1]))
        else:
            site = arm.site("flange")
            site.pos, site.quat = position, twist
        _move_inertia(body, nominal[i], corrected[i])


def _link_ends(dh: DHParameters, slide: Array) -> list[_Pose]:
    """Return the pose of each link's distal frame in its body frame: position in m, quaternion w, x, y, z.

    Args:
        dh: Kinematics of the arm.
        slide: (7,) shift in m of each body frame along its own joint axis.
    """
    poses: list[_Pose] = []
    for i in range(6):
        alpha = dh.alpha_rad[i]
        position = np.array(
            [
                dh.a_m[i],
                -math.sin(alpha) * slide[i + 1],
                dh.d_m[i] - slide[i] + math.cos(alpha) * slide[i + 1],
            ]
        )
        poses.append((position, (math.cos(alpha / 2), math.sin(alpha / 2), 0.0, 0.0)))
    return poses


def _move_inertia(body: Any, old: _Pose, new: _Pose) -> None:
    """Move a body's inertia along with the distal frame in which it is given."""
    rotation = _matrix(new[1]) @ _matrix(old[1]).T
    ixx, iyy, izz, ixy, ixz, iyz = body.fullinertia
    inertia = rotation @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ rotation.T
    body.ipos = new[0] + rotation @ (body.ipos - old[0])
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _matrix(quat: _Quat) -> Array:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
