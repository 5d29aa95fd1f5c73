"""The eight configurations of one UR10 for a flange pose, in closed form.

Branches are named by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.kernel import call
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.types import Array, Mask, constant

EDGE: Final = 1e-7
"""Tolerance, in the cosine of theta3, for a stretched arm's pose that rounding puts outside the workspace; 1e-7 m."""

_EDGE: Final = constant([EDGE])


class Branches(NamedTuple):
    """All branches of n poses, before any check of reach."""

    q: Array  # (n, 8, 6), not wrapped; meaningless where out of reach
    wrist_offset_m2: Array  # (n,) square of the wrist centre's distance from the base axis, less that of d4
    elbow_cosine: Array  # (n, 8) cosine of theta3; beyond ±1 where the wrist is out of reach


@lru_cache(maxsize=32)
def _coefficients(dh: DHParameters) -> tuple[Array, Array]:
    """Return d1, a2, a3, d4, d5, d6 of the arm, twists ignored, and its theta offsets."""
    a, d = dh.a_m, dh.d_m
    return np.array([d[0], a[1], a[2], d[1] + d[2] + d[3], d[4], d[5]]), np.array(dh.theta_rad, dtype=np.float64)


def closed_form(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> Branches:
    """Solve an arm whose axes are exactly parallel and perpendicular, with the lengths of ``dh``.

    Args:
        position: (n, 3).
        rotation: (n, 3, 3).
        dh: Lengths and theta offsets; twists, and lengths that are zero on a nominal arm, are ignored.
        reference: (n, 6) angles from which a free theta6 is taken if the pose stays in reach; None: zero.
    """
    lengths, theta = _coefficients(dh)
    n = len(position)
    if reference is None:
        reference = np.broadcast_to(-theta, (n, 6))
    given = [np.ascontiguousarray(each) for each in (position, rotation, reference)]
    found = Branches(np.empty((n, 8, 6)), np.empty(n), np.empty((n, 8)))
    call("inverse_branches", lengths, theta, *given, *found, _EDGE, n)
    return found


def within(branches: Branches, edge: float) -> Mask:
    """(n, 8): which branches reach their pose, give or take ``edge``."""
    reached: Mask = np.abs(branches.elbow_cosine) <= 1.0 + edge
    reached &= (branches.wrist_offset_m2 >= -edge)[:, None]
    return reached
