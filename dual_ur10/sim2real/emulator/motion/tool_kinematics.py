"""Poses as UR writes them, x, y, z and a rotation vector, and the kinematics of an arm with a tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dual_ur10.kinematics.forward import flange_pose, pose_and_jacobian
from dual_ur10.kinematics.inverse import try_nearest
from dual_ur10.kinematics.rotations import cross
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.types import Array

Pose = tuple[float, ...]

FARTHEST_M = 10.0
"""Beyond this no pose is asked for: the arm reaches less, and squares of the numbers stay finite."""


class Frame(NamedTuple):
    """A pose: position (3,) and rotation matrix (3, 3), or (n, 3) and (n, 3, 3)."""

    position: Array
    rotation: Array


def rotation_of(rotvec: Sequence[float]) -> Array:
    """Rotation matrix (3, 3) of a rotation vector in rad; Rodrigues' formula."""
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a) / a and (1 - cos(a)) / a².
    half = 0.5 * angle
    first = math.sin(angle) / angle if angle > 1e-150 else 1.0
    second = 0.5 * (math.sin(half) / half) ** 2 if half > 1e-150 else 0.5
    xx, yy, zz, xy, xz, yz = (second * each for each in (x * x, y * y, z * z, x * y, x * z, y * z))
    x, y, z = first * x, first * y, first * z
    return np.array([[1 - yy - zz, xy - z, xz + y], [xy + z, 1 - xx - zz, yz - x], [xz - y, yz + x, 1 - xx - yy]])


def rotvec_of(rotation: Array) -> tuple[float, float, float]:
    """Rotation vector of a rotation matrix (3, 3), of length 0 to pi."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    # Of the four forms of the quaternion, the one with the greatest divisor.
    if a + e + i > 0.0:
        w, x, y, z = 1 + a + e + i, h - f, c - g, d - b
    elif a >= e and a >= i:
        w, x, y, z = h - f, 1 + a - e - i, b + d, c + g
    elif e >= i:
        w, x, y, z = c - g, b + d, 1 - a + e - i, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1 - a - e + i
    norm = math.sqrt(x * x + y * y + z * z)
    if norm < 1e-150:
        return 0.0, 0.0, 0.0
    scale = 2 * math.atan2(norm, abs(w)) / math.copysign(norm, w)
    return x * scale, y * scale, z * scale


def frame_of(pose: Sequence[float]) -> Frame:
    """Position and rotation of a pose."""
    return Frame(np.array(pose[:3], dtype=np.float64), rotation_of(pose[3:]))


def pose_of(frame: Frame) -> Pose:
    """UR's six numbers of a position (3,) and rotation (3, 3)."""
    return (*frame.position.tolist(), *rotvec_of(frame.rotation))


class Tool:
    """Where the TCP is on the flange.

    Args:
        pose: UR's six numbers, in the frame of the flange.
    """

    def __init__(self, pose: Sequence[float] = (0.0,) * 6) -> None:
        self.pose: Pose = tuple(float(each) for each in pose)
        self.position, self.rotation = frame_of(self.pose)
        self.is_flange = not any(self.pose)

    def tcp(self, flange: Frame) -> Frame:
        """Pose of the TCP."""
        if self.is_flange:
            return flange
        return Frame(flange.position + flange.rotation @ self.position, flange.rotation @ self.rotation)

    def flange(self, tcp: Frame) -> Frame:
        """Pose of the flange."""
        if self.is_flange:
            return tcp
        rotation = tcp.rotation @ self.rotation.T
        return Frame(tcp.position - rotation @ self.position, rotation)


class ArmKinematics:
    """Forward and inverse kinematics of one arm, of TCPs in UR's `base`.

    Args:
        dh: Its Denavit-Hartenberg parameters.
    """

    def __init__(self, dh: DHParameters) -> None:
        self.dh = dh

    def tcp(self, q: Array | Sequence[float], tool: Tool) -> Frame:
        """Pose of the TCP at joint angles (6,)."""
        return tool.tcp(Frame(*flange_pose(q, self.dh)))

    def tcp_and_jacobian(self, q: Array, tool: Tool) -> tuple[Frame, Array]:
        """Poses of the TCP at joint angles (n, 6), and (n, 6, 6): its m/s and rad/s per rad/s of each joint."""
        position, rotation, jacobian = pose_and_jacobian(q, self.dh)
        if tool.is_flange:
            return Frame(position, rotation), jacobian
        lever = rotation @ tool.position
        # The TCP's speed has the rotation's cross product with where it is from the flange.
        jacobian[:, :3] += cross(jacobian[:, 3:].swapaxes(1, 2), lever[:, None]).swapaxes(1, 2)
        return Frame(position + lever, rotation @ tool.rotation), jacobian

    def jacobian(self, q: Array, tool: Tool) -> Array:
        """(6, 6): m/s and rad/s of the TCP per rad/s of each joint."""
        jacobian: Array = self.tcp_and_jacobian(q[None], tool)[1][0]
        return jacobian

    def joints(self, tcp: Frame, near: Array, tool: Tool) -> tuple[Array, bool]:
        """Joint angles (n, 6) nearest to `near` (6,) for n poses of the TCP, and whether all are in reach."""
        flange = tool.flange(tcp)
        position = flange.position
        if not np.abs(position).max() < FARTHEST_M:
            return np.broadcast_to(near, (len(position), 6)), False
        q, ok = try_nearest(position, flange.rotation, near, self.dh)
        return q, bool(ok.all())
