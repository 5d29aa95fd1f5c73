"""Series of a live page's plots, from the rows of the program and the delays of both senders."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.envs.rendering.live.memory import Row
from ur_core.types import Array

SHOWN_S: Final = 20.0
"""Time that a plot shows."""

_MOST: Final = 1000


class PlotPoint(NamedTuple):
    """One instant of all plots.

    Attributes:
        at_s: Time on the system's clock.
        error_mrad: Largest tracking error of a joint of each arm.
        speed: Largest ratio of a joint's commanded speed to its limit, of each arm.
        spare_mm: Smallest distance above the smallest legal one.
        late_ms: Largest delay: of a step, or of sending a target to controllers.
        skew_ms: Largest difference between the sending times of both arms' targets of one period.
    """

    at_s: float
    error_mrad: tuple[float, float]
    speed: tuple[float, float]
    spare_mm: float
    late_ms: float
    skew_ms: float


class History:
    """Points of the last seconds.

    Args:
        speed_rad_s: (2, 6) speed limits of the joints.
    """

    def __init__(self, speed_rad_s: Array) -> None:
        self._limits = np.asarray(speed_rad_s, dtype=np.float64)
        self._points: deque[PlotPoint] = deque(maxlen=_MOST)
        self._last: Row | None = None

    def add(self, rows: Sequence[Row], late_ms: float = math.nan, skew_ms: float = math.nan) -> None:
        """Add rows of the program, and the delays of sending meanwhile."""
        for row in rows:
            scalars, last = row.scalars, self._last
            speed = (math.nan, math.nan)
            if last is not None and scalars["episode"] == last.scalars["episode"]:
                passed_s = scalars["time_s"] - last.scalars["time_s"]
                if passed_s > 0.0:
                    ratios = np.abs(row.commanded_rad - last.commanded_rad) / passed_s / self._limits
                    left, right = ratios.max(axis=1).tolist()
                    speed = left, right
            error_left, error_right = (1e3 * np.abs(row.commanded_rad - row.q_rad).max(axis=1)).tolist()
            late = 1e3 * scalars["late_s"] if math.isnan(late_ms) else late_ms
            spare_mm = 1e3 * scalars["spare_m"]
            self._points.append(PlotPoint(scalars["at_s"], (error_left, error_right), speed, spare_mm, late, skew_ms))
            self._last = row

    def series(self, now_s: float) -> list[Array]:
        """Return arrays of one length: age (s, negative), then each number of a `PlotPoint` in its order."""
        points = [each for each in self._points if each.at_s > now_s - SHOWN_S]
        rows = [
            (each.at_s - now_s, *each.error_mrad, *each.speed, each.spare_mm, each.late_ms, each.skew_ms)
            for each in points
        ]
        return list(np.array(rows, dtype=np.float64).reshape(-1, 8).T)
