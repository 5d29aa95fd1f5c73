"""Matrices of the adapter: what its settings alone decide, computed once for all adapters that have them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.control import path, stopping
from dual_ur10.sim2real.control.limits import HISTORY, Envelope, MotionLimits
from dual_ur10.sim2real.control.time_scaling import interpolate
from ur_core.kernel import Struct
from ur_core.servoj import ServojLaw, ServojProfile
from ur_core.types import Array

_MANY_TICKS = 5  # targets per period from which on they sample the path densely enough

_STIFF = 2.5  # gain times a tick squared above which targets show the arm's acceleration better than the law does
_PARTS = 8  # sub-steps of a tick for the law under time scaling, and of a period between few targets

_PURSUIT_S = 0.2  # until arms that are far from their commands have the speed to approach them

# Between two instants of later periods at which limits are checked: at targets, between them, and of brakes.
_CHECK_S, _CHECK_BETWEEN_S, _CHECK_BRAKES_S = 0.008, 0.001, 0.04

_VALUES = HISTORY + path.VALUES  # that a plan is made of: the last three targets, and the values that define a path


class AdapterMatrices:
    """Coefficients of the kernel's adapter, which no adapter may write to.

    Args:
        profile: The controllers' family and servoj settings.
        limits: Limits of motion that the adapter keeps.
        ticks: Controller ticks per action.
        compensate_lag: Send targets ahead by the law's inverse.
        lookahead_s: Lookahead of the law that the arms follow.
        speed_factor: Rate of task time in real time.
    """

    def __init__(
        self,
        profile: ServojProfile,
        limits: MotionLimits,
        ticks: int,
        compensate_lag: bool,
        lookahead_s: float,
        speed_factor: float,
    ) -> None:
        self.limits, self.ticks, self.compensate_lag, self.speed_factor = limits, ticks, compensate_lag, speed_factor
        self.tick_s, self.period_s = profile.tick_s, ticks * profile.tick_s
        # The law in task time.
        self.law = ServojLaw(lookahead_s * speed_factor, profile.gain / speed_factor**2)
        self.lead_s = profile.tick_s * speed_factor / 2 if compensate_lag else 0.0
        self.envelope = Envelope(limits, profile.tick_s, ticks)
        self.values = self._values()
        """Fields of the kernel's structure."""
        for value in self.values.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def _values(self) -> dict[str, Any]:
        meetings = path.meetings(self.period_s)
        horizons = range(1, meetings[-1].periods + 1)
        plans = [self._plan(periods) for periods in horizons]
        between = [self._between(periods, 0, 1) for periods in horizons]
        later = [self._later(periods) for periods in horizons]
        speed = np.tile(self.limits.speed_rad_s, 2)
        return {
            "latest": len(horizons),
            "between_rows": len(between[0]),
            "later_rows": sum(len(rows) for rows, _ in later),
            "envelope": self.envelope.kernel,
            "stopping": self._stopping(),
            "plans": np.stack([targets for targets, _ in plans]),
            "ends": np.stack([end for _, end in plans]),
            "lines": np.stack([path.continuation(self.period_s, periods, 2) for periods in horizons]),
            "cubics": np.stack([path.continuation(self.period_s, periods, path.POINTS) for periods in horizons]),
            "between": np.stack(between),
            "later": np.concatenate([rows for rows, _ in later]),
            "later_kinds": np.concatenate([kinds for _, kinds in later]),
            "later_ends": np.cumsum([len(rows) for rows, _ in later]),
            "limits": np.stack(
                [speed, np.full(12, self.limits.acceleration_rad_s2), np.full(12, self.limits.jerk_rad_s3)]
            ),
            "meetings": len(meetings),
            "periods": np.array([each.periods for each in meetings]),
            "curved": np.array([int(each.curved) for each in meetings]),
            "pursuit": self._targets_of(max(1, round(_PURSUIT_S / self.period_s)), self.ticks, free=True),
            "pursuit_rate": self.limits.acceleration_rad_s2 / (2 * max(self.limits.speed_rad_s)),
            "resume": self._resume_matrix(),
        }

    def _plan(self, periods: int) -> tuple[Array, Array]:
        """Return a period as matrices on a plan's values: targets, (ticks, ...), and the path's end, (4, ...)."""
        end = np.zeros((4, _VALUES))
        end[:, HISTORY:] = path.path(self.period_s, np.zeros(1), periods).end
        return self._targets_of(periods, self.ticks), end

    def _targets_of(self, periods: int, count: int, free: bool = False) -> Array:
        """Return the first targets, (count, ...), of a path to a meeting and beyond, as a matrix on a plan's values."""
        # Held for a tick, a target acts half a tick late on average: it is taken half a tick ahead.
        times_s = np.arange(count, dtype=np.float64) * self.tick_s + self.lead_s
        rows = path.path(self.period_s, times_s, periods, free)
        targets = np.zeros((count, _VALUES))
        targets[:, HISTORY:] = rows.position
        if self.compensate_lag:
            targets[:, HISTORY:] += self.law.lookahead_s * rows.speed + rows.acceleration / self.law.gain
        return targets

    def _stopping(self) -> Struct:
        """Return the law of the soonest stop as the kernel's structure."""
        arm = np.zeros((2, stopping.CARRIED + 1))
        if self.compensate_lag:
            arm[:, HISTORY:] = self.law.response(self.tick_s, 1, 1)[0]
        else:  # the path is the targets'
            arm[0, -1] = 1.0
            arm[1, [HISTORY - 1, -1]] = np.array([-1.0, 1.0]) / self.tick_s
        limits = self.limits.acceleration_rad_s2, self.limits.jerk_rad_s3
        rows = stopping.gains(arm, self.tick_s, *limits)
        return Struct(
            "Stopping",
            latest=len(rows),
            ticks=self.ticks,
            tick_s=self.tick_s,
            period_s=self.period_s,
            lead_s=self.lead_s,
            lookahead_s=self.law.lookahead_s if self.compensate_lag else 0.0,
            acceleration_rad_s2=limits[0],
            jerk_rad_s3=limits[1],
            gains=rows,
            arm=arm,
        )

    def _later(self, periods: int) -> tuple[Array, NDArray[np.int64]]:
        """Return what is limited after this period, as a matrix on a plan's values, and the kind of each row.

        That is speed (0), acceleration (1) and jerk (2), at instants until the meeting, at the ticks that pass it, and
        along the brakes from some of the periods.
        """
        ticks, tick_s = self.ticks, self.tick_s
        count = ticks * periods + HISTORY
        targets = np.vstack([np.eye(HISTORY, _VALUES), self._targets_of(periods, count)])
        every = max(1, round(_CHECK_S / tick_s))
        instants = np.unique([*range(ticks, count - HISTORY, every), *range(count - HISTORY, count)])
        rows, kinds = [], []
        derivative = targets
        for kind in range(3):
            derivative = np.diff(derivative, axis=0) / tick_s
            rows.append(derivative[instants + HISTORY - 1 - kind])
            kinds.append(np.full(len(instants), kind))
        between = self._between(periods, 1, periods)[:: max(1, round(_CHECK_BETWEEN_S / self.period_s * _PARTS))]
        rows.append(between)
        kinds.append(np.full(len(between), 1))
        brakes, of_brakes = self.envelope.of_brakes()
        for last in range(2, periods + 1, max(1, round(_CHECK_BRAKES_S / self.period_s))):
            rows.append(brakes @ targets[ticks * last : ticks * last + HISTORY])
            kinds.append(of_brakes)
        return np.concatenate(rows), np.concatenate(kinds)

    def _between(self, periods: int, first: int, last: int) -> Array:
        """Return the acceleration between the targets of some periods, as a matrix on a plan's values.

        With few targets per period, legal targets can lie on an illegal path. With many there are no rows.
        """
        if self.ticks >= _MANY_TICKS:
            return np.zeros((0, _VALUES))
        lookahead_s = self.law.lookahead_s if self.compensate_lag else 0.0
        step_s = self.period_s / _PARTS
        times = self.period_s * first + step_s * np.arange(_PARTS * (last - first) + 1.0)
        rows = path.path(self.period_s, times, periods)
        result = np.zeros((len(times) - 1, _VALUES))
        result[:, HISTORY:] = rows.acceleration[:-1] + lookahead_s * np.diff(rows.acceleration, axis=0) / step_s
        return result

    def _resume_matrix(self) -> Array:
        """Return the path's state after a limited period, (4, ...), on the targets and the arm's state before.

        With compensation that is where the law takes the arm, without it the next target. Acceleration and jerk
        continue those of the last targets.
        """
        law, ticks, tick_s = self.law, self.ticks, self.tick_s
        width = HISTORY + ticks
        reached = np.zeros((4, width + 2))
        if self.compensate_lag:
            seen = self._seen_by_the_law()
            response = law.response(tick_s * ticks / len(seen), len(seen), 1)[-1]
            reached[:2, :width], reached[:2, width:] = response[:, 2:] @ seen, response[:, :2]
            # The last target was sampled `after` ticks before the end of its tick: extrapolate it by a parabola.
            after = 1.0 - self.lead_s / tick_s
            last = slice(width - 3, width)
            if law.gain * tick_s**2 > _STIFF:
                # The law reaches a target within a tick, which hides its acceleration.
                reached[2, last] = np.array([1.0, -2.0, 1.0]) / tick_s**2
                return reached
            reached[2, last] = _parabola(after) * law.gain
            reached[2] -= law.gain * (reached[0] + law.lookahead_s * reached[1])
            reached[3, last] = np.array([after + 0.5, -2.0 * after - 2.0, after + 1.5]) * (law.gain / tick_s)
            reached[3] -= law.gain * (reached[1] + law.lookahead_s * reached[2])
        else:
            # The last target was sampled a whole tick before the end of the period: extrapolate it by a parabola.
            last = slice(width - 3, width)
            reached[0, last] = 1.0, -3.0, 3.0
            reached[1, last] = np.array([1.5, -4.0, 2.5]) / tick_s
            reached[2, last] = np.array([1.0, -2.0, 1.0]) / tick_s**2
        return reached

    def _seen_by_the_law(self) -> Array:
        """Return the law's inputs in equal parts of a period, (parts, width), as a matrix on the window of targets.

        At full speed each target is held for a tick. Under time scaling the inputs lie on a curve through the targets,
        held for a control period each, which delays them by half of one.
        """
        ticks, width = self.ticks, HISTORY + self.ticks
        rows = np.eye(width + 2, width)
        rows[width:, -3:] = _parabola(1.0), _parabola(2.0)  # the next targets are unknown yet
        late = self.lead_s / self.tick_s
        parts = 1 if self.speed_factor == 1.0 else _PARTS
        times = HISTORY + (np.arange(ticks * parts) + 0.5) / parts - late
        seen = np.empty((ticks * parts, width))
        for row, time in zip(seen, times, strict=True):
            below = int(time)
            before, start, stop, following = rows[below - 1 : below + 3]
            row[:] = interpolate(before, start, stop, following, time - below)
        return seen


matrices_of = lru_cache(maxsize=64)(AdapterMatrices)
"""Matrices of some settings: every environment needs those of the same few."""


def _parabola(after: float) -> Array:
    """Return the weights, (3,), that extrapolate a parabola through three values by `after` steps."""
    return np.array([after * (after + 1.0) / 2, -after * (after + 2.0), (after + 1.0) * (after + 2.0) / 2])
