"""The trapezoidal speed profile of a move from rest to rest."""

from __future__ import annotations

import math
from typing import Final

TIME_EPSILON_S: Final = 1e-9
"""Times nearer than this are the same: what is left by adding up ticks."""

_NO_WAY: Final = 1e-12
"""Distances below this are none."""

_TINY: Final = 1e-100

_RAMP_SHARE: Final = 1 / 3
"""Share of each ramp in a move whose time is given; UR publishes no figure."""


class Trapezoid:
    """Accelerate, go on, decelerate at the same rate.

    Args:
        distance: How far, of whatever leads the move; zero takes no time.
        speed: Greatest speed.
        acceleration: Of both ramps.

    Attributes:
        duration: s.
        ramp: Time of each ramp, s.
    """

    def __init__(self, distance: float, speed: float, acceleration: float) -> None:
        self.duration = self.ramp = 0.0
        self._speed = self._acceleration = 0.0  # of the share, 1/s and 1/s²
        if distance > _NO_WAY:
            speed, acceleration = max(speed, _TINY), max(acceleration, _TINY)
            # Too short a way to reach the speed makes it a triangle.
            peak = min(speed, math.sqrt(acceleration * distance))
            self.ramp = peak / acceleration
            self.duration = distance / peak + self.ramp
            self._speed, self._acceleration = peak / distance, acceleration / distance

    @classmethod
    def timed(cls, distance: float, time: float, speed: float, acceleration: float) -> Trapezoid:
        """The profile of a move that takes `time`, or longer where `speed` and `acceleration` do not allow that."""
        if distance <= _NO_WAY:
            still = cls(0.0, speed, acceleration)
            still.duration = time
            return still
        peak = distance / (time * (1 - _RAMP_SHARE))
        ramp = time * _RAMP_SHARE
        if peak > speed:
            peak, ramp = speed, max(time - distance / speed, speed / acceleration)
        if peak > acceleration * ramp:
            # Ramps as long as it takes: the lower speed that solves distance = peak (time - peak / acceleration).
            root = time * time - 4 * distance / acceleration
            peak = min(speed, acceleration * (time - math.sqrt(root)) / 2) if root > 0.0 else speed
            ramp = peak / acceleration
        return cls(distance, peak, peak / ramp)

    def share(self, t: float) -> float:
        """Share of the way that is behind after `t`, 0 to 1."""
        left = self.duration - t
        if left <= TIME_EPSILON_S:
            return 1.0
        if t <= 0.0:
            return 0.0
        if t < self.ramp:
            return 0.5 * self._acceleration * t * t
        if left < self.ramp:
            return 1.0 - 0.5 * self._acceleration * left * left
        return self._speed * (t - 0.5 * self.ramp)

    def slope(self, t: float) -> float:
        """Share of the way per second at `t`."""
        left = self.duration - t
        if left <= TIME_EPSILON_S or t <= 0.0:
            return 0.0
        return min(self._speed, self._acceleration * min(t, left))

    def decelerates(self, t: float) -> bool:
        """Whether the move slows down at `t` to stop."""
        return self.duration - t <= self.ramp + TIME_EPSILON_S
