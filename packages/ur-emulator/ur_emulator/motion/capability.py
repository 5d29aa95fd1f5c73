"""Largest speed and acceleration of an arm along a path, from the limits of its joints' speeds and torques.

UR does not publish how `optimovej` and `optimovel` find them. Here the joint that reaches its limit first decides: the
speed anywhere on the path, and the acceleration at either end, where a joint's torque also carries the arm.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ur_core.kinematics.dynamics import inverse_dynamics, mass_matrix
from ur_core.kinematics.robots import robot_model
from ur_core.types import Array, Vector3
from ur_emulator.motion.cartesian import ACCELERATION_LIMIT, SPEED_LIMIT
from ur_emulator.motion.paths import Line
from ur_emulator.motion.tool_kinematics import ArmKinematics, Frame, Tcp
from ur_emulator.motion.trajectories import ACCELERATION_LIMIT_RAD_S2

_POINTS: Final = 9  # of a line in space at which its slopes are taken
_NO_SLOPE: Final = 1e-9
_LEAST: Final = 0.01  # of a joint's torque that is left for the acceleration


class Capability(NamedTuple):
    """Largest speed and acceleration along a path, per unit of the path."""

    speed: float
    acceleration: float


class Load(NamedTuple):
    """Payload: mass and centre of gravity in the flange frame."""

    mass_kg: float
    center_m: Vector3


def joint_capability(robot: str, start: Array, end: Array, load: Load) -> Capability:
    """Return the capability on a line in joint space, in rad/s and rad/s² of the joint that moves farthest.

    Args:
        robot: Model of the arm.
        start: (6,) joint positions.
        end: (6,) joint positions.
        load: Payload.
    """
    distance = float(np.abs(end - start).max())
    slope = (end - start) / distance if distance > _NO_SLOPE else np.zeros(6)
    speed, acceleration = _along(robot, np.array([start, end]), np.array([slope, slope]), load)
    most = float(robot_model(robot).joint_speed_rad_s.max())
    return Capability(min(speed, most), min(acceleration, ACCELERATION_LIMIT_RAD_S2))


def line_capability(arm: ArmKinematics, tool: Tcp, start: Array, end: Frame, load: Load) -> Capability | None:
    """Return the capability on a line in space, in m/s and m/s², or where the rotation is larger in rad/s and rad/s².

    Args:
        arm: Kinematics of the arm.
        tool: Pose of the TCP on the flange.
        start: (6,) joint positions.
        end: Final pose of the TCP.
        load: Payload.

    Returns:
        None if the arm does not reach a point of the line.
    """
    line = Line(arm.tcp(start, tool), end)
    distance, rows, near = max(line.length_m, line.angle_rad), [start], start
    if distance > _NO_SLOPE:
        frames = line.at(np.linspace(0.0, 1.0, _POINTS))
        for position, rotation in zip(frames.position[1:], frames.rotation[1:], strict=True):
            q, ok = arm.joints(Frame(position[None], rotation[None]), near, tool)
            if not ok:
                return None
            near = q[0]
            rows.append(near)
    path = np.array(rows)
    slopes = np.gradient(path, distance / (_POINTS - 1), axis=0) if len(path) > 1 else np.zeros_like(path)
    speed, acceleration = _along(arm.dh.robot, path, slopes, load)
    return Capability(min(speed, SPEED_LIMIT), min(acceleration, ACCELERATION_LIMIT))


def _along(robot: str, path: Array, slopes: Array, load: Load) -> Capability:
    """Return the capability at joint positions (n, 6) with their derivatives along the path, (n, 6)."""
    facts = robot_model(robot)
    used = float((np.abs(slopes) / facts.joint_speed_rad_s).max())
    most, still = np.array(facts.joint_torque_nm), np.zeros(6)
    acceleration = float("inf")
    for q, slope in ((path[0], slopes[0]), (path[-1], slopes[-1])):
        weight = inverse_dynamics(q, still, still, *load, robot=robot)
        torque = np.abs((mass_matrix(q, *load, robot=robot) + np.diag(facts.armature_kg_m2)) @ slope)
        left = np.maximum(most - np.abs(weight), _LEAST * most)
        moved = torque > _NO_SLOPE
        acceleration = min(acceleration, float((left[moved] / torque[moved]).min(initial=float("inf"))))
    return Capability(1.0 / used if used > _NO_SLOPE else float("inf"), acceleration)
