"""Path of both arms with continuous accelerations, made of a trajectory's segments.

The law of `servoj` is inverted with the acceleration: where that jumps, so would the targets. Near such a point of a
trajectory, a quintic polynomial replaces the ends of both segments.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.trajectory.interpolation import ORDER, Interpolation, JointMotion, PPoly, quintic
from ur_core.types import Array

ROUNDING_S: Final = 0.04
"""Time before and after a point with a jump of speed or acceleration that is rounded, at most half a segment: long
enough for the targets' jerk, at a distance from the segments below 0.02 mrad per rad/s² of the jump."""

_JUMP_RAD_S: Final = 1e-9
_JUMP_RAD_S2: Final = 1e-6  # jumps below these do not count
_SHORTEST_S: Final = 1e-9  # of a piece
_MOST_COEFFICIENT: Final = 1e100  # the motion of a goal of any duration is finite then
_FACTORIALS: Final = np.array([math.factorial(ORDER - row) for row in range(ORDER + 1)], dtype=np.float64)


class SmoothPath:
    """Positions of both arms as a function of a trajectory's time, with continuous speed and acceleration.

    Before its start and after its end the path is at rest.

    Args:
        breaks_s: (k + 1,) times at which the polynomials change.
        coefficients: (6, k, 2, 6) coefficients, the highest power first, time from each break.
        end_s: End of the motion; None: the last break.
    """

    def __init__(self, breaks_s: Array, coefficients: Array, end_s: float | None = None) -> None:
        self.polynomial = PPoly.construct_fast(np.ascontiguousarray(coefficients), np.ascontiguousarray(breaks_s))
        self._derivatives = [self.polynomial, self.polynomial.derivative(1), self.polynomial.derivative(2)]
        self.start_s, self.end_s = float(breaks_s[0]), float(breaks_s[-1]) if end_s is None else end_s

    @classmethod
    def hold(cls, q_rad: Array) -> SmoothPath:
        """Return rest at (2, 6)."""
        coefficients = np.zeros((ORDER + 1, 1, 2, 6))
        coefficients[ORDER] = q_rad
        return cls(np.array([0.0, 1.0]), coefficients, 0.0)

    @classmethod
    def of(
        cls, interpolation: Interpolation, rows: list[int], others_rad: Array, *, is_open: bool = False
    ) -> SmoothPath:
        """Return the path of a trajectory.

        A jump of speed or acceleration at its end makes the motion end `ROUNDING_S` later.

        Args:
            interpolation: The trajectory between its points.
            rows: Indices of its arms.
            others_rad: (2, 6) positions of the arms that are not in it.
            is_open: More points will follow, so that it does not end at rest.

        Raises:
            TrajectoryError: Numbers become too large between two points.
        """
        polynomial, end_s = interpolation.polynomial, interpolation.end_s
        if interpolation.start_s < end_s:
            polynomial = _rounded(polynomial)
            polynomial = polynomial if is_open else _landed(polynomial)
            end_s = float(polynomial.x[-1])
        breaks, coefficients = polynomial.x, polynomial.c
        both = np.zeros((ORDER + 1, coefficients.shape[1], 2, 6))
        both[ORDER] = others_rad
        both[:, :, rows] = coefficients
        computable = (np.abs(both) < _MOST_COEFFICIENT).all(axis=(0, 2, 3))
        if not computable.all():
            where = interpolation.trajectory.place(float(breaks[:-1][~computable][0]))
            raise TrajectoryError(
                f"the path is too steep to compute {where}: correct their times in s, and what they give in rad, rad/s "
                "and rad/s²"
            )
        return cls(breaks, both, end_s)

    def __call__(self, path_s: Array) -> JointMotion:
        """Return positions and their first two derivatives at (m,) times of the trajectory."""
        inside = np.clip(path_s, self.start_s, self.end_s)
        moves = ((path_s >= self.start_s) & (path_s < self.end_s))[:, None, None]
        q, speed, acceleration = (each(inside) for each in self._derivatives)
        return JointMotion(q, speed * moves, acceleration * moves)

    def extended(self, path_s: Array) -> JointMotion:
        """Return the same, except that the first and the last polynomial continue outside."""
        return JointMotion(*(each(path_s) for each in self._derivatives))

    def joined(self, at_s: float, now: JointMotion, meets_s: float) -> SmoothPath:
        """Return a path that leaves a motion, (2, 6) each, at one time and is this one from another time on."""
        meeting = self(np.array([meets_s]))
        first = quintic(meets_s - at_s, now, JointMotion(*(each[0] for each in meeting)))[:, None]
        if meets_s > self.end_s - _SHORTEST_S:
            return SmoothPath(np.array([at_s, meets_s]), first)
        breaks, coefficients = _between(self.polynomial, meets_s, self._last_s)
        return SmoothPath(np.append(at_s, breaks), np.concatenate([first, coefficients], axis=1), self.end_s)

    def continued(self, following: SmoothPath, at_s: float, from_s: float = -math.inf) -> SmoothPath:
        """Return this path, and from a time on the following one, which must be equal there.

        Args:
            following: The path from then on.
            at_s: That time.
            from_s: Time before which the result is not needed.
        """
        start_s = max(from_s, self.start_s)
        if at_s <= start_s + _SHORTEST_S:
            return following
        first = _between(self.polynomial, start_s, at_s)
        second = _between(following.polynomial, at_s, following._last_s)
        breaks = np.concatenate([first[0][:-1], second[0]])
        return SmoothPath(breaks, np.concatenate([first[1], second[1]], axis=1), following.end_s)

    @property
    def _last_s(self) -> float:
        return float(self.polynomial.x[-1])


