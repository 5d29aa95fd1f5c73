"""Limiter: the legal period nearest to a planned one that breaks a limit.

The period is coasting, at the speed it has, plus a fraction of the step from there to the planned targets. Every limit
is linear in the fraction, so the largest legal one is a minimum over ratios. One fraction for all twelve joints of a
cell keeps the direction of its step, and with it the relative pose of two arms. Where coasting itself would exceed a
limit, the brake takes its place, which the last period left possible: a fraction of zero is always legal.
"""

from __future__ import annotations

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY, Envelope
from dual_ur10.types import Array, Mask

_FULL = 1.0 - 1e-6
"""Usable fraction of a limit: the rest keeps rounding errors away from the safety gate."""

_CARTESIAN_FULL = 0.993
"""The same for the Cartesian speed. The brake is sampled: the gate, with other samples, must not find more."""

_TINY = 1e-200

_TRIES = 4
"""Attempts to find a fraction within the Cartesian speed limit, which is not linear, before it is set to zero."""


class Limiter:
    """Checks planned targets, and scales those down that break a limit.

    Args:
        envelope: Limits on a window of targets.
    """

    def __init__(self, envelope: Envelope) -> None:
        self.envelope = envelope
        self._coast, self._brake = (self._with_use(rows) for rows in (envelope.coast, envelope.brake))

    def _with_use(self, rows: Array) -> Array:
        """Return the map to targets and limited quantities of a period that continues the past by `rows`."""
        return np.vstack([rows, self.envelope.rows @ np.vstack([np.eye(HISTORY), rows])])

    def is_legal(self, use: Array, past: Array, targets: Array) -> Mask:
        """Return an (n,) mask of the cells whose targets keep all limits.

        Args:
            use: (n, m, 12) used fraction of each limit, signed or not.
            past: (n, 3, 12) last targets.
            targets: (n, ticks, 12) planned targets.
        """
        used = np.abs(use)
        if self.envelope.within(used, _FULL, _CARTESIAN_FULL):
            return np.ones(len(used), dtype=bool)
        bound = self.envelope.cartesian_bound(used)
        legal: Mask = used.reshape(len(used), -1).max(axis=1) <= _FULL
        rows = np.flatnonzero((bound > _CARTESIAN_FULL) & legal)
        if rows.size:
            legal[rows] = self._cartesian_use(past[rows], targets[rows]) <= _CARTESIAN_FULL
        return legal

    def _cartesian_use(self, past: Array, targets: Array) -> Array:
        fastest: Array = self.envelope.cartesian_use(np.concatenate([past, targets], axis=1))[0].max(axis=1)
        return fastest

    def limit(self, use: Array, past: Array, targets: Array) -> Array:
        """Return the targets nearest to the planned ones that the limits allow.

        Args:
            use: (n, m, 12) signed fraction of each limit that the planned targets would use.
            past: (n, 3, 12) last targets.
            targets: (n, ticks, 12) planned targets.

        Returns:
            (n, ticks, 12) targets.
        """
        envelope, n = self.envelope, len(past)
        base, used = self._continued(self._coast, past)
        braking = ~self.is_legal(used, past, base)
        if braking.any():
            base[braking], used[braking] = self._continued(self._brake, past[braking])
        gained = use - used
        room = _FULL - np.copysign(used, used * gained)
        room /= np.maximum(np.abs(gained), _TINY)
        fraction = np.minimum(np.maximum(room.reshape(n, -1).min(axis=1), 0.0), 1.0)[:, None, None]
        step = targets - base
        for _ in range(_TRIES):
            limited: Array = base + fraction * step
            if (envelope.cartesian_bound(np.abs(used + fraction * gained)) <= _CARTESIAN_FULL).all():
                return limited
            fastest = self._cartesian_use(past, limited)
            fast = fastest > _CARTESIAN_FULL
            if not fast.any():
                return limited
            fraction[fast] *= 0.9 / fastest[fast, None, None]
        fraction[fast] = 0.0
        stopped: Array = base + fraction * step
        return stopped

    def _continued(self, rows: Array, past: Array) -> tuple[Array, Array]:
        """Return targets, (n, ticks, 12), and the signed fraction of each limit, (n, m, 12), of coast or brake."""
        ticks, last = self.envelope.ticks, past[:, -1:]
        # Relative to the last target, the terms of a third difference are small, and so is their rounding.
        continued = rows @ (past - last)
        continued[:, :ticks] += last
        quantities = continued[:, ticks:]
        quantities[:, self.envelope.position_rows] += last
        return continued[:, :ticks], self.envelope.signed_use(quantities)
