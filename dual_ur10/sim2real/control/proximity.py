"""Proximity scaling: the time of both arms slows down while two bodies approach each other at a small distance.

The arms stay on their path, which a limit on commands cannot ensure. Motion apart or past each other is not slowed
down. The safety gate brakes at the smallest legal distance, whatever is computed here.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.time_scaling import scaling_from_slider
from ur_core.types import Array, Mask

NEAR_M: Final = 0.05
"""Distance at which slowing down begins, where the gate's smallest one is `MINIMUM_M`; otherwise as far beyond it."""

NEAR_SPEED_M_S: Final = 0.25
"""Largest speed of approach at `NEAR_M`: the reduced speed of ISO 10218-1."""

LEAST_SPEED_M_S: Final = 0.02
"""The same at the smallest legal distance: chosen, far below any speed at which the gate's brake matters."""

LEAST_SCALING: Final = 1 / 8
"""Smallest scaling: time never stops, so that a policy can lead the arms away."""


def proximity_scaling(spare_m: Array, speed_m_s: Array) -> float:
    """Return the largest time scaling at which no pair approaches faster than allowed, `LEAST_SCALING` to 1.

    Args:
        spare_m: Distances above the smallest legal ones.
        speed_m_s: Speeds of approach at a scaling of 1, of the same shape; negative: apart.
    """
    near = (spare_m < NEAR_M - MINIMUM_M) & (speed_m_s > LEAST_SPEED_M_S)
    if not near.any():
        return 1.0
    room = np.maximum(spare_m[near], 0.0) / (NEAR_M - MINIMUM_M)
    allowed = LEAST_SPEED_M_S + room * (NEAR_SPEED_M_S - LEAST_SPEED_M_S)
    return min(max(float((allowed / speed_m_s[near]).min()), LEAST_SCALING), 1.0)


class ProximityScaling:
    """Time scaling of one cell from the clearance at the newest target and where the gate's brake would end.

    Pairs that a task brings together on purpose are left out.

    Args:
        distances: Computes distances.
        period_s: Duration of a window of targets at a scaling of 1.
    """

    def __init__(self, distances: Clearance, period_s: float) -> None:
        self._distances, self._period_s = distances, period_s
        self._counted: Mask = ~distances.exempt

    def reset(self, q_rad: Array) -> None:
        """Start from rest at a configuration, (12,)."""
        self._before = np.tile(self._distances.spare_m(q_rad[None])[0, self._counted], (2, 1))

    def __call__(self, q_rad: Array, rest_spare_m: Array) -> float:
        """Return the time scaling for the targets of a released window, rounded down to a step.

        Args:
            q_rad: (12,) last target of the window.
            rest_spare_m: (pairs,) spare distances at the end of the brake that follows it.
        """
        spare = np.stack([self._distances.spare_m(q_rad[None])[0], rest_spare_m])[:, self._counted]
        before, self._before = self._before, spare
        return scaling_from_slider(proximity_scaling(spare, (before - spare) / self._period_s))
