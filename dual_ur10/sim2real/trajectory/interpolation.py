"""Positions, speeds and accelerations of a joint trajectory between its points.

Segments are polynomials, as in ros2_controllers' JointTrajectoryController: linear where the points carry positions
only, cubic with speeds, quintic with accelerations, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dual_ur10.errors import MissingExtraError, TrajectoryError
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from ur_core.types import Array

try:
    from scipy.interpolate import PPoly as PPoly
    from scipy.interpolate import make_interp_spline as make_interp_spline
except ImportError:
    raise MissingExtraError("scipy", "real", "following a trajectory") from None

ORDER = 5
"""Degree of the polynomials."""


class JointMotion(NamedTuple):
    """Joint motion at m instants, or at one.

    Attributes:
        q_rad: (m, arms, 6) positions, or (arms, 6).
        qd_rad_s: Speeds, of the same shape.
        qdd_rad_s2: Accelerations, of the same shape.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array

    @classmethod
    def at_rest(cls, q_rad: Array) -> JointMotion:
        """Return rest at `q_rad`."""
        q = np.array(q_rad, dtype=np.float64)
        return cls(q, np.zeros_like(q), np.zeros_like(q))


class Interpolation:
    """Motion of a trajectory at any time. Before its first instant the first value holds, after its last the last.

    Args:
        trajectory: The trajectory.
        start: Motion of its arms at time 0, (arms, 6) each, from which a first point later than 0 is reached. Its speed
            and acceleration count where the points carry theirs. None: the trajectory begins with its first point.

    Attributes:
        polynomial: Piecewise polynomial with values (arms, 6).

    Raises:
        TrajectoryError: The shape of `start` does not fit.
    """

    def __init__(self, trajectory: JointTrajectory, start: JointMotion | None = None) -> None:
        self.trajectory = trajectory
        time, q, qd, qdd = trajectory.time_s, trajectory.q_rad, trajectory.qd_rad_s, trajectory.qdd_rad_s2
        if start is not None and time[0] > 0.0:
            if any(each.shape != q.shape[1:] for each in start):
                raise TrajectoryError(f"the start has shape {start.q_rad.shape}: it must be {q.shape[1:]}, (arms, 6)")
            time, q = np.append(0.0, time), np.concatenate([start.q_rad[None], q])
            qd = None if qd is None else np.concatenate([start.qd_rad_s[None], qd])
            qdd = None if qdd is None else np.concatenate([start.qdd_rad_s2[None], qdd])
        self.start_s, self.end_s = float(time[0]), float(time[-1])
        if len(time) == 1:  # a polynomial needs an interval
            time, q = np.append(time, time[0] + 1.0), np.repeat(q, 2, axis=0)
            qd = qdd = None
        steps = np.diff(time).reshape(-1, 1, 1)
        if qd is None:
            coefficients = linear(steps, q[:-1], q[1:])
        elif qdd is None:
            coefficients = cubic(steps, q[:-1], qd[:-1], q[1:], qd[1:])
        else:
            coefficients = quintic(steps, JointMotion(q[:-1], qd[:-1], qdd[:-1]), JointMotion(q[1:], qd[1:], qdd[1:]))
        self.polynomial = PPoly(coefficients, time)
        self._derivatives = [self.polynomial, self.polynomial.derivative(1), self.polynomial.derivative(2)]

    def __call__(self, time_s: float | Array) -> JointMotion:
        """Return the motion at (m,) times, or at one time."""
        time: Array = np.asarray(time_s, dtype=np.float64)
        inside = np.clip(time, self.start_s, self.end_s)
        moves = (time >= self.start_s) & (time < self.end_s)
        values = [each(inside) for each in self._derivatives]
        factor = moves[..., None, None]
        return JointMotion(values[0], values[1] * factor, values[2] * factor)


def linear(step_s: Array, start_rad: Array, end_rad: Array) -> Array:
    """Return the coefficients, (6, ...), of lines between positions; the highest power first, time from each start."""
    result = np.zeros((ORDER + 1, *start_rad.shape))
    result[4], result[5] = (end_rad - start_rad) / step_s, start_rad
    return result


def cubic(step_s: Array, start_rad: Array, start_rad_s: Array, end_rad: Array, end_rad_s: Array) -> Array:
    """Return the coefficients, (6, ...), of cubic Hermite polynomials."""
    mean = (end_rad - start_rad) / step_s
    result = np.zeros((ORDER + 1, *start_rad.shape))
    result[2] = (start_rad_s + end_rad_s - 2.0 * mean) / step_s**2
    result[3] = (3.0 * mean - 2.0 * start_rad_s - end_rad_s) / step_s
    result[4], result[5] = start_rad_s, start_rad
    return result


def quintic(step_s: Array | float, start: JointMotion, end: JointMotion) -> Array:
    """Return the coefficients, (6, ...), of quintic Hermite polynomials."""
    away = end.q_rad - start.q_rad - (start.qd_rad_s + start.qdd_rad_s2 * step_s / 2) * step_s
    faster = (end.qd_rad_s - start.qd_rad_s - start.qdd_rad_s2 * step_s) * step_s
    bent = (end.qdd_rad_s2 - start.qdd_rad_s2) * step_s**2
    return np.stack(
        [
            (6.0 * away - 3.0 * faster + bent / 2) / step_s**5,
            (-15.0 * away + 7.0 * faster - bent) / step_s**4,
            (10.0 * away - 4.0 * faster + bent / 2) / step_s**3,
            start.qdd_rad_s2 / 2,
            start.qd_rad_s,
            start.q_rad,
        ]
    )
