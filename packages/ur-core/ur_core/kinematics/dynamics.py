"""Inverse dynamics of one nominal arm, by pinocchio."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ur_core.errors import MissingExtraError, SettingsError
from ur_core.kinematics.forward import checked_joints, fixed_transforms
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.types import Array, Vector3


@lru_cache(maxsize=32)
def _model(robot: str, payload_kg: float, payload_com_m: Vector3, gravity: bool) -> tuple[Any, Any, Any]:
    """Return pinocchio's module, model and data of a nominal arm with a point mass at the flange."""
    try:
        pin = importlib.import_module("pinocchio")  # here, as it takes longer to import than the rest of the package
    except ImportError:
        raise MissingExtraError("pin", "dynamics", "the dynamics of an arm", distribution="ur-core") from None
    model, facts = pin.Model(), robot_model(robot)
    joint, placement = 0, np.eye(4)
    for link, fixed in enumerate(fixed_transforms(nominal_dh(robot))):
        joint = model.addJoint(joint, pin.JointModelRZ(), pin.SE3(placement), f"joint_{link + 1}")
        xx, yy, zz, xy, xz, yz = facts.inertia_kg_m2[link]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pin.Inertia(facts.mass_kg[link], np.array(facts.com_m[link]), inertia)
        model.appendBodyToJoint(joint, body, pin.SE3(fixed))
        placement = fixed
    if payload_kg:
        payload = pin.Inertia(payload_kg, np.array(payload_com_m), np.zeros((3, 3)))
        model.appendBodyToJoint(joint, payload, pin.SE3(placement))
    if not gravity:
        model.gravity = pin.Motion.Zero()
    return pin, model, model.createData()


def inverse_dynamics(
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    payload_kg: float = 0.0,
    payload_com_m: Sequence[float] = (0.0, 0.0, 0.0),
    gravity: bool = True,
    armature_kg_m2: float = 0.0,
    *,
    robot: str,
) -> Array:
    """Return the joint torques of a motion of a nominal arm on an upright base, without friction.

    Args:
        q_rad: (..., 6) joint angles; the three arrays broadcast.
        qd_rad_s: (..., 6) joint speeds.
        qdd_rad_s2: (..., 6) joint accelerations.
        payload_kg: Mass of a point payload.
        payload_com_m: Its place in the flange frame.
        gravity: Whether to count gravity, 9.81 m/s² along -z of ``base``.
        armature_kg_m2: Reflected inertia of every rotor, ``ARMATURE_KG_M2`` on the simulated UR10.
        robot: Model of the arm, a name in ``ur_core.kinematics.robots.ROBOTS``.

    Returns:
        Torques (..., 6) in N·m.

    Raises:
        MissingExtraError: pin is not installed.
        SettingsError: Not six joints, or a payload that is negative or not finite.
        UnknownNameError: There is no such model.
    """
    pin, model, data = _model(robot, *_payload(payload_kg, payload_com_m), bool(gravity))
    q, qd, qdd = np.broadcast_arrays(checked_joints(q_rad), checked_joints(qd_rad_s), checked_joints(qdd_rad_s2))
    torque = np.empty(q.shape)
    flat = (array.reshape(-1, 6) for array in (q, qd, qdd))
    rows = torque.reshape(-1, 6)
    for index, (position, speed, acceleration) in enumerate(zip(*flat, strict=True)):
        rows[index] = pin.rnea(model, data, position, speed, acceleration)
    if armature_kg_m2:
        torque += armature_kg_m2 * qdd
    return torque


def mass_matrix(
    q_rad: ArrayLike, payload_kg: float = 0.0, payload_com_m: Sequence[float] = (0.0, 0.0, 0.0), *, robot: str
) -> Array:
    """Return the mass matrix, (6, 6) in kg m², of a nominal arm at joint angles (6,), without its rotors.

    Args:
        q_rad: (6,) joint angles.
        payload_kg: Mass of a point payload.
        payload_com_m: Its place in the flange frame.
        robot: Model of the arm, a name in ``ur_core.kinematics.robots.ROBOTS``.

    Raises:
        MissingExtraError: pin is not installed.
        SettingsError: Not six joints, or a payload that is negative or not finite.
        UnknownNameError: There is no such model.
    """
    pin, model, data = _model(robot, *_payload(payload_kg, payload_com_m), True)
    upper = np.triu(pin.crba(model, data, checked_joints(q_rad)))
    matrix: Array = upper + np.triu(upper, 1).T
    return matrix


def _payload(payload_kg: float, payload_com_m: Sequence[float]) -> tuple[float, Vector3]:
    com = (float(payload_com_m[0]), float(payload_com_m[1]), float(payload_com_m[2]))
    if not (np.isfinite((payload_kg, *com)).all() and payload_kg >= 0.0):
        raise SettingsError(f"payload must be finite and not negative, found {payload_kg!r} kg at {com} m")
    return float(payload_kg), com


def stretched_inertia_kg_m2(robot: str) -> Array:
    """Return the moments of inertia, (6,), of a stretched arm about each of its joints, with the rotors.

    Raises:
        UnknownNameError: There is no such model.
    """
    facts, pose = robot_model(robot), np.eye(4)
    axes, moments = [], facts.armature_kg_m2.copy()
    for link, fixed in enumerate(fixed_transforms(nominal_dh(robot))):
        axes.append((pose[:3, 2], pose[:3, 3]))
        pose = pose @ fixed
        xx, yy, zz, xy, xz, yz = facts.inertia_kg_m2[link]
        turn, center = pose[:3, :3], pose[:3, :3] @ np.array(facts.com_m[link]) + pose[:3, 3]
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        for joint, (axis, origin) in enumerate(axes):
            lever = np.cross(axis, center - origin)
            moments[joint] += axis @ inertia @ axis + facts.mass_kg[link] * (lever @ lever)
    return moments
