"""Geometric paths of the TCP between two poses, parametrised by the fraction covered."""

from __future__ import annotations

import math
from typing import Final, Protocol

import numpy as np

from ur_core.errors import MotionError
from ur_core.kinematics.rotations import cross
from ur_core.types import Array
from ur_emulator.motion.tool_kinematics import Frame, rotvec_of

_STRAIGHT: Final = 1e-6  # sine of the angle at the start below which three points are on a line


class Path(Protocol):
    """Geometric path.

    Attributes:
        end: Final pose.
        length_m: Length of the TCP's path.
        angle_rad: Angle of the tool's rotation.
    """

    end: Frame
    length_m: float
    angle_rad: float

    def at(self, fractions: Array) -> Frame:
        """Return poses (n) at fractions (n,) of the path."""


class _Rotation:
    """Even rotation from one orientation to another about one axis, by the shorter angle."""

    def __init__(self, start: Array, end: Array) -> None:
        rotvec = np.array(rotvec_of(end @ start.T))
        self.angle_rad = float(np.linalg.norm(rotvec))
        x, y, z = (rotvec / self.angle_rad).tolist() if self.angle_rad > 0.0 else (0.0, 0.0, 0.0)
        axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        # Rodrigues' formula.
        self._start, self._sine = start, axis @ start
        self._versine = axis @ self._sine

    def at(self, fractions: Array) -> Array:
        angle = (self.angle_rad * fractions)[:, None, None]
        half = np.sin(0.5 * angle)
        rotation: Array = self._start + np.sin(angle) * self._sine + (2 * half * half) * self._versine
        return rotation


class Line:
    """Straight line with an even rotation of the tool.

    Args:
        start: Pose at fraction 0.
        end: Pose at fraction 1.
    """

    def __init__(self, start: Frame, end: Frame) -> None:
        self.end = end
        self._start, self._displacement = start.position, end.position - start.position
        self._rotation = _Rotation(start.rotation, end.rotation)
        self.length_m, self.angle_rad = float(np.linalg.norm(self._displacement)), self._rotation.angle_rad

    def at(self, fractions: Array) -> Frame:
        """Return poses (n) at fractions (n,) of the path."""
        return Frame(self._start + np.multiply.outer(fractions, self._displacement), self._rotation.at(fractions))


class Arc:
    """Circular arc with an even rotation of the tool.

    Args:
        start: Pose at fraction 0.
        centre: (3,).
        second: (3,) unit vector in the circle's plane, along the arc at its start.
        sweep_rad: Angle of the arc.
        end: Pose at fraction 1.
    """

    def __init__(self, start: Frame, centre: Array, second: Array, sweep_rad: float, end: Frame) -> None:
        self.end = end
        self._centre, self._first, self._sweep = centre, start.position - centre, sweep_rad
        radius = float(np.linalg.norm(self._first))
        self._second = radius * second
        self._rotation = _Rotation(start.rotation, end.rotation)
        self.length_m, self.angle_rad = radius * sweep_rad, self._rotation.angle_rad

    def at(self, fractions: Array) -> Frame:
        """Return poses (n) at fractions (n,) of the path."""
        angle = (self._sweep * fractions)[:, None]
        position = self._centre + np.cos(angle) * self._first + np.sin(angle) * self._second
        return Frame(position, self._rotation.at(fractions))


def through(start: Frame, via: Array, end: Frame) -> Path:
    """Return the arc through a point (3,), or the line if the point is on it.

    Raises:
        MotionError: No circle passes through the three points in this order.
    """
    towards, whole = via - start.position, end.position - start.position
    normal = cross(towards, whole)
    size = float(np.linalg.norm(normal))
    square, square_whole = float(towards @ towards), float(whole @ whole)
    if size <= _STRAIGHT * math.sqrt(square * square_whole):
        along = float(towards @ whole)
        if -1e-12 <= along <= square_whole + 1e-12:
            return Line(start, end)
        raise MotionError(
            f"no circle goes from {start.position.tolist()} through {via.tolist()} to {end.position.tolist()}: the "
            "points are on a line, and the via point is not between the others"
        )
    out = cross(square * whole - square_whole * towards, normal) / (2 * size * size)  # from the start to the centre
    first = -out / np.linalg.norm(out)
    second = cross(normal / size, first)
    centre = start.position + out
    last = end.position - centre
    sweep = math.atan2(float(last @ second), float(last @ first)) % math.tau
    return Arc(start, centre, second, sweep, end)
