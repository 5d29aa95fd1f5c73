"""Reduction of a trajectory to few points, with a bound on its deviation that holds at all times.

Between two points of the trajectory, it and its reduction are polynomials, and so is their difference. In the Bernstein
basis the largest coefficient bounds a polynomial on its whole interval, so that no peak between samples is missed.
"""

from __future__ import annotations

import math
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from dual_ur10.errors import TrajectoryError, UnknownNameError
from dual_ur10.sim2real.trajectory.interpolation import ORDER, Interpolation
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from ur_core.types import Array

Kind = Literal["cubic", "linear"]
"""Interpolation between the points that are left: with their speeds, or without."""

BOUND_RAD: Final = 1e-3
"""Default bound: 1.3 mm at the end of a stretched arm if one joint near the base uses all of it."""

_ROUNDING_RAD: Final = 1e-12
_PRECISION: Final = 0.01  # to which the smallest bound is searched for


def _bernstein(degree: int) -> Array:
    """Return the matrix, (6, degree + 1), from powers on [0, 1] to Bernstein coefficients of degree `ORDER`."""
    rows = [[math.comb(i, j) / math.comb(ORDER, j) for j in range(degree + 1)] for i in range(ORDER + 1)]
    return np.array(rows)


_QUINTIC, _CUBIC = _bernstein(5), _bernstein(3)


class Reduction(NamedTuple):
    """Trajectory of few points.

    Attributes:
        trajectory: Points of the original one, with speeds if they are joined by cubic polynomials.
        deviation_rad: Bound on the distance of every joint from the original one at every time.
    """

    trajectory: JointTrajectory
    deviation_rad: float


def reduce_points(
    trajectory: JointTrajectory, points: int, bound_rad: float | None = BOUND_RAD, kind: Kind = "cubic"
) -> Reduction:
    """Return a trajectory of few points of another one, first and last included, that deviates little from it.

    Args:
        trajectory: The original one.
        points: Largest number of points, 2 or more.
        bound_rad: Largest deviation of any joint at any time: as few points as it needs are used. None: the smallest
            deviation that `points` reach.
        kind: Interpolation between the points.

    Raises:
        TrajectoryError: `points` do not reach the bound, or a value is not legal.
        UnknownNameError: There is no such interpolation.
    """
    if kind not in get_args(Kind):
        raise UnknownNameError("interpolation", str(kind), get_args(Kind))
    if points < 2:
        raise TrajectoryError(f"a trajectory was to be reduced to {points} points: it needs 2 or more")
    if bound_rad is not None and not 0.0 < bound_rad < math.inf:
        raise TrajectoryError(f"bound_rad is {bound_rad!r}: it must be above 0 and finite")
    original = _Original(trajectory, kind)
    if bound_rad is not None:
        kept, deviation = original.within(bound_rad)
        if len(kept) <= points and deviation <= bound_rad:
            return Reduction(original.part(kept), deviation)
    kept, deviation = original.best(points)
    if bound_rad is None or deviation <= bound_rad:
        return Reduction(original.part(kept), deviation)
    raise TrajectoryError(
        f"{points} points joined by {kind} polynomials deviate by up to {1e3 * deviation:.4g} mrad, allowed are "
        f"{1e3 * bound_rad:.4g}: make the trajectory smoother, or divide it into shorter ones"
    )


class _Original:
    """Trajectory to reduce, as Bernstein polynomials between its points."""

    def __init__(self, trajectory: JointTrajectory, kind: Kind) -> None:
        self._trajectory, self._is_cubic = trajectory, kind == "cubic"
        self._time, count = trajectory.time_s, len(trajectory)
        self._q = trajectory.q_rad.reshape(count, -1)
        self._speed = np.zeros_like(self._q)
        if self._is_cubic and trajectory.qd_rad_s is not None:
            self._speed = trajectory.qd_rad_s.reshape(count, -1)
        elif self._is_cubic and count > 2:
            # At rest at both ends, as any goal ends.
            self._speed[1:-1] = np.gradient(self._q, self._time, axis=0)[1:-1]
        self._step = np.diff(self._time)[:, None]
        powers = Interpolation(trajectory).polynomial.c[::-1].reshape(ORDER + 1, -1, self._q.shape[1])[:, : count - 1]
        scaled = powers * self._step ** np.arange(ORDER + 1)[:, None, None]
        self._bernstein: Array = np.einsum("ij,jkl->ikl", _QUINTIC, scaled)

    def deviation(self, first: int, last: int) -> float:
        """Return a bound on the deviation of one polynomial between two points."""
        start, length = self._time[first], self._time[last] - self._time[first]
        rise = self._q[last] - self._q[first]
        mean = rise / length
        powers = np.zeros((4, len(rise)))
        powers[:2] = self._q[first], rise
        if self._is_cubic:
            leaves, arrives = self._speed[first], self._speed[last]
            powers[1:] = (
                leaves * length,
                (3 * mean - 2 * leaves - arrives) * length,
                (leaves + arrives - 2 * mean) * length,
            )
        at = ((self._time[first:last] - start) / length)[:, None]
        step = self._step[first:last] / length
        # The same polynomial about the beginning of each part, in units of its duration.
        zero, one, two, three = powers
        parts = np.stack(
            [
                zero + at * (one + at * (two + at * three)),
                step * (one + at * (2 * two + 3 * at * three)),
                step**2 * (two + 3 * at * three),
                step**3 * three + 0.0 * at,
            ]
        )
        difference = np.einsum("ij,jkl->ikl", _CUBIC, parts) - self._bernstein[:, first:last]
        return float(np.abs(difference).max()) + _ROUNDING_RAD

    def within(self, bound_rad: float) -> tuple[list[int], float]:
        """Return points, each as far from the one before as the bound allows, and the bound that they keep.

        It is larger than the given one where neighbours deviate more.
        """
        kept, worst, last = [0], 0.0, len(self._time) - 1
        while kept[-1] < last:
            here = kept[-1]
            near, deviation, far = here + 1, self.deviation(here, here + 1), last + 1
            reach = 2
            while near + 1 < far:  # doubled steps until it is too far, then halved ones
                tried = min(here + reach, last) if far > last else (near + far) // 2
                found = self.deviation(here, tried)
                if found <= bound_rad:
                    near, deviation, reach = tried, found, 2 * reach
                else:
                    far = tried
            kept.append(near)
            worst = max(worst, deviation)
        return kept, worst

    def best(self, points: int) -> tuple[list[int], float]:
        """Return at most so many points with nearly the smallest deviation."""
        if len(self._time) == 1:
            return [0], 0.0
        kept, low = [0, len(self._time) - 1], 0.0
        high = self.deviation(*kept)
        while high - low > _PRECISION * high and high > 2 * _ROUNDING_RAD:
            middle = (low + high) / 2 if low else high / 4
            found, deviation = self.within(middle)
            if len(found) <= points and deviation <= middle:
                kept, high = found, deviation
            else:
                low = middle
        return kept, high

    def part(self, kept: list[int]) -> JointTrajectory:
        """Return some points."""
        shape = (len(kept), *self._trajectory.q_rad.shape[1:])
        speeds = self._speed[kept].reshape(shape) if self._is_cubic else None
        return JointTrajectory(self._trajectory.arms, self._time[kept], self._q[kept].reshape(shape), speeds)
