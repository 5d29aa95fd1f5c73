"""Directions in which observations determine the right base least, in words."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ur_core.types import Array

LEVER_M: Final = 1.0
"""Distance from the right base at which rotations are compared with shifts: grips of a carried bar are about there."""

_MOSTLY: Final = 0.2  # rad times the lever per m, below which a motion is called a shift

SCALES: Final = np.array([1.0, 1.0, 1.0, 1 / LEVER_M, 1 / LEVER_M, 1 / LEVER_M])
"""(6,) Units of shifts and rotations in which `LEVER_M` makes them comparable."""


class Direction(NamedTuple):
    """Motion of the right base that the observations determine least.

    Attributes:
        sigma_m: Standard deviation along it, at `LEVER_M`.
        motion: (6,) shift of the base in m and rotation in rad, of unit length with the lever.
        text: The same in words.
    """

    sigma_m: float
    motion: Array
    text: str


def weakest(information: Array, base: Array) -> Direction:
    """Return the weakest direction of an information matrix.

    Args:
        information: (6, 6) of shift (m) and rotation (rad) of the right base.
        base: (4, 4) pose of the right base in the left one.
    """
    values, vectors = np.linalg.eigh(information * SCALES[:, None] * SCALES)
    motion = vectors[:, 0] * SCALES
    sigma = float(1 / np.sqrt(max(values[0], 1e-30)))
    return Direction(sigma, motion, _text(motion, base))


def _text(motion: Array, base: Array) -> str:
    shift, rotation = motion[:3], motion[3:]
    angle = float(np.linalg.norm(rotation))
    if angle * LEVER_M < _MOSTLY * float(np.linalg.norm(shift)):
        return f"a shift along {_numbers(_signed(shift / np.linalg.norm(shift)), 2)}"
    # The axis of a screw motion: where the speed is parallel to the rotation.
    speed = shift - np.cross(rotation, base[:3, 3])
    axis, point = rotation / angle, np.cross(rotation, speed) / angle**2
    return f"a rotation about the line through {_numbers(point, 2)} m along {_numbers(_signed(axis), 2)}"


def _signed(axis: Array) -> Array:
    """Return an axis whose largest component is positive."""
    result: Array = axis * np.sign(axis[np.abs(axis).argmax()])
    return result


def _numbers(values: Array, digits: int) -> str:
    return f"({', '.join(f'{each + 0.0:.{digits}f}' for each in np.round(values, digits))})"
