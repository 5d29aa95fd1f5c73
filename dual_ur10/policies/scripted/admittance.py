"""Compliant motions of both tools for scripts: they yield to the measured forces on their grippers."""

from __future__ import annotations

import math

import numpy as np

from dual_ur10.policies.scripted.motions import Motions, Steps
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_conjugate, rotate
from ur_core.types import Array


class Admittance:
    """Paths of both tools that yield: their speed aside is proportional to the forces on the grippers.

    The forces are those of the field `force_n` of observations, so that a script yields alike in simulation and on
    controllers. What it commands are actions, within all limits. The gain times the stiffness of the contact is the
    rate at which an error of the force decays: 1e-4 m/(s·N) on 10 N/mm is 1 rad/s. With the delay of measurement and
    action it should stay below about 5 rad/s.

    Args:
        arms: Motions of both tools.
        speed_m_s_n: Speed in m/s for each N.
        dead_n: Errors of the force along each axis that do not count.
        most_m_s: Largest speed along each axis.
        smooth_s: Time constant of the smoothed forces.

    Attributes:
        force_n: (2, 3) smoothed forces of the objects on both grippers, in the frames of the tools.
        moved_m: (2, 3) translations of the tools from their paths, in these frames.
    """

    def __init__(
        self, arms: Motions, speed_m_s_n: float, dead_n: float = 0.0, most_m_s: float = 0.02, smooth_s: float = 0.1
    ) -> None:
        self._arms, self._speed_m_s_n, self._dead_n, self._most_m_s = arms, speed_m_s_n, dead_n, most_m_s
        self._ratio = min(1.0, arms.period_s / smooth_s)
        self._zero_n = np.zeros((2, 3))
        self.force_n: Array = np.zeros((2, 3))
        self.moved_m: Array = np.zeros((2, 3))

    def tare(self, time_s: float = 0.5) -> Steps:
        """Keep both tools where they are for a time, and count the forces from their mean in it."""
        found = []
        for _ in range(max(1, math.ceil(time_s / self._arms.period_s))):
            yield from self._arms.hold(self._arms.period_s)
            found.append(self._measured_n())
        self._zero_n, self.force_n = np.mean(found, axis=0), np.zeros((2, 3))

    def step(self, tools: Poses, free: Array, wanted_n: Array | float = 0.0) -> Steps:
        """Command poses of both tools, moved by what they have yielded: one action.

        Args:
            tools: Poses on the paths of both tools.
            free: (2, 3) factors of the speed along the axes of the tools; 0: a tool does not yield along it.
            wanted_n: (2, 3) forces of the objects on the grippers at which the tools do not yield.

        Raises:
            UnreachableError: A pose cannot be reached.
        """
        error_n = self.force_n - wanted_n
        counted_n = error_n - np.clip(error_n, -self._dead_n, self._dead_n)
        speed_m_s = np.clip(self._speed_m_s_n * free * counted_n, -self._most_m_s, self._most_m_s)
        self.moved_m = self.moved_m + speed_m_s * self._arms.period_s
        yield from self._arms.step(Poses(tools.position_m + rotate(tools.quat, self.moved_m), tools.quat))
        self.force_n = self.force_n + self._ratio * (self._measured_n() - self._zero_n - self.force_n)

    def _measured_n(self) -> Array:
        return rotate(quat_conjugate(self._arms.tools.quat), self._arms.vector("force_n"))
