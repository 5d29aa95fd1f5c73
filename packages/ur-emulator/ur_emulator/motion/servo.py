"""Trajectory of `servoj`: the servoj law with the latest target held."""

from __future__ import annotations

from typing import Final

import numpy as np

from ur_core.servoj import ServojLaw
from ur_core.types import Array
from ur_emulator.motion.trajectories import Trajectory

_MAX_KEPT: Final = 256  # discretisations; a ramp of the time scaling needs one per tick
_AT_TARGET: Final = 1e-12  # rad and rad/s

_known: dict[tuple[float, float, float, int], tuple[Array, Array]] = {}


def _discretised(lookahead_s: float, gain: float, step: float, steps: int) -> tuple[Array, Array]:
    """Return rows (steps, 2) of position - target per step, and the final state (2, 2), from (q - target, qd)."""
    key = (lookahead_s, gain, step, steps)
    found = _known.get(key)
    if found is None:
        transition = ServojLaw(lookahead_s, gain).transition(step)
        rows, state = np.empty((steps, 2)), np.eye(2)
        for row in range(steps):
            state = transition @ state
            rows[row] = state[0]
        if len(_known) >= _MAX_KEPT:
            _known.clear()
        found = _known[key] = (rows, state)
    return found


class Servo(Trajectory):
    """Motion by the servoj law, with the latest target held.

    Args:
        start: (6,) joint positions.
        rate: (6,) joint speeds at the start.
    """

    streamed = True
    duration = float("inf")

    def __init__(self, start: Array, rate: Array) -> None:
        self._state = np.array([start, rate])
        self._offset = self._state.copy()
        self._law = (0.0, 0.0)
        self._end: Array = np.eye(2)
        self.target = start
        self._settled = False

    @property
    def q(self) -> Array:
        """(6,) present position."""
        q: Array = self._state[0]
        return q

    def aim(self, target: Array, lookahead_s: float, gain: float, ticks: int) -> None:
        """Set a new target (6,), which controls the arm for `ticks`."""
        self.target, self._law, self.ticks_left, self._settled = target, (lookahead_s, gain), ticks, False

    def shift(self, q: Array, rate: Array) -> None:
        """Continue from another position and speed."""
        self._state = np.array([q, rate])

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        rows, self._end = _discretised(*self._law, step, len(counts))
        offset = self._state.copy()
        offset[0] -= self.target
        self._offset = offset
        q: Array = self.target + rows @ offset
        return q

    def commit(self, time: float) -> None:
        """Advance by `time`."""
        self.t += time
        self._state = self._end @ self._offset
        first = float(self._state[0, 0])  # far away, as nearly always: then the others do not matter
        self._settled = abs(first) < _AT_TARGET and float(np.abs(self._state).max()) < _AT_TARGET
        self._state[0] += self.target

    def rate(self) -> Array:
        """Return the joint speeds (6,) now."""
        speed: Array = self._state[1]
        return speed

    @property
    def finished(self) -> bool:
        """True once the arm has stopped."""
        return self._settled and self.ticks_left <= 0

    @property
    def returns(self) -> bool:
        """True once the command returns to its program."""
        return self.ticks_left <= 0
