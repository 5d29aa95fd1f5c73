"""What comes too close on the way between the postures at which a safety gate measures distances."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.types import Array, Mask, Rows

SWEEP_TOLERANCE_M: Final = 0.005
"""By how much a pair may be closer than allowed between two postures that were looked at."""


# A way that needs more looks goes along something for long, at full speed: it is refused, as time is short.
_LOOKS, _LOOKS_PER_TICK = 40, 10


class Distances(Protocol):
    """Knows how near bodies come to each other; see `dual_ur10.sim2real.control.clearance.Clearance`."""

    def spare_m(self, q_rad: Array) -> Array:
        """(n, pairs) by how much each pair is at least farther apart than it must be at the postures, (n, 12)."""

    def spare_of_balls_m(self) -> Array:
        """The same at the postures that were measured last, for the balls around bodies: less, and without an end."""

    def travel_m(self, way_rad: Array) -> Array:
        """(n, pairs) by how much that can shrink at most, where the joints move by (n, 12) in all, none below 0."""

    def alone(self) -> Distances:
        """The same for one posture at a time, (1, 12)."""

    def worst(self, q_rad: Array) -> tuple[str, float, float]:
        """The pair with least to spare at a posture, (12,), its distance and the smallest legal one."""


class SweptClearance:
    """Looks at the way from the last target by the new ones to the end of the brake, as closely as it must.

    A pair that is so far apart that no such way can bring it too near needs no second look, which is the rule. What is
    found of a row does not depend on the others.

    Args:
        distances: Measures them.
        brake: (k, HISTORY) rows that continue the last targets with the brake, until it is at rest.
        ticks: Targets per window.
    """

    def __init__(self, distances: Distances, brake: Array, ticks: int) -> None:
        self._distances, self._brake = distances, brake
        self._most = _LOOKS + _LOOKS_PER_TICK * ticks
        # What is known of the last target: so much was to spare at a posture, and that is so far away.
        self._spare: Array | None = None
        self._away: Array | None = None

    def reset(self, rows: Rows) -> None:
        """Rows begin where somebody else has looked."""
        if self._spare is not None and self._away is not None:
            self._spare[rows] = self._away[rows] = 0.0

    def __call__(self, window: Array, turning: Array, rest: Array, spare: Array, rows: Mask) -> dict[int, Array]:
        """Look at some rows.

        Args:
            window: (n, HISTORY + ticks, 12) targets. Whether those that have left are too close is not asked.
            turning: (n, 12) where the joints would come to rest if they slowed down by a decay of first order: from the
                last target a brake goes no longer way than there and back to `rest`.
            rest: (n, 12) where they then could come to rest: what was measured last.
            spare: (n, pairs) what was measured there.
            rows: (n,) the rows that matter: their targets keep all limits, and nothing is too close at `rest`.

        Returns:
            Of each row in which something is too close, a posture, (12,), where it is.
        """
        distances, end = self._distances, window[:, -1]
        coming = np.add.reduce(np.abs(np.diff(window[:, HISTORY - 1 :], axis=1)), axis=1)
        braking = np.abs(turning - end) + np.abs(rest - turning)
        travel = distances.travel_m(coming + braking)
        near = rows & ~np.logical_and.reduce(spare >= travel, axis=1)
        if np.logical_or.reduce(near):
            spare = np.where(near[:, None], np.maximum(spare, distances.spare_of_balls_m()), spare)
            near &= ~np.logical_and.reduce(spare >= travel, axis=1)
        if not np.logical_or.reduce(near):
            self._spare, self._away = spare, braking
            return {}
        begin = self._known(spare)
        there = distances.spare_m(end)
        clear = np.logical_and.reduce(there >= 0.0, axis=1)
        there = np.maximum(there, distances.spare_of_balls_m())
        self._spare = np.where(near[:, None], there, spare)
        self._away = np.where(near[:, None], 0.0, braking)
        least = np.minimum(begin + there - distances.travel_m(coming), there + spare - distances.travel_m(braking))
        proven = np.logical_and.reduce(least >= -2.0 * SWEEP_TOLERANCE_M, axis=1)
        found = {}
        for row in np.flatnonzero(near & ~clear).tolist():
            found[row] = end[row].copy()
        for row in np.flatnonzero(near & clear & ~proven).tolist():
            posture = self._in_detail(window[row], begin[row], there[row], spare[row])
            if posture is not None:
                found[row] = posture
        return found

    def _known(self, like: Array) -> Array:
        """(n, pairs) what is at least to spare at the last targets, or 0."""
        if self._spare is None or self._away is None:
            return np.zeros_like(like)
        known: Array = np.maximum(self._spare - self._distances.travel_m(self._away), 0.0)
        return known

    def _in_detail(self, window: Array, begin: Array, there: Array, rest: Array) -> Array | None:
        """The same for one row, target by target: what is too long to be proven is halved.

        Args:
            window: (HISTORY + ticks, 12).
            begin: (pairs,) what is at least to spare at the last target that has left.
            there: (pairs,) at the last of the window.
            rest: (pairs,) where the brake ends.
        """
        one, end = self._distances.alone(), window[-1]
        brake = end + self._brake @ (window[-HISTORY:] - end)
        way = np.concatenate([window[HISTORY - 1 :], brake])
        gone = np.concatenate([np.zeros((1, 12)), np.cumsum(np.abs(np.diff(way, axis=0)), axis=0)])
        middle = len(window) - HISTORY
        parts = [(0, begin, middle, there), (middle, there, len(way) - 1, rest)]
        looks = 0
        while parts:
            first, spare_first, last, spare_last = parts.pop()
            if last - first < 2:
                continue
            # At every posture between the two a pair has at least half of this.
            least = spare_first + spare_last - one.travel_m(gone[[last]] - gone[[first]])[0]
            if (least >= -2.0 * SWEEP_TOLERANCE_M).all():
                continue
            half = (first + last) // 2
            spare = one.spare_m(way[[half]])[0]
            looks += 1
            if looks > self._most or not (spare[least < 0.0] >= 0.0).all():
                posture: Array = way[half].copy()
                return posture
            spare = np.maximum(spare, one.spare_of_balls_m()[0])
            parts += [(first, spare_first, half, spare), (half, spare, last, spare_last)]
        return None
