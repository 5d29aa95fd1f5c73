"""How a scripted policy takes arms that were brought to rest back to the motion that it wants.

On two controllers an action may come too late. Both arms then rest, while what they should follow goes on. A command
that leads straight back would be a jump, and the adapter would follow it late and far beside; this leads back smoothly.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array, Mask, Rows

OFF_RAD: Final = 0.002
"""A command in force that is so far from the one given was not obeyed: the arms rested, or a limit held them."""

_OBEYED_RAD: Final = 1e-5
"""What float32 makes of an action is less. From rest, a jump of a third of a milliradian is too much for a period."""

_REST_RAD_S: Final = 0.05  # a joint below this speed, measured, rests
_SHARE: Final = 1 / 3  # of the limits, for the distance and for the speed each; the wanted motion needs the rest
_LEAST_S: Final = 0.32  # less has more jerk than the adapter can follow while it compensates the lag
_LEAST_PERIODS: Final = 5.0  # as smooth as a few commands can show
# Greatest speed and acceleration on the way back in one second, for a distance of one; for a speed of one at its start.
_SPEED_OF_WAY = 1.875
_ACCELERATION_OF_WAY, _ACCELERATION_OF_SPEED = 5.774, 4.0


class Rejoin:
    """Adds to wanted positions what is left of the distance from where the arms rested.

    All joints take the same time for it, so that two arms which hold one object go back together.

    Args:
        limits: Of the arms.
        period_s: Between two commands.
    """

    def __init__(self, limits: MotionLimits, period_s: float) -> None:
        self._period_s = period_s
        self._speed = np.tile(limits.speed_rad_s, 2) * _SHARE
        self._acceleration = limits.acceleration_rad_s2 * _SHARE
        self.reset()

    def reset(self) -> None:
        """Begin anew, with any number of rows."""
        self._wanted: Array | None = None  # (3, n, 12), the newest last
        self._given: Array | None = None

    def off(self, commanded: Array) -> Mask:
        """(n,) rows that do not do what is wanted: not what they were given, or they are on the way back.

        Args:
            commanded: (n, 12) the command in force.
        """
        off: Mask = self._apart(commanded) > OFF_RAD
        return off if self._wanted is None else off | (self._left_s > 0.0)

    def _apart(self, commanded: Array) -> Array:
        apart: Array = np.zeros(len(commanded)) if self._given is None else np.abs(commanded - self._given).max(axis=1)
        return apart

    def forget(self, rows: Mask | Rows, commanded: Array) -> None:
        """These rows begin anew, where they are commanded to be, (n, 12)."""
        if self._wanted is not None and self._given is not None:
            self._wanted[:, rows] = np.nan
            self._given[rows] = commanded[rows]
            self._left_s[rows] = 0.0

    def __call__(self, wanted: Array, commanded: Array, speed: Array) -> Array:
        """What to command, (n, 12).

        Args:
            wanted: (n, 12) what would be commanded, did the arms do what they are told.
            commanded: (n, 12) the command in force.
            speed: (n, 12) measured.
        """
        if self._wanted is None:
            self._wanted = np.full((3, *wanted.shape), np.nan)
            self._way = np.zeros((3, *wanted.shape))
            self._left_s, self._duration_s = np.zeros(len(wanted)), np.ones(len(wanted))
        resting = (self._apart(commanded) > _OBEYED_RAD) & (np.abs(speed).max(axis=1) < _REST_RAD_S)
        self._wanted = np.concatenate([self._wanted[1:], wanted[None]])
        if resting.any():
            self._plan(resting, self._wanted, commanded)
        self._left_s = np.maximum(self._left_s - self._period_s, 0.0)
        left = (self._left_s / self._duration_s)[:, None]
        gone = 1.0 - left
        self._given = wanted + left**3 * (self._way[0] + gone * (self._way[1] + gone * self._way[2]))
        return self._given

    def _plan(self, rows: Mask, wanted: Array, commanded: Array) -> None:
        """From rest at `commanded` to the wanted motion: a quintic, with what is wanted at the last command's time."""
        before, at, after = wanted[:, rows]
        before = np.where(np.isnan(before), 2 * at - after, before)  # it has only just begun: straight on
        distance = commanded[rows] - at
        speed = -(after - before) / (2 * self._period_s)
        acceleration = -(after - 2 * at + before) / self._period_s**2
        way, rate = np.abs(distance), np.abs(speed)
        duration = np.maximum(
            (_SPEED_OF_WAY * way / self._speed).max(axis=1),
            np.maximum(
                np.sqrt(_ACCELERATION_OF_WAY * way.max(axis=1) / self._acceleration),
                _ACCELERATION_OF_SPEED * rate.max(axis=1) / self._acceleration,
            ),
        )
        duration = np.maximum(duration, max(_LEAST_S, _LEAST_PERIODS * self._period_s))
        self._left_s[rows] = self._duration_s[rows] = duration
        second = speed * duration[:, None]
        self._way[0][rows] = distance
        self._way[1][rows] = second + 3 * distance
        self._way[2][rows] = acceleration * duration[:, None] ** 2 / 2 + 3 * second + 6 * distance
