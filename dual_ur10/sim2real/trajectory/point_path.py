"""Path of both arms as points with speeds, few enough for a slow link, and the cubics between them.

A controller that interpolates the points follows exactly these cubics. They are what the safety gate checks, target by
target, before anything is sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.control.gate import Distances, SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

_REST_RAD_S: Final = 1e-3  # what the gate counts as rest


@dataclass(frozen=True, eq=False)
class PointPath:
    """Points of both arms at equal intervals, from rest to rest.

    Attributes:
        interval_s: Time between two points; any, as the cubics have values at every time.
        q_rad: (m, 2, 6) targets.
        qd_rad_s: (m, 2, 6) their speeds; 0 at both ends.
    """

    interval_s: float
    q_rad: Array
    qd_rad_s: Array

    @classmethod
    def of_targets(cls, targets_rad: Array, tick_s: float, interval_s: float) -> PointPath:
        """Take points of the targets of a path, with their speeds. The last target is held to the last point.

        Args:
            targets_rad: (n, 2, 6) targets, from rest to rest.
            tick_s: Time between two of them in real time: the control period, divided by the cell's speed factor.
            interval_s: Time between two points, at least a control period.

        Raises:
            TrajectoryError: The targets are not finite numbers of this shape, or do not begin and end at rest.
        """
        targets: Array = np.asarray(targets_rad, dtype=np.float64)
        if targets.ndim != 3 or targets.shape[1:] != (2, 6) or len(targets) < 2 or not np.isfinite(targets).all():
            raise TrajectoryError(
                f"targets have shape {targets.shape}: they must be (n, 2, 6), n at least 2, and finite"
            )
        if not tick_s <= interval_s:
            raise TrajectoryError(f"interval_s is {interval_s!r}: it must be a control period, {tick_s:g} s, or more")
        for name, step in (("first", targets[1] - targets[0]), ("last", targets[-1] - targets[-2])):
            speed = np.abs(step) / tick_s
            if speed.max() > _REST_RAD_S:
                arm, joint = np.unravel_index(speed.argmax(), speed.shape)
                raise TrajectoryError(
                    f"{ARMS[arm]}/{JOINTS[joint]} moves at {speed.max():.4f} rad/s at the {name} target: a path begins "
                    "and ends at rest"
                )
        # Fourth-order central differences, of a path that rests before and after.
        wide = np.concatenate([targets[:1], targets[:1], targets, targets[-1:], targets[-1:]])
        speeds = (8 * (wide[3:-1] - wide[1:-3]) - (wide[4:] - wide[:-4])) / (12 * tick_s)
        count = math.ceil((len(targets) - 1) * tick_s / interval_s - 1e-9)
        times: Array = interval_s * np.arange(count + 1, dtype=np.float64)
        q, qd = _cubics(targets, speeds, tick_s, times)
        qd[0] = qd[-1] = 0.0
        return cls(interval_s, q, qd)

    @property
    def duration_s(self) -> float:
        """Time of the last point."""
        return (len(self.q_rad) - 1) * self.interval_s

    def targets(self, tick_s: float) -> Array:
        """Return the cubics at every control period until the end has been reached, (n, 2, 6)."""
        return _cubics(self.q_rad, self.qd_rad_s, self.interval_s, self._ticks(tick_s))[0]

    def stops(self, tick_s: float) -> Array:
        """Return targets, (n, 2, 6), of a motion along lines that rests at each point, as `movej` makes.

        UR does not publish the profile of `movej`. This one, of the fifth order, has its peak speed between those of
        the constant and of the triangular one.
        """
        interval, s = _parts(self.interval_s, self._ticks(tick_s), len(self.q_rad))
        smooth = s**3 * (10 + s * (6 * s - 15))
        found: Array = self.q_rad[interval] + smooth * (self.q_rad[interval + 1] - self.q_rad[interval])
        return found

    def deviation_rad(self, targets_rad: Array, tick_s: float) -> float:
        """Return the largest difference of the cubics from the targets that the points were taken from."""
        own = self.targets(tick_s)[: len(targets_rad)]
        return float(np.abs(own - targets_rad[: len(own)]).max())

    def _ticks(self, tick_s: float) -> Array:
        times: Array = tick_s * np.arange(1 + math.ceil(self.duration_s / tick_s - 1e-9), dtype=np.float64)
        return times


def _parts(interval_s: float, time_s: Array, points: int) -> tuple[NDArray[np.intp], Array]:
    """Return the interval of each time, and the part of it that has passed, (n, 1, 1)."""
    interval = np.clip((time_s / interval_s + 1e-9).astype(np.intp), 0, points - 2)
    s: Array = np.clip(time_s / interval_s - interval, 0.0, 1.0).reshape(-1, 1, 1)
    return interval, s


def _cubics(q: Array, qd: Array, interval_s: float, time_s: Array) -> tuple[Array, Array]:
    """Return positions and speeds of the cubics through equidistant points at times; after the last, those there."""
    interval, s = _parts(interval_s, time_s, len(q))
    a, b, u, v = q[interval], q[interval + 1], qd[interval] * interval_s, qd[interval + 1] * interval_s
    near, far = 1 + s * s * (2 * s - 3), s * s * (3 - 2 * s)
    position: Array = near * a + s * (1 - s) ** 2 * u + far * b + s * s * (s - 1) * v
    speed: Array = (6 * s * (1 - s) * (b - a) + (1 - s) * (1 - 3 * s) * u + s * (3 * s - 2) * v) / interval_s
    return position, speed


def check_targets(targets_rad: Array, limits: MotionLimits, tick_s: float, ticks: int, clearance: Distances) -> None:
    """Pass the targets of a whole path through a safety gate, before anything is sent.

    Args:
        targets_rad: (n, 2, 6) targets; the first is where the arms rest, the last is held.
        limits: Limits of motion.
        tick_s: Control period.
        ticks: Targets per check of the distances.
        clearance: Computes distances.

    Raises:
        TrajectoryError: The gate refuses a target.
    """
    gate = SafetyGate(limits, tick_s, ticks, clearance)
    gate.reset(targets_rad[None, 0])
    held = np.concatenate([targets_rad, np.repeat(targets_rad[-1:], -(len(targets_rad) - 1) % ticks, axis=0)])
    for first in range(1, len(held), ticks):
        window: Array = np.ascontiguousarray(held[None, first : first + ticks])
        found = gate(window)
        if found.verdicts or not np.array_equal(found.targets_rad, window):
            at_s = (first - 1) * tick_s
            raise TrajectoryError(
                f"the path is refused at {at_s:.2f} s: {found.verdicts.get(0, 'the gate changed a target')}. "
                "Change it, or slow it down"
            )
