"""Pose arithmetic of URScript.

Written in plain floats: for so few numbers, one numpy call costs more than all the arithmetic of a product.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ur_emulator.script.values import POSE_LENGTH, Pose, kind, number

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def pose_trans(p_from: Sequence[float], p_from_to: Sequence[float]) -> Pose:
    """Transform the pose p_from_to from the frame p_from to the frame in which p_from is given."""
    (base, outer), (position, rotation) = _parts(p_from), _parts(p_from_to)
    moved = _rotate(outer, position)
    return _pose([a + b for a, b in zip(base, moved, strict=True)], _product(outer, rotation))


def pose_inv(p_from: Sequence[float]) -> Pose:
    """Invert a pose."""
    position, rotation = _parts(p_from)
    back = _opposite(rotation)
    return _pose([-each for each in _rotate(back, position)], back)


def pose_add(p_1: Sequence[float], p_2: Sequence[float]) -> Pose:
    """Add positions, and apply the rotation of p_2 followed by that of p_1."""
    (first, outer), (second, rotation) = _parts(p_1), _parts(p_2)
    return _pose([a + b for a, b in zip(first, second, strict=True)], _product(outer, rotation))


def pose_sub(p_to: Sequence[float], p_from: Sequence[float]) -> Pose:
    """Subtract positions, with the rotation, in the common frame, that takes p_from to p_to."""
    (end, target), (start, rotation) = _parts(p_to), _parts(p_from)
    return _pose([a - b for a, b in zip(end, start, strict=True)], _product(target, _opposite(rotation)))


def interpolate_pose(p_from: Sequence[float], p_to: Sequence[float], alpha: float) -> Pose:
    """Interpolate on a straight line and about a fixed axis, by the shorter rotation; `alpha` is 0 to 1."""
    (start, initial), (end, rotation) = _parts(p_from), _parts(p_to)
    part = float(number(alpha))
    between = _rotvec(_product(_opposite(initial), rotation))
    position = [a + part * (b - a) for a, b in zip(start, end, strict=True)]
    return _pose(position, _product(initial, _quaternion([part * each for each in between])))


def point_dist(p_from: Sequence[float], p_to: Sequence[float]) -> float:
    """Return the distance of two positions, m."""
    return math.dist(_parts(p_from)[0], _parts(p_to)[0])


def rpy2rotvec(rpy_vector: Sequence[float]) -> list[float]:
    """Convert rotations about x (roll), then y (pitch), then z (yaw) of the fixed frame to a rotation vector."""
    roll, pitch, yaw = (0.5 * each for each in _vector(rpy_vector))
    about_x = (math.cos(roll), math.sin(roll), 0.0, 0.0)
    about_y = (math.cos(pitch), 0.0, math.sin(pitch), 0.0)
    about_z = (math.cos(yaw), 0.0, 0.0, math.sin(yaw))
    return list(_rotvec(_product(about_z, _product(about_y, about_x))))


def rotvec2rpy(rotation_vector: Sequence[float]) -> list[float]:
    """Roll, pitch and yaw of a rotation vector; at a pitch of ±90° the roll is 0."""
    w, x, y, z = _quaternion(_vector(rotation_vector))
    sine = max(-1.0, min(1.0, 2.0 * (w * y - x * z)))
    if abs(sine) > 1.0 - 1e-12:
        return [0.0, math.copysign(0.5 * math.pi, sine), 2.0 * math.atan2(z, w)]
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return [roll, math.asin(sine), yaw]


def _parts(pose: Sequence[float]) -> tuple[Sequence[float], Quaternion]:
    if not isinstance(pose, list) or len(pose) != POSE_LENGTH:
        raise TypeError(f"expected a pose p[x, y, z, rx, ry, rz], found {kind(pose)}")
    if pose.__class__ is not Pose:
        pose = Pose(pose)
    return pose[:3], _quaternion(pose[3:])


def _vector(values: Sequence[float]) -> Vector:
    if not isinstance(values, list) or len(values) != 3:
        raise TypeError(f"expected a list of 3 numbers, found {kind(values)}")
    x, y, z = (float(number(value)) for value in values)
    return x, y, z


def _pose(position: Sequence[float], rotation: Quaternion) -> Pose:
    return Pose((*position, *_rotvec(rotation)))


def _quaternion(rotvec: Sequence[float]) -> Quaternion:
    x, y, z = rotvec
    angle = math.sqrt(x * x + y * y + z * z)
    # Below this, sin(angle / 2) / angle is 1 / 2 to the last bit.
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    return math.cos(0.5 * angle), x * scale, y * scale, z * scale


def _rotvec(quaternion: Quaternion) -> Vector:
    w, x, y, z = quaternion
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return x * scale, y * scale, z * scale


def _product(first: Quaternion, second: Quaternion) -> Quaternion:
    a, b, c, d = first
    w, x, y, z = second
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _opposite(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    return w, -x, -y, -z


def _rotate(quaternion: Quaternion, vector: Sequence[float]) -> Vector:
    x, y, z = vector
    _, *rotated = _product(_product(quaternion, (0.0, x, y, z)), _opposite(quaternion))
    return rotated[0], rotated[1], rotated[2]
