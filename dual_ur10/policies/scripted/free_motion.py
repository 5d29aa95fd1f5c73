"""Time-optimal motions of both arms from rest through passing points to rest; all twelve joints arrive together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory  # type: ignore[import-not-found, unused-ignore]  # no types

from dual_ur10.errors import SettingsError
from ur_core.types import Array

_SAMPLES = 7  # of a mean over time


class Waypoint(NamedTuple):
    """Point that a motion passes, or at which it ends.

    Attributes:
        q_rad: (12,) joint positions.
        qd_rad_s: (12,) joint speeds there; zeros to stop.
        acceleration_rad_s2, jerk_rad_s3: (12,) limits of the motion to it; None: those of the motion.
    """

    q_rad: Array
    qd_rad_s: Array
    acceleration_rad_s2: Array | None = None
    jerk_rad_s3: Array | None = None


class FreeMotion:
    """Fastest motion within limits of speed, acceleration and jerk through some points.

    Args:
        q_rad: (12,) joint positions at rest at its beginning.
        waypoints: Points in their order. The motion does not stop at a point with a speed.
        speed_rad_s, acceleration_rad_s2, jerk_rad_s3: (12,) or one number: limits.
        smooth_s: Time over which positions are averaged, so that jerk does not jump.

    Raises:
        SettingsError: No motion within the limits has these speeds at the points.
    """

    def __init__(
        self,
        q_rad: Array,
        waypoints: Sequence[Waypoint],
        speed_rad_s: Array | float,
        acceleration_rad_s2: Array | float,
        jerk_rad_s3: Array | float,
        smooth_s: float = 0.0,
    ) -> None:
        speed, acceleration, jerk = (
            np.broadcast_to(each, 12) for each in (speed_rad_s, acceleration_rad_s2, jerk_rad_s3)
        )
        self._parts: list[Trajectory] = []
        self._ends: list[float] = []
        before, end = Waypoint(q_rad, np.zeros(12)), 0.0
        for waypoint in waypoints:
            wish = InputParameter(12)
            wish.current_position, wish.current_velocity = before.q_rad.tolist(), before.qd_rad_s.tolist()
            wish.target_position, wish.target_velocity = waypoint.q_rad.tolist(), waypoint.qd_rad_s.tolist()
            wish.max_velocity = speed.tolist()
            own = waypoint.acceleration_rad_s2, waypoint.jerk_rad_s3
            wish.max_acceleration = (acceleration if own[0] is None else own[0]).tolist()
            wish.max_jerk = (jerk if own[1] is None else own[1]).tolist()
            part = Trajectory(12)
            result: object
            try:
                result = Ruckig(12).calculate(wish, part)
            except RuckigError as error:
                result = error
            if result not in (Result.Working, Result.Finished):
                raise SettingsError(f"no motion within the limits leads to {waypoint.q_rad.tolist()}: {result}")
            end += part.duration
            self._parts.append(part)
            self._ends.append(end)
            before = waypoint
        self.duration_s = end + smooth_s
        self._back_s = np.linspace(0.0, smooth_s, _SAMPLES if smooth_s else 1)

    def at(self, time_s: float) -> Array:
        """Return the joint positions, (12,), at a time since the beginning; outside the motion, those at rest."""
        positions = np.array([self._exact(time_s - back_s) for back_s in self._back_s.tolist()])
        result: Array = np.add.reduce(positions, axis=0) / len(positions)
        return result

    def _exact(self, time_s: float) -> list[float]:
        part = int(np.searchsorted(self._ends[:-1], time_s, side="right"))
        since = time_s - (self._ends[part - 1] if part else 0.0)
        position, _, _ = self._parts[part].at_time(min(max(since, 0.0), self._parts[part].duration))
        return list(position)
