"""Smooth return of a scripted policy to its motion after the arms were stopped.

On two controllers an action may miss its deadline. Both arms then stop, while the reference moves on. A command
straight back to the reference would jump, and the adapter would follow it with a large error. `Recovery` leads back
smoothly.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.types import Array, Mask, Rows

OFF_RAD: Final = 0.002
"""Difference between the command in force and the one given that shows a stop, or a limit that held the arms back."""

_OBEYED_RAD: Final = 1e-5
"""Rounding of an action to float32 is below this. From rest, a jump of 0.3 mrad is too much for one period."""

_REST_RAD_S: Final = 0.05  # a joint at rest is measured below this speed
_RATIO: Final = 1 / 3  # of the limits, for distance and speed each; the wanted motion needs the rest
_LEAST_S: Final = 0.48  # the adapter cannot follow the jerk of a shorter one while it compensates the lag
_LEAST_PERIODS: Final = 5.0  # as smooth as a few commands can be
# Peak speed and acceleration of a return in one second, over a distance of one; and from an initial speed of one.
_PEAK_SPEED = 1.875
_PEAK_ACCELERATION, _PEAK_ACCELERATION_OF_SPEED = 5.774, 4.0


class Recovery:
    """Offset that leads from where the arms stopped to the wanted positions, and vanishes there.

    All joints take the same time, so that two arms that hold one object return together.

    Args:
        limits: Of the arms.
        period_s: Time between two commands.
    """

    def __init__(self, limits: MotionLimits, period_s: float) -> None:
        self._period_s = period_s
        self._speed = np.tile(limits.speed_rad_s, 2) * _RATIO
        self._acceleration = limits.acceleration_rad_s2 * _RATIO
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next call may have any number of rows."""
        self._wanted: Array | None = None  # (3, n, 12), the newest last
        self._given: Array | None = None

    def active(self, commanded: Array) -> Mask:
        """Return the rows, (n,), whose command in force differs from the one given, or which are returning.

        Args:
            commanded: (n, 12) command in force.
        """
        differs: Mask = self._difference(commanded) > OFF_RAD
        return differs if self._wanted is None else differs | (self._left_s > 0.0)

    def _difference(self, commanded: Array) -> Array:
        if self._given is None:
            return np.zeros(len(commanded))
        result: Array = np.abs(commanded - self._given).max(axis=1)
        return result

    def forget(self, rows: Mask | Rows, commanded: Array) -> None:
        """Begin anew in some rows, at the command in force, (n, 12)."""
        if self._wanted is not None and self._given is not None:
            self._wanted[:, rows] = np.nan
            self._given[rows] = commanded[rows]
            self._left_s[rows] = 0.0

    def __call__(self, wanted: Array, commanded: Array, speed: Array) -> Array:
        """Return the command, (n, 12).

        Args:
            wanted: (n, 12) command for arms that follow.
            commanded: (n, 12) command in force.
            speed: (n, 12) measured joint speeds.
        """
        if self._wanted is None:
            self._wanted = np.full((3, *wanted.shape), np.nan)
            self._coefficients = np.zeros((3, *wanted.shape))
            self._left_s, self._duration_s = np.zeros(len(wanted)), np.ones(len(wanted))
        stopped = (self._difference(commanded) > _OBEYED_RAD) & (np.abs(speed).max(axis=1) < _REST_RAD_S)
        self._wanted = np.concatenate([self._wanted[1:], wanted[None]])
        if stopped.any():
            self._plan(stopped, self._wanted, commanded)
        self._left_s = np.maximum(self._left_s - self._period_s, 0.0)
        left = (self._left_s / self._duration_s)[:, None]
        gone = 1.0 - left
        offset = self._coefficients
        self._given = wanted + left**3 * (offset[0] + gone * (offset[1] + gone * offset[2]))
        return self._given

    def _plan(self, rows: Mask, wanted: Array, commanded: Array) -> None:
        """Plan a quintic from rest at `commanded` to the wanted motion at the time of the last command."""
        before, at, after = wanted[:, rows]
        before = np.where(np.isnan(before), 2 * at - after, before)  # after a reset: linear
        distance = commanded[rows] - at
        speed = -(after - before) / (2 * self._period_s)
        acceleration = -(after - 2 * at + before) / self._period_s**2
        distances, speeds = np.abs(distance), np.abs(speed)
        duration = np.maximum(
            (_PEAK_SPEED * distances / self._speed).max(axis=1),
            np.maximum(
                np.sqrt(_PEAK_ACCELERATION * distances.max(axis=1) / self._acceleration),
                _PEAK_ACCELERATION_OF_SPEED * speeds.max(axis=1) / self._acceleration,
            ),
        )
        duration = np.maximum(duration, max(_LEAST_S, _LEAST_PERIODS * self._period_s))
        self._left_s[rows] = self._duration_s[rows] = duration
        second = speed * duration[:, None]
        self._coefficients[0][rows] = distance
        self._coefficients[1][rows] = second + 3 * distance
        self._coefficients[2][rows] = acceleration * duration[:, None] ** 2 / 2 + 3 * second + 6 * distance
