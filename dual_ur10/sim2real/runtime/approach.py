"""Plan of the slow approach to a start: straight in joint space, around what is in the way where it is not free."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from dual_ur10.errors import PlanningError, StartError, distinguishable
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import nearest_on_straight, plan_path
from ur_core.kinematics.forward import elbow_flange_and_tcp
from ur_core.kinematics.ur10 import ARMS, JOINT_RANGE_RAD, JOINTS
from ur_core.types import Array, Vector3

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell.cell_config import CellConfig

SPEED_RAD_S: Final = 0.2
TCP_SPEED_M_S: Final = 0.25
"""Largest speeds of a joint, and of flange, elbow and tool centre point, during an approach: reduced speed of ISO
10218-1."""

ACCELERATION_RAD_S2: Final = 0.5

_SPEED_FRACTION: Final = 0.9  # of a speed limit
_END_RAD: Final = 0.1  # margin to a joint's range inside which no approach begins: an extra turn is near
_ROUNDING_M: Final = 1e-6  # apparent decrease of a distance that stays equal
_STEP_RAD: Final = 0.02  # between configurations at which Cartesian speeds are computed
# Peaks of the quintic polynomial from rest to rest.
_PEAK_SPEED, _PEAK_ACCELERATION, _PEAK_JERK = 1.875, 10 / math.sqrt(3), 60.0


@dataclass(frozen=True)
class Rates:
    """Largest rates of an approach in real time.

    Attributes:
        robots: Models of the left and the right arm.
        speed_rad_s: Joint speed.
        tcp_speed_m_s: Cartesian speed of flange, elbow and tool centre point.
        acceleration_rad_s2: Joint acceleration.
        jerk_rad_s3: Joint jerk.
        tcp_m: Tool centre point of the left and the right arm in its flange's frame.
    """

    robots: tuple[str, str]
    speed_rad_s: float = SPEED_RAD_S
    tcp_speed_m_s: float = TCP_SPEED_M_S
    acceleration_rad_s2: float = ACCELERATION_RAD_S2
    jerk_rad_s3: float = math.inf
    tcp_m: tuple[Vector3, Vector3] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def capped(self, config: CellConfig) -> Rates:
        """Return these rates capped by a cell's limits."""
        arms = ("tcp_m", "robots")
        own = {each.name: getattr(config, each.name) for each in fields(self) if each.name not in arms}
        given = {name: min(value, getattr(self, name)) for name, value in own.items() if value is not None}
        return replace(self, tcp_m=config.tcp_m, robots=config.robots, **given)

    def within(self, limits: MotionLimits, speed_factor: float) -> Rates:
        """Return these rates capped by what the safety gate releases under limits in task time."""
        return Rates(
            limits.robots,
            min(self.speed_rad_s, _SPEED_FRACTION * min(limits.speed_rad_s) * speed_factor),
            min(self.tcp_speed_m_s, _SPEED_FRACTION * limits.tcp_speed_m_s * speed_factor),
            # Half of it, as the brake may begin while the arms still accelerate.
            min(self.acceleration_rad_s2, limits.acceleration_rad_s2 / 2 * speed_factor**2),
            min(self.jerk_rad_s3, limits.jerk_rad_s3 / 2 * speed_factor**3),
            limits.tcp_m,
        )


def retreat_clearance(clearance: Clearance, start_rad: Array) -> Clearance:
    """Return distances for a path whose start may be too close: such pairs may separate, and come no closer.

    Args:
        clearance: Computes distances.
        start_rad: (2, 6) start of the path.
    """
    short = -clearance.spare_m(np.asarray(start_rad).reshape(1, 12))[0]
    return clearance.granting(np.where(short > 0.0, short + _ROUNDING_M, 0.0))


