"""Poses in UR's notation, x, y, z and a rotation vector, and the kinematics of an arm with a tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ur_core.kinematics.forward import flange_pose, pose_and_jacobian
from ur_core.kinematics.inverse import try_nearest
from ur_core.kinematics.rotations import cross
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array

UrPose = tuple[float, ...]

MAX_DISTANCE_M = 10.0
"""Farthest position that is solved for. The arm reaches less, and squares of the numbers stay finite."""


class Frame(NamedTuple):
    """Pose: position (3,) and rotation matrix (3, 3), or (n, 3) and (n, 3, 3)."""

    position: Array
    rotation: Array


def rotation_of(rotvec: Sequence[float]) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector in rad, by Rodrigues' formula."""
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
    """Return the rotation vector of a rotation matrix (3, 3), of length 0 to pi."""
    return _rotvec(rotation.tolist())


def _rotvec(rows: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = rows
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
    """Return position and rotation of a pose."""
    return Frame(np.array(pose[:3], dtype=np.float64), rotation_of(pose[3:]))


def pose_of(frame: Frame) -> UrPose:
    """Return UR's six numbers of a position (3,) and rotation (3, 3)."""
    return (*frame.position.tolist(), *rotvec_of(frame.rotation))


class Tcp:
    """Pose of the TCP on the flange.

    Args:
        pose: UR's six numbers, in the frame of the flange.
    """

    def __init__(self, pose: Sequence[float] = (0.0,) * 6) -> None:
        self.pose: UrPose = tuple(float(each) for each in pose)
        self.position, self.rotation = frame_of(self.pose)
        self.is_flange = not any(self.pose)

    def tcp(self, flange: Frame) -> Frame:
        """Return the pose of the TCP."""
        if self.is_flange:
            return flange
        return Frame(flange.position + flange.rotation @ self.position, flange.rotation @ self.rotation)

    def flange(self, tcp: Frame) -> Frame:
        """Return the pose of the flange."""
        if self.is_flange:
            return tcp
        rotation = tcp.rotation @ self.rotation.T
        return Frame(tcp.position - rotation @ self.position, rotation)


class ArmKinematics:
    """Forward and inverse kinematics of one arm, for TCPs in UR's `base`.

    Args:
        dh: Denavit-Hartenberg parameters.
    """

    def __init__(self, dh: DHParameters) -> None:
        self.dh = dh
        twists = [(math.cos(alpha), math.sin(alpha)) for alpha in dh.alpha_rad]
        self._links = [(*each, *twist) for *each, twist in zip(dh.theta_rad, dh.d_m, dh.a_m, twists, strict=True)]

    def tcp(self, q: Array | Sequence[float], tool: Tcp) -> Frame:
        """Return the pose of the TCP at joint angles (6,)."""
        return tool.tcp(Frame(*flange_pose(q, self.dh)))

    def tcp_and_jacobian(self, q: Array, tool: Tcp) -> tuple[Frame, Array]:
        """Return poses of the TCP at joint angles (n, 6), and its Jacobian (n, 6, 6) in m/s and rad/s per rad/s."""
        position, rotation, jacobian = pose_and_jacobian(q, self.dh)
        if tool.is_flange:
            return Frame(position, rotation), jacobian
        lever = rotation @ tool.position
        # The lever from flange to TCP adds its cross product with the rotation.
        jacobian[:, :3] += cross(jacobian[:, 3:].swapaxes(1, 2), lever[:, None]).swapaxes(1, 2)
        return Frame(position + lever, rotation @ tool.rotation), jacobian

    def pose_and_speed(self, q: Array, qd: Array, tool: Tcp) -> tuple[UrPose, tuple[float, ...]]:
        """Return pose (6,) and speed (6,), m/s and rad/s in base, of the TCP at joint angles and speeds (6,).

        One arm in plain numbers takes a fifth of the time of one row of arrays, and controllers do this in every
        control period.
        """
        # Axes, origin and velocities of the frame before each joint, which rotates about z.
        xx = yy = zz = 1.0
        xy = xz = yx = yz = zx = zy = px = py = pz = vx = vy = vz = wx = wy = wz = 0.0
        for angle, rate, (offset, d, a, cos_twist, sin_twist) in zip(q.tolist(), qd.tolist(), self._links, strict=True):
            wx, wy, wz = wx + rate * zx, wy + rate * zy, wz + rate * zz
            c, s = math.cos(angle + offset), math.sin(angle + offset)
            xx, xy, xz, yx, yy, yz = (
                c * xx + s * yx,
                c * xy + s * yy,
                c * xz + s * yz,
                c * yx - s * xx,
                c * yy - s * xy,
                c * yz - s * xz,
            )
            lx, ly, lz = a * xx + d * zx, a * xy + d * zy, a * xz + d * zz
            px, py, pz = px + lx, py + ly, pz + lz
            vx, vy, vz = vx + wy * lz - wz * ly, vy + wz * lx - wx * lz, vz + wx * ly - wy * lx
            yx, yy, yz, zx, zy, zz = (
                cos_twist * yx + sin_twist * zx,
                cos_twist * yy + sin_twist * zy,
                cos_twist * yz + sin_twist * zz,
                cos_twist * zx - sin_twist * yx,
                cos_twist * zy - sin_twist * yy,
                cos_twist * zz - sin_twist * yz,
            )
        rows = [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]]
        if not tool.is_flange:
            flange = np.array(rows)
            lx, ly, lz = (flange @ tool.position).tolist()
            px, py, pz = px + lx, py + ly, pz + lz
            vx, vy, vz = vx + wy * lz - wz * ly, vy + wz * lx - wx * lz, vz + wx * ly - wy * lx
            rows = (flange @ tool.rotation).tolist()
        return (px, py, pz, *_rotvec(rows)), (vx, vy, vz, wx, wy, wz)

    def jacobian(self, q: Array, tool: Tcp) -> Array:
        """Return the Jacobian (6, 6) of the TCP in m/s and rad/s per rad/s."""
        jacobian: Array = self.tcp_and_jacobian(q[None], tool)[1][0]
        return jacobian

    def joints(self, tcp: Frame, near: Array, tool: Tcp) -> tuple[Array, bool]:
        """Return the joint angles (n, 6) nearest to `near` (6,) for n poses of the TCP, and if all are in reach."""
        flange = tool.flange(tcp)
        position = flange.position
        if not np.abs(position).max() < MAX_DISTANCE_M:
            return np.broadcast_to(near, (len(position), 6)), False
        q, ok = try_nearest(position, flange.rotation, near, self.dh)
        return q, bool(ok.all())
