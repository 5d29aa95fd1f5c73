"""What becomes of a period in which no path keeps the limits.

The period is written as "coast, plus a share of the way to the planned targets": going on at the speed it has. Every
limit is linear in the share, so the largest legal share is a minimum over ratios. One share for all twelve joints of a
cell keeps the direction of its step, and with it the relative pose of two arms. Where coasting itself would exceed a
limit, the brake takes its place, which the last period left possible: a share of zero is always legal.
"""

from __future__ import annotations

import numpy as np

from dual_ur10.sim2real.control.limits import HISTORY, Envelope
from dual_ur10.types import Array, Mask

_FULL = 1.0 - 1e-6
"""Share of a limit that may be used: the rest is left so that rounding never meets the safety gate."""

_TIP_FULL = 0.993
"""The same for the tip speed. Along the brake it is sampled: the gate, with other samples, must not find more."""

_TINY = 1e-200

_TRIES = 4
"""Attempts to find a share that respects the tip speed, which is not linear, before it is set to zero."""


class Limiter:
    """Decides whether planned targets keep the limits, and how much of them may be had if not.

    Args:
        envelope: The limits on a window of targets.
    """

    def __init__(self, envelope: Envelope) -> None:
        self.envelope = envelope
        self._coast, self._brake = (self._with_use(rows) for rows in (envelope.coast, envelope.brake))

    def _with_use(self, rows: Array) -> Array:
        """Targets and limited quantities of a period that continues the past by `rows`."""
        return np.vstack([rows, self.envelope.rows @ np.vstack([np.eye(HISTORY), rows])])

    def is_legal(self, use: Array, past: Array, targets: Array) -> Mask:
        """(n,) mask of the cells whose targets keep all limits.

        Args:
            use: (n, m, 12) used share of each limit, signed or not.
            past: (n, 3, 12) last targets.
            targets: (n, ticks, 12) planned targets.
        """
        share = np.abs(use)
        if self.envelope.within(share, _FULL, _TIP_FULL):
            return np.ones(len(share), dtype=bool)
        bound = self.envelope.tip_bound(share)
        legal: Mask = share.reshape(len(share), -1).max(axis=1) <= _FULL
        rows = np.flatnonzero((bound > _TIP_FULL) & legal)
        if rows.size:
            legal[rows] = self._tip_share(past[rows], targets[rows]) <= _TIP_FULL
        return legal

    def _tip_share(self, past: Array, targets: Array) -> Array:
        fastest: Array = self.envelope.tip_share(np.concatenate([past, targets], axis=1))[0].max(axis=1)
        return fastest

    def limit(self, use: Array, past: Array, targets: Array) -> Array:
        """Targets that go as far towards the planned ones as the limits allow.

        Args:
            use: (n, m, 12) signed share of each limit that the planned targets would use.
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
        share = np.minimum(np.maximum(room.reshape(n, -1).min(axis=1), 0.0), 1.0)[:, None, None]
        way = targets - base
        for _ in range(_TRIES):
            limited: Array = base + share * way
            if (envelope.tip_bound(np.abs(used + share * gained)) <= _TIP_FULL).all():
                return limited
            fastest = self._tip_share(past, limited)
            fast = fastest > _TIP_FULL
            if not fast.any():
                return limited
            share[fast] *= 0.9 / fastest[fast, None, None]
        share[fast] = 0.0
        stopped: Array = base + share * way
        return stopped

    def _continued(self, rows: Array, past: Array) -> tuple[Array, Array]:
        """Targets, (n, ticks, 12), and the signed share of each limit, (n, m, 12), of coast or brake."""
        ticks, last = self.envelope.ticks, past[:, -1:]
        # Relative to the last target: what a third difference is made of is then small, and so is its rounding.
        continued = rows @ (past - last)
        continued[:, :ticks] += last
        quantities = continued[:, ticks:]
        quantities[:, self.envelope.position_rows] += last
        return continued[:, :ticks], self.envelope.signed_use(quantities)
