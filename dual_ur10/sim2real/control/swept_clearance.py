"""Swept clearance: distances along the path between the configurations at which the gate measures them."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.types import Array, Mask, Rows

SWEEP_TOLERANCE_M: Final = 0.005
"""Distance by which a pair may be closer than allowed between two checked configurations."""

# A path that needs more checks runs along an obstacle for long at full speed. It is refused, as time is short.
_CHECKS, _CHECKS_PER_TICK = 40, 10


class Distances(Protocol):
    """Distances between bodies; see `dual_ur10.sim2real.control.clearance.Clearance`."""

    def spare_m(self, q_rad: Array) -> Array:
        """Return the distance above the legal minimum, (n, pairs), at configurations (n, 12)."""

    def spare_of_spheres_m(self) -> Array:
        """Return a lower bound of it at the last configurations, from bounding spheres and without cutoff."""

    def travel_m(self, path_rad: Array) -> Array:
        """Return its largest decrease, (n, pairs), over joint travel (n, 12), not negative."""

    def alone(self) -> Distances:
        """Return the same distances for one configuration at a time, (1, 12)."""

    def worst(self, q_rad: Array) -> tuple[str, float, float]:
        """Return the pair with the smallest margin at a configuration, (12,), its distance and the legal minimum."""


class SweptClearance:
    """Checks the path from the last target along the new ones to the end of the brake, as finely as needed.

    Most pairs are so far apart that no such path brings them too close; they need no further check. The result of a row
    does not depend on the others.

    Args:
        distances: Computes distances.
        brake: (k, HISTORY) rows that continue the last targets with the brake until it is at rest.
        ticks: Targets per window.
    """

    def __init__(self, distances: Distances, brake: Array, ticks: int) -> None:
        self._distances, self._brake = distances, brake
        self._most = _CHECKS + _CHECKS_PER_TICK * ticks
        # Known of the last target: the spare distance at a configuration, and the travel from there.
        self._spare: Array | None = None
        self._away: Array | None = None

    def reset(self, rows: Rows) -> None:
        """Begin rows at configurations that the caller has checked."""
        if self._spare is not None and self._away is not None:
            self._spare[rows] = self._away[rows] = 0.0

    def __call__(self, window: Array, first_order: Array, rest: Array, spare: Array, rows: Mask) -> dict[int, Array]:
        """Check some rows.

        Args:
            window: (n, HISTORY + ticks, 12) targets. Targets that have been sent are not checked again.
            first_order: (n, 12) end of a first-order decay from the last target: the brake goes no further than there
                and back to `rest`.
            rest: (n, 12) end of the brake: the configurations measured last.
            spare: (n, pairs) spare distances there.
            rows: (n,) mask of rows to check: their targets keep all limits, and no pair is too close at `rest`.

        Returns:
            By row, a configuration, (12,), at which a pair is too close.
        """
        distances, end = self._distances, window[:, -1]
        coming = np.add.reduce(np.abs(np.diff(window[:, HISTORY - 1 :], axis=1)), axis=1)
        braking = np.abs(first_order - end) + np.abs(rest - first_order)
        travel = distances.travel_m(coming + braking)
        near = rows & ~np.logical_and.reduce(spare >= travel, axis=1)
        if np.logical_or.reduce(near):
            spare = np.where(near[:, None], np.maximum(spare, distances.spare_of_spheres_m()), spare)
            near &= ~np.logical_and.reduce(spare >= travel, axis=1)
        if not np.logical_or.reduce(near):
            self._spare, self._away = spare, braking
            return {}
        begin = self._known(spare)
        there = distances.spare_m(end)
        clear = np.logical_and.reduce(there >= 0.0, axis=1)
        there = np.maximum(there, distances.spare_of_spheres_m())
        self._spare = np.where(near[:, None], there, spare)
        self._away = np.where(near[:, None], 0.0, braking)
        least = np.minimum(begin + there - distances.travel_m(coming), there + spare - distances.travel_m(braking))
        proven = np.logical_and.reduce(least >= -2.0 * SWEEP_TOLERANCE_M, axis=1)
        found = {}
        for row in np.flatnonzero(near & ~clear).tolist():
            found[row] = end[row].copy()
        for row in np.flatnonzero(near & clear & ~proven).tolist():
            q_rad = self._bisect(window[row], begin[row], there[row], spare[row])
            if q_rad is not None:
                found[row] = q_rad
        return found

    def _known(self, like: Array) -> Array:
        """Return a lower bound of the spare distances at the last targets, (n, pairs)."""
        if self._spare is None or self._away is None:
            return np.zeros_like(like)
        known: Array = np.maximum(self._spare - self._distances.travel_m(self._away), 0.0)
        return known

    def _bisect(self, window: Array, begin: Array, there: Array, rest: Array) -> Array | None:
        """Check one row by bisection of every part of the path that the bounds do not prove clear.

        Args:
            window: (HISTORY + ticks, 12) targets.
            begin: (pairs,) lower bound of the spare distances at the last target sent.
            there: (pairs,) the same at the last of the window.
            rest: (pairs,) the same at the end of the brake.
        """
        one, end = self._distances.alone(), window[-1]
        brake = end + self._brake @ (window[-HISTORY:] - end)
        path = np.concatenate([window[HISTORY - 1 :], brake])
        gone = np.concatenate([np.zeros((1, 12)), np.cumsum(np.abs(np.diff(path, axis=0)), axis=0)])
        middle = len(window) - HISTORY
        parts = [(0, begin, middle, there), (middle, there, len(path) - 1, rest)]
        checks = 0
        while parts:
            first, spare_first, last, spare_last = parts.pop()
            if last - first < 2:
                continue
            # Every configuration between the two has at least half of this to spare.
            least = spare_first + spare_last - one.travel_m(gone[[last]] - gone[[first]])[0]
            if (least >= -2.0 * SWEEP_TOLERANCE_M).all():
                continue
            half = (first + last) // 2
            spare = one.spare_m(path[[half]])[0]
            checks += 1
            if checks > self._most or not (spare[least < 0.0] >= 0.0).all():
                found: Array = path[half].copy()
                return found
            spare = np.maximum(spare, one.spare_of_spheres_m()[0])
            parts += [(first, spare_first, half, spare), (half, spare, last, spare_last)]
        return None
