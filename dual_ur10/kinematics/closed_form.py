"""The eight configurations of one UR10 for a flange pose, in closed form.

Branches are named by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.kinematics.ur10 import NOMINAL_DH, DHParameters
from dual_ur10.types import Array, Mask, constant

_TINY: Final = 1e-300

# Below this sine of theta5 the axes of wrists 1 and 3 are one line, and theta6 is free: it moves the flange by less.
_WRIST_SINGULAR: Final = 1e-8
# Up to this sine, rounding of the pose blurs theta6 enough to matter to a stretched arm.
_WRIST_BLURRED: Final = 1e-3
_BLUR_RAD: Final = 1e-11

EDGE: Final = 1e-7
"""Tolerance, in the cosine of theta3, for a stretched arm's pose that rounding puts outside the workspace; 1e-7 m."""

# Signs of the 8 branches, as columns against the poses.
_SHOULDER: Final = constant([[1], [-1], [1], [-1], [1], [-1], [1], [-1]])
_WRIST: Final = constant([[1], [1], [-1], [-1], [1], [1], [-1], [-1]])
_ELBOW: Final = constant([[1], [1], [1], [1], [-1], [-1], [-1], [-1]])


class Branches(NamedTuple):
    """All branches of n poses, before any check of reach."""

    q: Array  # (n, 8, 6), not wrapped; meaningless where out of reach
    wrist_offset_m2: Array  # (n,) square of the wrist centre's distance from the base axis, less that of d4
    elbow_cosine: Array  # (n, 8) cosine of theta3; beyond ±1 where the wrist is out of reach


def closed_form(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> Branches:
    """Solve an arm whose axes are exactly parallel and perpendicular, with the lengths of ``dh``.

    Arrays have the shape (8, n), the poses last. Every angle comes from an arc tangent of its sine and cosine, and each
    later one compensates the rounding of the previous ones, so that the pose is exact to rounding also at
    singularities.

    Args:
        position: (n, 3).
        rotation: (n, 3, 3).
        dh: Lengths and theta offsets; twists, and lengths that are zero on a nominal arm, are ignored.
        reference: (n, 6) angles from which a free theta6 is taken if the pose stays in reach; None: zero.
    """
    a2, a3 = dh.a_m[1], dh.a_m[2]
    d1, d4, d5, d6 = dh.d_m[0], dh.d_m[1] + dh.d_m[2] + dh.d_m[3], dh.d_m[4], dh.d_m[5]
    px, py, pz = (position - d6 * rotation[:, :, 2]).T  # wrist centre
    rows = np.ascontiguousarray(rotation.transpose(1, 2, 0))[:, :, None]  # [i, j]: base axis i along flange axis j

    # Theta1 puts the wrist centre at d4 beside the arm's plane; along the plane it is then at `along`.
    radius2 = px * px + py * py
    offset2 = radius2 - d4 * d4
    along = _SHOULDER * np.sqrt(np.maximum(offset2, 0.0))
    scale = 1.0 / np.maximum(radius2, _TINY)
    sin1, cos1 = (along * py + d4 * px) * scale, (along * px - d4 * py) * scale

    # Theta5 and theta6 from the normal of the arm's plane, seen from the flange.
    normal_x, normal_y, cos5 = rows[0] * sin1 - rows[1] * cos1
    sin5 = np.sqrt(normal_x * normal_x + normal_y * normal_y)
    scale = _WRIST / np.maximum(sin5, _TINY)
    cos6, sin6 = normal_x * scale, -normal_y * scale
    if sin5.min(initial=1.0) < _WRIST_BLURRED:
        theta6 = np.zeros(len(position)) if reference is None else reference[:, 5] + dh.theta_rad[5]
        cos_ref, sin_ref = _WRIST * np.cos(theta6), _WRIST * np.sin(theta6)
        # Take the reference's theta6 wherever that rotates the flange by hardly more than rounding does.
        blurred = np.abs(normal_x * sin_ref + normal_y * cos_ref) < _BLUR_RAD
        free = (sin5 < _WRIST_SINGULAR) | (blurred & (cos6 * cos_ref + sin6 * sin_ref > 0.0))
        cos6, sin6 = np.where(free, cos_ref, cos6), np.where(free, sin_ref, sin6)
        # Where that asks too much of a stretched arm, let wrist 2's axis point from the shoulder to the wrist centre,
        # which spares it most.
        height = pz - d1
        length = np.sqrt(along * along + height * height)
        axis_x, axis_y, axis_z = rows[:, 0] * sin6 + rows[:, 1] * cos6
        gain = -d5 * ((axis_x * cos1 + axis_y * sin1) * along + axis_z * height)
        far = length * length + d5 * d5 - 2 * gain > (a2 + a3) ** 2 * (1 + 0.1 * EDGE)
        outward = (np.stack((cos1 * along, sin1 * along, height + 0 * along)) / np.maximum(length, _TINY))[:, None]
        sin_out, cos_out = -(rows[:, :2] * outward).sum(0)
        far &= sin5 < _WRIST_SINGULAR
        cos6, sin6 = np.where(far, cos_out, cos6), np.where(far, sin_out, sin6)

    # Wrist 2's axis lies in the arm's plane, a quarter turn behind theta2 + theta3 + theta4.
    axis_x, axis_y, cos234 = rows[:, 0] * sin6 + rows[:, 1] * cos6
    sin234 = -(axis_x * cos1 + axis_y * sin1)

    # A triangle of upper arm and forearm remains.
    x, y = along - d5 * sin234, (pz - d1) + d5 * cos234
    cos3 = (x * x + y * y - (a2 * a2 + a3 * a3)) * (0.5 / (a2 * a3))
    sin3 = _ELBOW * np.sqrt(np.maximum(1.0 - cos3 * cos3, 0.0))
    near, beside = a2 + a3 * cos3, a3 * sin3

    out = np.empty((6, 8, len(position)))
    out[0] = np.arctan2(sin1, cos1)
    out[1] = theta2 = np.arctan2(y * near - x * beside, x * near + y * beside)
    out[2] = theta3 = np.arctan2(sin3, cos3)
    out[3] = np.arctan2(sin234, cos234) - theta2 - theta3
    out[4] = np.arctan2(_WRIST * sin5, cos5)
    out[5] = np.arctan2(sin6, cos6)
    if dh is not NOMINAL_DH:
        out -= np.reshape(dh.theta_rad, (6, 1, 1))
    return Branches(out.T, offset2, cos3.T)


def within(branches: Branches, edge: float) -> Mask:
    """(n, 8): which branches reach their pose, give or take ``edge``."""
    reached: Mask = np.abs(branches.elbow_cosine) <= 1.0 + edge
    reached &= (branches.wrist_offset_m2 >= -edge)[:, None]
    return reached