def _expanded(polynomial: PPoly, starts_s: Array) -> Array:
    """Return the coefficients, (6, k, ...), of the polynomials about (k,) times."""
    values = np.stack([polynomial(starts_s, nu=ORDER - row) for row in range(ORDER + 1)])
    result: Array = values / _FACTORIALS.reshape(-1, *[1] * (values.ndim - 1))
    return result


def _rounded(polynomial: PPoly) -> PPoly:
    """Return a polynomial with rounded jumps between its first and its last break."""
    x, c = polynomial.x, polynomial.c
    h = np.diff(x)[:-1].reshape(-1, 1, 1)
    speed, acceleration = _at_ends(c[:, :-1], h)
    jumps = [np.abs(each).max(axis=(1, 2), initial=0.0) for each in (c[4, 1:] - speed, 2 * c[3, 1:] - acceleration)]
    corners = (jumps[0] > _JUMP_RAD_S) | (jumps[1] > _JUMP_RAD_S2)
    if not corners.any():
        return polynomial
    beside = np.minimum(np.diff(x)[:-1], np.diff(x)[1:]) / 2
    around = np.where(corners, np.minimum(ROUNDING_S, beside), 0.0)
    # What is left of each segment, then the rounded corners.
    starts, ends = x[:-1] + np.append(0.0, around), x[1:] - np.append(around, 0.0)
    starts = starts[ends - starts > _SHORTEST_S]
    away, back = x[1:-1][corners] - around[corners], x[1:-1][corners] + around[corners]
    start, end = (JointMotion(*(polynomial(each, nu=order) for order in range(3))) for each in (away, back))
    begins = np.concatenate([starts, away])
    pieces = np.concatenate(
        [_expanded(polynomial, starts), quintic((back - away).reshape(-1, 1, 1), start, end)], axis=1
    )
    order = np.argsort(begins, kind="stable")
    return PPoly.construct_fast(np.ascontiguousarray(pieces[:, order]), np.append(begins[order], x[-1]))


def _landed(polynomial: PPoly) -> PPoly:
    """Return a polynomial that comes to rest at its last value smoothly, `ROUNDING_S` later where it would jump."""
    x, c = polynomial.x, polynomial.c
    speed, acceleration = _at_ends(c[:, -1:], np.diff(x)[-1:].reshape(-1, 1, 1))
    if np.abs(speed).max() <= _JUMP_RAD_S and np.abs(acceleration).max() <= _JUMP_RAD_S2:
        return polynomial
    around = min(ROUNDING_S, float(x[-1] - x[0]) / 2)
    leaves_s = float(x[-1]) - around
    breaks, pieces = _between(polynomial, float(x[0]), leaves_s)
    start = JointMotion(*(polynomial(leaves_s, nu=order) for order in range(3)))
    landing = quintic(2 * around, start, JointMotion.at_rest(polynomial(x[-1])))
    return PPoly.construct_fast(np.concatenate([pieces, landing[:, None]], axis=1), np.append(breaks, x[-1] + around))


def _at_ends(c: Array, h: Array) -> tuple[Array, Array]:
    """Return speed and acceleration at the ends of polynomials."""
    speed = (((5 * c[0] * h + 4 * c[1]) * h + 3 * c[2]) * h + 2 * c[3]) * h + c[4]
    return speed, ((20 * c[0] * h + 12 * c[1]) * h + 6 * c[2]) * h + 2 * c[3]


def _between(polynomial: PPoly, start_s: float, end_s: float) -> tuple[Array, Array]:
    """Return breaks and coefficients of a part."""
    x = polynomial.x
    starts = np.append(start_s, x[(x > start_s + _SHORTEST_S) & (x < end_s - _SHORTEST_S)])
    return np.append(starts, end_s), _expanded(polynomial, starts)
