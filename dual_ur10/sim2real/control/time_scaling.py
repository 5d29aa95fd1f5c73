"""Time scaling of both arms' targets: one function of the control period, the same for both arms.

At a scaling of 1, target k belongs to control period k, bit for bit. Where a speed slider or the cell slows the arms
down, both follow the same path in the same order, more slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ur_core.types import Array

SLOWING_PER_S: Final = 4.0
"""Rate at which the scaling falls: as fast as the emulated controllers slow down, or targets run away from the arms. A
joint at 0.5 rad/s then decelerates by 2 rad/s², half of what a stop uses, on top of what its path asks for."""

SLOPE_PER_S: Final = 1.0
"""Rate at which the scaling rises again: 0.5 rad/s² for the same joint. There is no hurry."""

STEP: Final = 1 / 16
"""Resolution of the scaling. A slider's value is rounded down to the next step."""

FULL: Final = 0.999
"""Slider value from which on it counts as 100 %: controllers report fractions."""

_SLOWEST: Final = 1e-3
_ROUNDING: Final = 1e-6  # of a target's number: a target this close is reached


@dataclass(frozen=True)
class TimeScaling:
    """Map from control periods to target numbers, valid from one period on.

    Attributes:
        period: First control period of this map.
        index: Target number at `period`.
        rate: Targets per control period at `period`.
        goal: Final targets per control period.
        slope: Change of the rate per control period until then, above 0.
        bend: Change of the rate per control period before `period`; negative where it fell. A reader that asks for an
            earlier period after this map was published gets the same answer as before.
        plateau: Rate before that change.
    """

    period: float = 0.0
    index: float = 0.0
    rate: float = 1.0
    goal: float = 1.0
    slope: float = 1.0
    bend: float = 0.0
    plateau: float = 1.0

    def at(self, period: float) -> float:
        """Return the target number, possibly fractional, that belongs to a control period."""
        passed = period - self.period
        if passed < 0.0 and self.bend != 0.0:
            changing = max(passed, (self.plateau - self.rate) / self.bend)
            return self.index + (self.rate + self.bend * changing / 2) * changing + self.plateau * (passed - changing)
        if self.rate == self.goal:
            return self.index + self.rate * passed
        sign = 1.0 if self.goal > self.rate else -1.0
        changing = min(max(passed, 0.0), abs(self.goal - self.rate) / self.slope)
        change = (self.rate + sign * self.slope * changing / 2) * changing
        if passed <= changing:
            return self.index + (change if passed > 0.0 else self.rate * passed)
        return self.index + change + self.goal * (passed - changing)

    def rate_at(self, period: float) -> float:
        """Return the targets per control period at a control period."""
        passed = period - self.period
        if passed < 0.0:
            rate = self.rate + self.bend * passed
            return rate if self.bend == 0.0 else min(rate, self.plateau) if self.bend < 0.0 else max(rate, self.plateau)
        change = self.slope * passed
        if self.goal >= self.rate:
            return min(self.rate + change, self.goal)
        return max(self.rate - change, self.goal)

    def period_of(self, index: float) -> float:
        """Return the control period of a target, the inverse of `at`; infinite if time stops before it."""
        ahead = index - self.index
        if ahead <= 0.0 and self.bend != 0.0:
            change = (self.plateau - self.rate) / self.bend
            slowest = min(self.plateau, self.rate)
            return self._bisect(index, self.period + change + ahead / max(slowest, _SLOWEST), self.period)
        if self.rate == self.goal:
            return self.period + ahead / self.rate if self.rate > 0.0 else (self.period if ahead <= 0 else float("inf"))
        if ahead <= 0.0:
            return self.period + (ahead / self.rate if self.rate > 0.0 else 0.0)
        high = self.period + abs(self.goal - self.rate) / self.slope
        end = self.at(high)
        if index > end + _ROUNDING:
            return high + (index - end) / self.goal if self.goal > 0.0 else float("inf")
        return self._bisect(index, self.period, high)

    def _bisect(self, index: float, low: float, high: float) -> float:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self.at(middle) < index else (low, middle)
        return high

    def may_change(self, now: float, period: float) -> bool:
        """Return True if a map from `towards(..., period, ...)` gives all readers from period `now` on the same past.

        It keeps one change of the rate before `period`: earlier ones must be over.
        """
        over = self.rate_at(now) == self.goal or self.rate_at(period) != self.goal
        return period <= self.period or (self.period <= now and over)

    def towards(self, goal: float, period: float, tick_s: float, full: float = 1.0) -> TimeScaling:
        """Return the map that continues this one from a control period towards another rate.

        Args:
            goal: Final targets per control period.
            period: Control period at which the change begins.
            tick_s: Control period, s.
            full: Rate at a slider of 100 %: slower arms change their rate proportionally more slowly.
        """
        rate = self.rate_at(period)
        slope = (SLOWING_PER_S if goal < rate else SLOPE_PER_S) * full * tick_s
        if period <= self.period:  # the past does not change
            return TimeScaling(self.period, self.index, self.rate, goal, slope, self.bend, self.plateau)
        changes = rate != self.goal
        bend = (self.slope if self.goal > rate else -self.slope) if changes else 0.0
        return TimeScaling(period, self.at(period), rate, goal, slope, bend, self.rate)


def scaling_from_slider(fraction: float) -> float:
    """Return the scaling of a slider's fraction: 1 when full, else rounded down to a step; 0 for NaN."""
    if fraction >= FULL:
        return 1.0
    if not fraction > 0.0:
        return 0.0
    return int(fraction / STEP + 1e-9) * STEP


def interpolate(before: Array, start: Array, stop: Array, after: Array, fraction: float) -> Array:
    """Interpolate between two targets on the cubic whose slopes are those between their neighbours."""
    leaving, arriving = (stop - before) / 2, (after - start) / 2
    step = start - stop
    cubic = fraction * (fraction * (2 * step + leaving + arriving) - 3 * step - 2 * leaving - arriving)
    result: Array = start + fraction * (leaving + cubic)
    return result
