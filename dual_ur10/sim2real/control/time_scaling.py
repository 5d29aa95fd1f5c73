"""How fast the time of both arms' targets passes: one function of the control period, the same for both.

At pace 1 target k belongs to control period k, bit for bit. Where a speed slider or the cell slows the arms down, both
go the same way in the same order, slower.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from dual_ur10.types import Array

SLOWING_PER_S: Final = 4.0
"""How fast the pace goes down: as fast as the emulated controllers slow down what they do, or targets run away from
arms. A joint at 0.5 rad/s is slowed down with 2 rad/s², half of what a stop does, beside what its path asks for."""

SLOPE_PER_S: Final = 1.0
"""How fast it goes up again: 0.5 rad/s² then. There is no hurry."""

STEP: Final = 1 / 16
"""Paces that are told apart. What the slider says is taken down to the next one below it."""

FULL: Final = 0.999
"""A slider from which on it counts as at 100 %: controllers tell fractions."""

_SLOWEST: Final = 1e-3
_ROUNDING: Final = 1e-6  # of a target's number: what is reached by less is reached


@dataclass(frozen=True)
class Pace:
    """Which target belongs to a control period, from one period on.

    Attributes:
        period: First control period this holds for.
        index: The target that belongs to it.
        rate: Targets per control period there.
        goal: Targets per control period in the end.
        slope: By how much the rate changes per control period until then, above 0.
        bend: By how much the rate changed per control period before, below 0 where it fell. Who asks for a period
            before the first one, once this pace is known, is told what was told before.
        plateau: The rate before that change.
    """

    period: float = 0.0
    index: float = 0.0
    rate: float = 1.0
    goal: float = 1.0
    slope: float = 1.0
    bend: float = 0.0
    plateau: float = 1.0

    def at(self, period: float) -> float:
        """Number of the target that belongs to a control period, which may be a fraction of one."""
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
        """Targets per control period, at one."""
        passed = period - self.period
        if passed < 0.0:
            rate = self.rate + self.bend * passed
            return rate if self.bend == 0.0 else min(rate, self.plateau) if self.bend < 0.0 else max(rate, self.plateau)
        change = self.slope * passed
        if self.goal >= self.rate:
            return min(self.rate + change, self.goal)
        return max(self.rate - change, self.goal)

    def period_of(self, index: float) -> float:
        """When a target's turn comes; infinite where time stands still before it. What `at` inverts."""
        ahead = index - self.index
        if ahead <= 0.0 and self.bend != 0.0:
            change = (self.plateau - self.rate) / self.bend
            slowest = min(self.plateau, self.rate)
            return self._turn(index, self.period + change + ahead / max(slowest, _SLOWEST), self.period)
        if self.rate == self.goal:
            return self.period + ahead / self.rate if self.rate > 0.0 else (self.period if ahead <= 0 else float("inf"))
        if ahead <= 0.0:
            return self.period + (ahead / self.rate if self.rate > 0.0 else 0.0)
        high = self.period + abs(self.goal - self.rate) / self.slope
        end = self.at(high)
        if index > end + _ROUNDING:
            return high + (index - end) / self.goal if self.goal > 0.0 else float("inf")
        return self._turn(index, self.period, high)

    def _turn(self, index: float, low: float, high: float) -> float:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self.at(middle) < index else (low, middle)
        return high

    def towards(self, goal: float, period: float, tick_s: float, full: float = 1.0) -> Pace:
        """The pace that goes on from this one in a control period, towards another rate.

        `full` is the rate at a slider of 100 %: what the arms do is that much slower, and so is every change.
        """
        rate = self.rate_at(period)
        slope = (SLOWING_PER_S if goal < rate else SLOPE_PER_S) * full * tick_s
        if period <= self.period:  # what was before stays what was before
            return Pace(self.period, self.index, self.rate, goal, slope, self.bend, self.plateau)
        changes = rate != self.goal
        bend = (self.slope if self.goal > rate else -self.slope) if changes else 0.0
        return Pace(period, self.at(period), rate, goal, slope, bend, self.rate)


def taken_down(fraction: float) -> float:
    """A slider's fraction as a pace: 1 for all of it, else down to a whole number of steps; 0 for what is no number."""
    if fraction >= FULL:
        return 1.0
    if not fraction > 0.0:
        return 0.0
    return int(fraction / STEP + 1e-9) * STEP


def between(before: Array, start: Array, stop: Array, after: Array, share: float) -> Array:
    """Between two targets, on the cubic whose slopes at them are those between their neighbours."""
    leaving, arriving = (stop - before) / 2, (after - start) / 2
    way = start - stop
    cubic = share * (share * (2 * way + leaving + arriving) - 3 * way - 2 * leaving - arriving)
    result: Array = start + share * (leaving + cubic)
    return result
