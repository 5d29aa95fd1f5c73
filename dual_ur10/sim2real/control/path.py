"""Smooth path towards commanded joint positions, as a matrix.

A policy commands positions at its own rate. Between them the path is a quintic polynomial, twice continuously
differentiable at the joins: it starts with the current position, speed and acceleration, and meets the commanded
positions again, with the speed and acceleration of a polynomial through the last of them, at the end of the period.
When that exceeds the limits, because a command jumped or a limit kept the arm from its path, it meets their
continuation some periods later. Everything is linear in these values, so one matrix product gives the path of all
cells, arms and joints.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from dual_ur10.types import Array

# Order of the values that define a path: the last three commanded positions, the one commanded now, and the path's
# current position, speed, acceleration and jerk.
GOALS = slice(0, 4)
GOAL = 3
POSITION, SPEED, ACCELERATION, JERK = 4, 5, 6, 7
STATE = slice(4, 8)
VALUES = 8


class Meeting(NamedTuple):
    """Instant at which a path meets the commanded positions again.

    Attributes:
        periods: Number of periods until then.
        points: Number of last commanded positions that their continuation passes through.
    """

    periods: int
    points: int


def meetings(period_s: float) -> tuple[Meeting, ...]:
    """Return the meetings in the order in which they are tried.

    The first follows a smooth motion within micrometres; the later ones take larger jumps at the same acceleration.
    At 25 Hz they are 5 and 10 periods; other rates keep the same time. Disturbances decay under each of them (0.91,
    0.85 and 0.96 per period at 25 Hz when every command is the path's own position; 0.61, 0.61 and 0.79 when it is a
    fixed one), and the following error that the last one leaves is small enough for the second, and likewise for the
    first. The second continues the commands by a cubic, which follows a smooth motion but may lead far off after
    discontinuous commands: the third is for those.
    """
    soon, late = max(5, round(0.2 / period_s)), max(10, round(0.4 / period_s))
    return (Meeting(1, 4), Meeting(soon, 4), Meeting(soon, 2), Meeting(late, 2))


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


def path(period_s: float, times_s: Array, meeting: Meeting) -> PathRows:
    """Return the path with a given meeting.

    Args:
        period_s: Time until the position commanded now is due.
        times_s: (k,) instants from now, 0 to `period_s`.
        meeting: Instant of meeting the commands.
    """
    horizon = meeting.periods * period_s
    unit = np.eye(VALUES)
    conditions = [(0.0, 0, unit[POSITION]), (0.0, 1, unit[SPEED]), (0.0, 2, unit[ACCELERATION])]
    conditions += [(1.0, order, row) for order, row in enumerate(continuation(period_s, meeting))]
    if meeting.periods > 1:
        # The jerk is continuous, too. With a path that ends with the period that would ring for ever: the initial jerk
        # returns at the end with the other sign.
        conditions.append((0.0, 3, unit[JERK]))
    powers = np.eye(len(conditions))
    equations = np.array([_derivative(powers, x, order) for x, order, _ in conditions])
    values = np.array([row * horizon**order for _, order, row in conditions])
    coefficients = np.linalg.solve(equations, values)
    x = np.append(times_s, period_s) / horizon
    rows = [_derivative(coefficients, x, order).T / horizon**order for order in range(4)]
    position, speed, acceleration, _ = rows
    return PathRows(position[:-1], speed[:-1], acceleration[:-1], np.stack([row[-1] for row in rows]))


def continuation(period_s: float, meeting: Meeting) -> Array:
    """Return position, speed and acceleration, (3, 8), of the commands' continuation at the meeting."""
    times = -period_s * np.arange(meeting.points)[::-1]
    fit = np.linalg.inv(np.vander(times, increasing=True))
    ahead = (meeting.periods - 1) * period_s
    rows = np.zeros((3, VALUES))
    rows[:, GOAL + 1 - meeting.points : GOAL + 1] = [_derivative(fit, ahead, order) for order in (0, 1, 2)]
    return rows


def _derivative(coefficients: Array, x: float | Array, order: int) -> Array:
    derived = polynomial.polyder(coefficients, order) if order else coefficients
    result: Array = np.asarray(polynomial.polyval(x, derived))
    return result
