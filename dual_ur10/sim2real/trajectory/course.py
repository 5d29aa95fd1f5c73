"""Motion of both arms along a path whose time passes at a rate that changes smoothly."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.sim2real.trajectory.interpolation import JointMotion, quintic
from dual_ur10.sim2real.trajectory.smooth_path import SmoothPath
from ur_core.types import Array

_LONG_AGO_S: Final = -1e9


class Rate(NamedTuple):
    """Rate of a trajectory's time: constant, or on its way to another value.

    Attributes:
        time_s: Time from which on it is valid.
        path_s: Time of the trajectory then.
        coefficients: (7,) polynomial of the trajectory's time until then, the highest power first.
        duration_s: Time until the rate is constant.
        goal: Rate from then on.
    """

    time_s: float
    path_s: float
    coefficients: Array
    duration_s: float
    goal: float

    @classmethod
    def constant(cls, time_s: float, path_s: float, rate: float) -> Rate:
        """Return a constant rate from a time on."""
        return cls(time_s, path_s, np.zeros(7), 0.0, rate)

    def __call__(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Return the trajectory's time, (m,), and its first two derivatives."""
        passed = time_s - self.time_s
        if not self.duration_s:
            return self.path_s + self.goal * passed, np.full(len(time_s), self.goal), np.zeros(len(time_s))
        changing = np.clip(passed, 0.0, self.duration_s)
        ahead = self.path_s + np.polyval(self.coefficients, changing) + self.goal * (passed - changing)
        first = np.polyder(self.coefficients)
        changes = passed < self.duration_s
        rate = np.where(changes, np.polyval(first, changing), self.goal)
        return ahead, rate, np.where(changes, np.polyval(np.polyder(first), changing), 0.0)

    def at(self, time_s: float) -> float:
        """Return the rate at a time."""
        return float(self(np.array([time_s]))[1][0])

    def towards(self, goal: float, time_s: float, duration_s: float) -> Rate:
        """Return the rate that leaves this one at a time and reaches another value after a duration.

        Its first two derivatives are continuous.
        """
        path, rate, slope = (float(each[0]) for each in self(np.array([time_s])))
        bend = 0.0
        if self.duration_s and time_s - self.time_s < self.duration_s:
            bend = float(np.polyval(np.polyder(self.coefficients, 3), time_s - self.time_s))
        begins, ends = (JointMotion(*map(np.array, each)) for each in ((rate, slope, bend), (goal, 0.0, 0.0)))
        coefficients = np.asarray(np.polyint(quintic(duration_s, begins, ends)), dtype=np.float64)
        return Rate(time_s, path, coefficients, duration_s, goal)


class Course(NamedTuple):
    """Motion of both arms: a path, and the rate at which its time passes."""

    path: SmoothPath
    rate: Rate

    @classmethod
    def hold(cls, q_rad: Array) -> Course:
        """Return rest at (2, 6)."""
        return cls(SmoothPath.hold(q_rad), Rate.constant(_LONG_AGO_S, 0.0, 0.0))

    def __call__(self, time_s: Array) -> JointMotion:
        """Return the motion at (m,) times, (m, 2, 6) each."""
        path_s, rate, slope = self.rate(time_s)
        q, first, second = self.path(path_s)
        rate, slope = rate[:, None, None], slope[:, None, None]
        return JointMotion(q, first * rate, second * rate**2 + first * slope)

    def path_s(self, time_s: float) -> float:
        """Return the trajectory's time."""
        return float(self.rate(np.array([time_s]))[0][0])

    def is_over(self, time_s: float) -> bool:
        """Return True once the motion has ended."""
        stopped = self.rate.goal == 0.0 and time_s >= self.rate.time_s + self.rate.duration_s
        return stopped or self.path_s(time_s) >= self.path.end_s
