"""Stop ramp: targets that bring one arm to rest from its last two targets."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.types import Array

STOP_RAD_S2: Final = 4.0
STOP_RAD_S3: Final = 200.0
"""Deceleration and jerk of a stop: from 0.5 rad/s to rest in 0.15 s. The deceleration is that of `stopj` in Universal
Robots' own client library."""


class StopRamp:
    """Jerk-limited ramp to rest along the current direction of motion, all joints together.

    Args:
        last_rad: (2, 6) last two targets sent.
        tick_s: Time between two targets.
    """

    def __init__(self, last_rad: Array, tick_s: float) -> None:
        self._q: Array = last_rad[-1].copy()
        self._direction: Array = (last_rad[-1] - last_rad[-2]) / tick_s
        self._tick_s = tick_s
        self._speed = float(np.abs(self._direction).max())
        if self._speed > 0.0:
            self._direction /= self._speed
        self._deceleration = 0.0

    @property
    def at_rest(self) -> bool:
        """True once the last returned target is at rest."""
        return self._speed <= 0.0

    def __call__(self) -> Array:
        """Return the next target, (6,)."""
        if not self.at_rest:
            step = STOP_RAD_S3 * self._tick_s
            # Towards the end the deceleration fades, so that the arm stops smoothly.
            fading = (2.0 * STOP_RAD_S3 * self._speed) ** 0.5
            self._deceleration = min(self._deceleration + step, STOP_RAD_S2, max(fading, step))
            before = self._speed
            self._speed = max(0.0, before - self._deceleration * self._tick_s)
            self._q = self._q + self._direction * (self._speed * self._tick_s)
        return self._q.copy()