class Approach:
    """Piecewise straight path of both arms in joint space, from rest to rest on every part.

    Args:
        parts: (k, 12) configurations at the ends of the parts.
        rates: Largest rates in real time.
        speed_factor: Rate of task time in real time; the approach takes the same real time at any.
        detour: Reason why the path is not straight; empty: it is.
    """

    def __init__(
        self, parts: Sequence[Array] | Array, rates: Rates, speed_factor: float = 1.0, detour: str = ""
    ) -> None:
        self.parts: Array = np.array(parts)
        self.detour = detour
        self._speed_factor, self._rates = speed_factor, rates
        self.durations_s = [self._duration_s(*ends) for ends in itertools.pairwise(self.parts)]

    @property
    def duration_s(self) -> float:
        """Duration in real time."""
        return sum(self.durations_s)

    def _duration_s(self, start: Array, end: Array) -> float:
        distance = float(np.abs(end - start).max())
        if distance == 0.0:
            return 0.0
        fractions = np.linspace(0.0, 1.0, 2 + math.ceil(distance / _STEP_RAD))
        along = start + fractions[:, None] * (end - start)
        points = elbow_flange_and_tcp(along.reshape(-1, 2, 6), self._rates.tcp_m, self._rates.robots)
        tip = float(np.linalg.norm(np.diff(points, axis=0), axis=-1).max()) / (fractions[1] - fractions[0])
        rates = self._rates
        by_speed: float = _PEAK_SPEED * max(distance / rates.speed_rad_s, tip / rates.tcp_speed_m_s)
        by_acceleration = math.sqrt(_PEAK_ACCELERATION * distance / rates.acceleration_rad_s2)
        return max(by_speed, by_acceleration, math.cbrt(_PEAK_JERK * distance / rates.jerk_rad_s3))

    def targets(self, tick_s: float) -> Array:
        """Return the targets, (ticks, 2, 6), without the first configuration, with the last."""
        rows = []
        for (start, end), duration_s in zip(itertools.pairwise(self.parts), self.durations_s, strict=True):
            ticks = math.ceil(duration_s * self._speed_factor / tick_s)
            time = np.arange(1, ticks + 1) / max(ticks, 1)
            eased = time**3 * (10.0 - 15.0 * time + 6.0 * time**2)
            rows.append(start + eased[:, None] * (end - start))
        last = self.parts[-1][None]
        return np.concatenate([*rows, last]).reshape(-1, 2, 6)


def plan(
    q_rad: Array,
    goal_rad: Array,
    clearance: Clearance,
    rates: Rates,
    speed_factor: float = 1.0,
    *,
    limits: MotionLimits | None = None,
    arms: Sequence[str] = ARMS,
) -> Approach:
    """Return an approach on which no pair comes closer than the gate allows, or than it is at the beginning.

    The same ends give the same path.

    Args:
        q_rad: (2, 6) current configuration.
        goal_rad: (2, 6) goal.
        clearance: Computes distances.
        rates: See `Approach`.
        speed_factor: See `Approach`.
        limits: Limits whose joint range holds; None: the widest.
        arms: Arms that move.

    Raises:
        StartError: A joint is near the end of its range, or no path was found.
    """
    start, goal = np.array(q_rad).reshape(12), np.array(goal_rad).reshape(12)
    allowed: Array = JOINT_RANGE_RAD - _END_RAD
    outside = ~(np.abs(start) <= np.tile(allowed, 2))
    if outside.any():
        arm, joint = divmod(int(outside.argmax()), 6)
        found, most = distinguishable(float(start[outside][0]), float(allowed[joint]))
        raise StartError(f"{ARMS[arm]}: {JOINTS[joint]} is at {found} rad, allowed are ±{most}: rotate it back by hand")
    try:
        parts = plan_path(clearance, start, goal, limits or MotionLimits(), np.random.default_rng(0), arms=arms)
    except PlanningError as error:
        raise StartError(f"the arms cannot move from where they are to the start of the task: {error}") from None
    detour = nearest_on_straight(clearance, start, goal) if len(parts) > 2 else ""
    return Approach(parts, rates, speed_factor, detour)
