"""Motions in joint space, as functions of their own time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Final

import numpy as np

from dual_ur10.kinematics.ur10 import JOINT_SPEED_RAD_S
from dual_ur10.types import Array

ACCELERATION_LIMIT_RAD_S2: Final = 40.0
"""Greatest acceleration that a program gets: what ur_rtde's argument checks and UR's manual allow it to ask for."""

_TINY: Final = 1e-300

TIME_EPSILON_S: Final = 1e-9
"""Times nearer than this are the same: what is left by adding up ticks."""

_NO_WAY: Final = 1e-12
"""Distances below this are none."""

_SLOWEST_RATE: Final = 1e-100

_RAMP_SHARE: Final = 1 / 3
"""Share of each ramp in a move whose time is given; UR publishes no figure."""


class Trapezoid:
    """Accelerate, go on, decelerate at the same rate.

    Args:
        distance: How far, of whatever leads the move; zero takes no time.
        speed: Greatest speed.
        acceleration: Of both ramps.

    Attributes:
        duration: s.
        ramp: Time of each ramp, s.
    """

    def __init__(self, distance: float, speed: float, acceleration: float) -> None:
        self.duration = self.ramp = 0.0
        self._speed = self._acceleration = 0.0  # of the share, 1/s and 1/s²
        if distance > _NO_WAY:
            speed, acceleration = max(speed, _SLOWEST_RATE), max(acceleration, _SLOWEST_RATE)
            # Too short a way to reach the speed makes it a triangle.
            peak = min(speed, math.sqrt(acceleration * distance))
            self.ramp = peak / acceleration
            self.duration = distance / peak + self.ramp
            self._speed, self._acceleration = peak / distance, acceleration / distance

    @classmethod
    def timed(cls, distance: float, time: float, speed: float, acceleration: float) -> Trapezoid:
        """The profile of a move that takes `time`, or longer where `speed` and `acceleration` do not allow that."""
        if distance <= _NO_WAY:
            still = cls(0.0, speed, acceleration)
            still.duration = time
            return still
        peak = distance / (time * (1 - _RAMP_SHARE))
        ramp = time * _RAMP_SHARE
        if peak > speed:
            peak, ramp = speed, max(time - distance / speed, speed / acceleration)
        if peak > acceleration * ramp:
            # Ramps as long as it takes: the lower speed that solves distance = peak (time - peak / acceleration).
            root = time * time - 4 * distance / acceleration
            peak = min(speed, acceleration * (time - math.sqrt(root)) / 2) if root > 0.0 else speed
            ramp = peak / acceleration
        return cls(distance, peak, peak / ramp)

    def share(self, t: float) -> float:
        """Share of the way that is behind after `t`, 0 to 1."""
        left = self.duration - t
        if left <= TIME_EPSILON_S:
            return 1.0
        if t <= 0.0:
            return 0.0
        if t < self.ramp:
            return 0.5 * self._acceleration * t * t
        if left < self.ramp:
            return 1.0 - 0.5 * self._acceleration * left * left
        return self._speed * (t - 0.5 * self.ramp)

    def slope(self, t: float) -> float:
        """Share of the way per second at `t`."""
        left = self.duration - t
        if left <= TIME_EPSILON_S or t <= 0.0:
            return 0.0
        return min(self._speed, self._acceleration * min(t, left))

    def decelerates(self, t: float) -> bool:
        """Whether the move slows down at `t` to stop."""
        return self.duration - t <= self.ramp + TIME_EPSILON_S


class Trajectory(ABC):
    """A motion.

    Attributes:
        t: Its time, s.
        duration: When it has come to rest, s; infinite if it does not by itself.
        streamed: Whether a program has to go on commanding it.
        governed: Whether its time may be slowed down so that joints keep their speed limits. What is not governed
            limits its speeds itself.
    """

    t: float = 0.0
    duration: float = 0.0
    streamed: bool = False
    governed: bool = False
    ticks_left: int = 0

    @abstractmethod
    def positions(self, step: float, counts: Array) -> Array:
        """Joint positions (n, 6) at `step * counts` from now; without any effect on the trajectory.

        Raises:
            UnreachableError: The trajectory leaves the workspace.
        """

    def commit(self, time: float) -> None:
        """Let `time` pass, after `positions` of the same time."""
        self.t += time

    def rate(self) -> Array | None:
        """Joint speeds (6,) now, or None: those of the last positions."""
        return None

    @property
    def finished(self) -> bool:
        """Whether it has come to rest."""
        return self.t >= self.duration - TIME_EPSILON_S

    @property
    def returns(self) -> bool:
        """Whether the program that commanded it may go on."""
        return self.finished


class JointMove(Trajectory):
    """From rest to rest, all joints in the same time.

    Args:
        start: (6,).
        target: (6,).
        acceleration: Of the joint that moves farthest, rad/s².
        speed: Of the same, rad/s; less where another joint would exceed its limit.
        time: If above 0, in this time, whatever `acceleration` and `speed` are.
        blend_m: Blend radius.
    """

    governed = True

    def __init__(
        self, start: Array, target: Array, acceleration: float, speed: float, time: float = 0.0, blend_m: float = 0.0
    ) -> None:
        self._start, self.end, self._way = start, target, target - start
        self.blend_m = blend_m
        way = np.abs(self._way)
        distance = float(way.max())
        limit = distance / float((way / JOINT_SPEED_RAD_S).max()) if distance else 1.0
        if time > 0.0:
            self.profile = Trapezoid.timed(distance, time, limit, ACCELERATION_LIMIT_RAD_S2)
        else:
            self.profile = Trapezoid(distance, min(speed, limit), min(acceleration, ACCELERATION_LIMIT_RAD_S2))
        self.duration = self.profile.duration

    def positions(self, step: float, counts: Array) -> Array:
        """Joint positions (n, 6); see `Trajectory`."""
        share = self.profile.share
        shares = [share(self.t + step * count) for count in range(1, len(counts) + 1)]
        q = self._start + np.multiply.outer(shares, self._way)
        if shares[-1] == 1.0:
            q[[each == 1.0 for each in shares]] = self.end
        return q

    def rate(self) -> Array:
        """Joint speeds (6,) now."""
        return self._way * self.profile.slope(self.t)


class JointBrake(Trajectory):
    """From a speed to rest.

    Args:
        start: (6,).
        rate: (6,) speed.
        times: (6,) until each joint stands.
    """

    def __init__(self, start: Array, rate: Array, times: Array) -> None:
        self._start, self._rate, self._times = start, rate, np.maximum(times, _TINY)
        self.end: Array = start + 0.5 * rate * times
        self.duration = float(times.max())

    @classmethod
    def together(cls, start: Array, rate: Array, time: float) -> JointBrake:
        """All joints stand after `time`."""
        return cls(start, rate, np.full(6, time))

    def positions(self, step: float, counts: Array) -> Array:
        """Joint positions (n, 6); see `Trajectory`."""
        t = np.minimum((self.t + step * counts)[:, None], self._times)
        q: Array = self._start + self._rate * (t - t * t / (2 * self._times))
        if self.t + step * counts[-1] >= self.duration - TIME_EPSILON_S:
            q[-1] = self.end
        return q

    def rate(self) -> Array:
        """Joint speeds (6,) now."""
        left: Array = self._rate * (1.0 - np.minimum(self.t / self._times, 1.0))
        return left


class SpeedJoints(Trajectory):
    """To given joint speeds at an acceleration, and on with them.

    Args:
        start: (6,).
        rate: (6,) speed at the start.
        target: (6,) speed asked for.
        acceleration: Of the joint whose speed changes most, rad/s².
        ticks: After how many ticks the program may go on; 0: when the speed is reached.
    """

    streamed = True
    duration = float("inf")

    def __init__(self, start: Array, rate: Array, target: Array, acceleration: float, ticks: int) -> None:
        change = target - rate
        self._start, self._rate, self._target = start, rate, target
        self._reached_s = float(np.abs(change).max()) / acceleration
        self._acceleration = change / self._reached_s if self._reached_s > 0.0 else np.zeros(6)
        self._timed, self.ticks_left = ticks > 0, ticks

    def positions(self, step: float, counts: Array) -> Array:
        """Joint positions (n, 6); see `Trajectory`."""
        t = self.t + step * counts[:, None]
        ramp = np.minimum(t, self._reached_s)
        q: Array = self._start + self._rate * ramp + (0.5 * ramp * ramp) * self._acceleration
        q += (t - ramp) * self._target
        return q

    def rate(self) -> Array:
        """Joint speeds (6,) now."""
        speed: Array = self._rate + min(self.t, self._reached_s) * self._acceleration
        return speed

    @property
    def returns(self) -> bool:
        """Whether the program may go on."""
        return self.ticks_left <= 0 if self._timed else self.t >= self._reached_s - TIME_EPSILON_S


class Superposed(Trajectory):
    """A move that starts before the motion before it has ended: the sum of both displacements.

    Args:
        main: The move; it starts where `ending` ends.
        ending: The motion before.
        end: (6,) where `ending` ends.
    """

    governed = True

    def __init__(self, main: Trajectory, ending: Trajectory, end: Array) -> None:
        self.main, self.ending, self._end = main, ending, end

    def positions(self, step: float, counts: Array) -> Array:
        """Joint positions (n, 6); see `Trajectory`."""
        q: Array = self.main.positions(step, counts) + (self.ending.positions(step, counts) - self._end)
        return q

    def commit(self, time: float) -> None:
        """Let `time` pass."""
        self.main.commit(time)
        self.ending.commit(time)

    def rate(self) -> Array | None:
        """Joint speeds (6,) now, or None."""
        main, ending = self.main.rate(), self.ending.rate()
        return None if main is None or ending is None else main + ending

    @property
    def finished(self) -> bool:
        """Whether it has come to rest."""
        return self.main.finished and self.ending.finished
