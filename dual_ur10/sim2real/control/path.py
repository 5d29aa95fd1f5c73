"""Smooth path towards commanded joint positions, as matrices.

A policy commands positions at its own rate. The path between them is a polynomial of degree 7, three times
continuously differentiable at the joins: it starts with the current position, speed, acceleration and jerk, and meets
the commands' continuation some periods later. A meeting at the end of this period follows a smooth motion within
micrometres. When that exceeds a limit, because a command jumped or a limit kept the arm from its path, a later one
takes the jump at less acceleration. Everything is linear in a few values, so one matrix product gives the path of all
cells, arms and joints.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from ur_core.types import Array

# Values that define a path: its current position, speed, acceleration and jerk, then those of the commands'
# continuation at the meeting.
POSITION, MEETING = 0, 4
VALUES = 8
_ORDERS = range(4)

POINTS = 4
"""Last commanded positions that a continuation is made of."""

_LATEST_S = 0.52  # within the hard limits, time to catch up with any command; later ones follow more slowly
_CURVED_S = 0.12  # beyond it, cubics through noise lead off further than lines through curves
_RATIO = 1.27  # of the time to one meeting and to the one before


class Meeting(NamedTuple):
    """Instant at which a path meets the commanded positions again.

    Attributes:
        periods: Number of periods until then.
        curved: The commands' continuation is a cubic where they are smooth; otherwise it is a line.
    """

    periods: int
    curved: bool


def meetings(period_s: float) -> tuple[Meeting, ...]:
    """Return the meetings in the order in which they are tried.

    A path that is legal as far as its meeting remains so while the commands go on as predicted: the next period finds
    the rest of the same path. The soonest such meeting therefore leads onto the commands and not past them. Soon after
    a deviation a cubic is needed, too: with lines alone, an arm that lags behind on a curve never reaches it.
    """
    periods = [1]
    while periods[-1] * period_s < _LATEST_S - 1e-9 or len(periods) < 3:
        periods.append(max(periods[-1] + 1, round(periods[-1] * _RATIO)))
    soon = [each for each in periods if each == 1 or each * period_s < _CURVED_S + 1e-9]
    return (*(Meeting(each, True) for each in soon), *(Meeting(each, False) for each in periods[1:]))


class PathRows(NamedTuple):
    """Weights of a path on the values in the order of this module's constants.

    Attributes:
        position: (k, 8) positions at the requested instants.
        speed: (k, 8) speeds there.
        acceleration: (k, 8) accelerations there.
        end: (4, 8) position, speed, acceleration and jerk at the end of the period.
    """

    position: Array
    speed: Array
    acceleration: Array
    end: Array


def path(period_s: float, times_s: Array, periods: int, free: bool = False) -> PathRows:
    """Return the path to a meeting, and beyond it the commands' continuation.

    Args:
        period_s: Time until the position commanded now is due.
        times_s: (k,) instants from now.
        periods: Number of periods until the meeting.
        free: The path meets the continuation's derivatives only, wherever that is.
    """
    horizon = periods * period_s
    times = np.append(times_s, period_s)
    x, after = np.minimum(times / horizon, 1.0), np.maximum(times - horizon, 0.0)[:, None]
    position, speed, acceleration, jerk = (
        np.asarray(polynomial.polyval(x, each)).T / horizon**order
        for order, each in enumerate(_polynomials(horizon, free))
    )
    position = position + after * (speed + after / 2 * (acceleration + after / 3 * jerk))
    speed = speed + after * (acceleration + after / 2 * jerk)
    acceleration = acceleration + after * jerk
    end = np.stack([rows[-1] for rows in (position, speed, acceleration, jerk)])
    return PathRows(position[:-1], speed[:-1], acceleration[:-1], end)


@lru_cache(maxsize=1024)
def _polynomials(horizon_s: float, free: bool) -> tuple[Array, ...]:
    """Return the coefficients of a path in fractions of its horizon, and of its derivatives; each (k, 8).

    Every environment needs those of the same few horizons: they take longer than all else of an adapter.
    """
    conditions = _conditions(free)
    coefficients: Array = np.zeros((len(conditions), VALUES))
    known = [order + (MEETING if x else POSITION) for x, order in conditions]
    scales = np.diag([horizon_s**order for _, order in conditions])
    coefficients[:, known] = np.linalg.solve(_equations(free), scales)
    derivatives = [np.asarray(polynomial.polyder(coefficients, order), dtype=np.float64) for order in _ORDERS[1:]]
    return coefficients, *derivatives


def _conditions(free: bool) -> list[tuple[float, int]]:
    """Return what is known of a path: the derivatives, by their orders, at its begin, 0, and at its meeting, 1."""
    return [(0.0, order) for order in _ORDERS] + [(1.0, order) for order in (_ORDERS[1:] if free else _ORDERS)]


@lru_cache(maxsize=2)
def _equations(free: bool) -> Array:
    """Return the known values as a matrix on the coefficients."""
    conditions = _conditions(free)
    powers = np.eye(len(conditions))
    return np.array([_derivative(powers, x, order) for x, order in conditions])


@lru_cache(maxsize=2048)
def continuation(period_s: float, periods: int, points: int) -> Array:
    """Return position, speed, acceleration and jerk, (4, 4), of the commands' continuation at a meeting.

    Args:
        period_s: Time between two commanded positions.
        periods: Number of periods until the meeting.
        points: Number of last commanded positions that the continuation passes through: 4 for a cubic, 2 for a line.
    """
    times = -period_s * np.arange(points)[::-1]
    fit = np.linalg.inv(np.vander(times, increasing=True))
    ahead = (periods - 1) * period_s
    rows = np.zeros((4, POINTS))
    rows[:, POINTS - points :] = [_derivative(fit, ahead, order) for order in _ORDERS]
    rows.flags.writeable = False
    return rows


def _derivative(coefficients: Array, x: float, order: int) -> Array:
    derived = polynomial.polyder(coefficients, order) if order else coefficients
    result: Array = np.asarray(polynomial.polyval(x, derived))
    return result
