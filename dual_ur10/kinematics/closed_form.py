"""The eight configurations of one arm for a flange pose, in closed form.

Branches are named by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.kernel import Constants, call
from dual_ur10.kinematics.forward import lengths_m
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.types import Array, Mask

EDGE: Final = 1e-7
"""Tolerance, in the cosine of theta3, for a stretched arm's pose that rounding puts outside the workspace; 1e-7 m."""


class Branches(NamedTuple):
    """All branches of n poses, before any check of reach."""

    q: Array  # (n, 8, 6), not wrapped; meaningless where out of reach
    wrist_offset_m2: Array  # (n,) square of the wrist centre's distance from the base axis, less that of d4
    elbow_cosine: Array  # (n, 8) cosine of theta3; beyond ±1 where the wrist is out of reach


@lru_cache(maxsize=32)
def coefficients(dh: DHParameters) -> Constants:
    """Return the arm as the kernel takes it: lengths, twists ignored, theta offsets, and the tolerance at the edge."""
    return Constants(np.concatenate([lengths_m(dh), dh.theta_rad, [EDGE]]))


def pose_block(position: Array, rotation: Array, reference: Array, size: int) -> Array:
    """Return rows of the kernel's input and output, (n, size), of poses (n, 3), (n, 3, 3) and references (n, 6)."""
    n = len(position)
    block: Array = np.empty((n, size))
    block[:, :3], block[:, 3:12], block[:, 12:18] = position, rotation.reshape(n, 9), reference
    return block


def closed_form(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> Branches:
    """Solve an arm whose axes are exactly parallel and perpendicular, with the lengths of ``dh``.

    Args:
        position: (n, 3).
        rotation: (n, 3, 3).
        dh: Lengths and theta offsets; twists, and lengths that are zero on a nominal arm, are ignored.
        reference: (n, 6) angles from which a free theta6 is taken if the pose stays in reach; None: zero.
    """
    block = pose_block(position, rotation, -np.asarray(dh.theta_rad) if reference is None else reference, 75)
    call("inverse_branches", coefficients(dh), block, len(block))
    return Branches(block[:, 18:66].reshape(-1, 8, 6), block[:, 74], block[:, 66:74])


def within(branches: Branches, edge: float) -> Mask:
    """(n, 8): which branches reach their pose, give or take ``edge``."""
    reached: Mask = np.abs(branches.elbow_cosine) <= 1.0 + edge
    reached &= (branches.wrist_offset_m2 >= -edge)[:, None]
    return reached
