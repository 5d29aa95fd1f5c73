"""Trapezoidal speed profiles, and trajectories in joint space."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

import numpy as np

from ur_core.types import Array

ACCELERATION_LIMIT_RAD_S2: Final = 40.0
"""Greatest acceleration of programs: the limit of ur_rtde's argument checks and of UR's manual."""

_TINY: Final = 1e-300

TIME_EPSILON_S: Final = 1e-9
"""Times that differ by less are equal: rounding errors of added ticks."""

_NO_DISTANCE: Final = 1e-12
"""Distances below this are zero."""

_SLOWEST_RATE: Final = 1e-100

_RAMP_FRACTION: Final = 1 / 3
"""Fraction of each ramp in a move of given duration; UR publishes no figure."""


@dataclass(frozen=True)
class JointTorques:
    """Torques of one control period.

    Attributes:
        torque_nm: (6,) torques on top of those that carry the arm itself.
        coulomb_scale: (6,) fraction of each joint's Coulomb friction that the controller compensates.
    """

    torque_nm: Array
    coulomb_scale: Array


class Trapezoid:
    """Trapezoidal speed profile: accelerate, hold the speed, decelerate at the same rate.

    Args:
        distance: Distance of the leading quantity; zero takes no time.
        speed: Greatest speed.
        acceleration: Acceleration of both ramps.

    Attributes:
        duration: s.
        ramp: Duration of each ramp, s.
    """

    def __init__(self, distance: float, speed: float, acceleration: float) -> None:
        self.duration = self.ramp = 0.0
        self._speed = self._acceleration = 0.0  # of the fraction, 1/s and 1/s²
        if distance > _NO_DISTANCE:
            speed, acceleration = max(speed, _SLOWEST_RATE), max(acceleration, _SLOWEST_RATE)
            # A distance too short to reach the speed makes it a triangle.
            peak = min(speed, math.sqrt(acceleration * distance))
            self.ramp = peak / acceleration
            self.duration = distance / peak + self.ramp
            self._speed, self._acceleration = peak / distance, acceleration / distance

    @classmethod
    def timed(cls, distance: float, time: float, speed: float, acceleration: float) -> Trapezoid:
        """Return a profile of given duration, or a longer one where `speed` and `acceleration` require it."""
        if distance <= _NO_DISTANCE:
            still = cls(0.0, speed, acceleration)
            still.duration = time
            return still
        peak = distance / (time * (1 - _RAMP_FRACTION))
        ramp = time * _RAMP_FRACTION
        if peak > speed:
            peak, ramp = speed, max(time - distance / speed, speed / acceleration)
        if peak > acceleration * ramp:
            # Longer ramps: the lower speed that solves distance = peak (time - peak / acceleration).
            root = time * time - 4 * distance / acceleration
            peak = min(speed, acceleration * (time - math.sqrt(root)) / 2) if root > 0.0 else speed
            ramp = peak / acceleration
        return cls(distance, peak, peak / ramp)

    def fraction(self, t: float) -> float:
        """Return the fraction of the distance covered after `t`, 0 to 1."""
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
        """Return the fraction of the distance per second at `t`."""
        left = self.duration - t
        if left <= TIME_EPSILON_S or t <= 0.0:
            return 0.0
        return min(self._speed, self._acceleration * min(t, left))

    def decelerates(self, t: float) -> bool:
        """Return True if the final deceleration has begun at `t`."""
        return self.duration - t <= self.ramp + TIME_EPSILON_S


class Trajectory(ABC):
    """Joint positions as a function of time.

    Attributes:
        t: Elapsed time, s.
        duration: Time at which the arm stops, s; infinite if it does not stop by itself.
        streamed: Whether a program has to keep commanding it.
        governed: Whether its time may be slowed down so that joints keep their limits. Other trajectories keep them
            themselves.
        pace: Its time per time of the program, 0 to 1, at the end of the last tick.
        slope: (6,) joint speeds per pace in the last physics step, or None at the start.
        most_rad_s2: Greatest acceleration of a joint, if governed.
        torques: Torques under which the arm moves; None: it follows the positions.
    """

    t: float = 0.0
    pace: float = 1.0
    slope: Array | None = None
    most_rad_s2: float = ACCELERATION_LIMIT_RAD_S2
    duration: float = 0.0
    streamed: bool = False
    governed: bool = False
    ticks_left: int = 0
    torques: JointTorques | None = None

    @abstractmethod
    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6) at `step * counts` from now, without changing the trajectory.

        Raises:
            UnreachableError: The trajectory leaves the workspace.
        """

    def commit(self, time: float) -> None:
        """Advance by `time`, after `positions` of the same time."""
        self.t += time

    def rate(self) -> Array | None:
        """Return the joint speeds (6,) now, or None for those of the last positions."""
        return None

    @property
    def finished(self) -> bool:
        """True once the arm has stopped."""
        return self.t >= self.duration - TIME_EPSILON_S

    @property
    def returns(self) -> bool:
        """True once the command returns to its program."""
        return self.finished


class JointMove(Trajectory):
    """Move from rest to rest, all joints in the same time.

    Args:
        start: (6,) joint positions.
        target: (6,) joint positions.
        acceleration: Acceleration of the joint that moves farthest, rad/s².
        speed: Its speed, rad/s; less where another joint would exceed its limit.
        time: Duration, s; overrides `acceleration` and `speed` if above 0.
        blend_m: Blend radius.
        joint_speed_rad_s: (6,) largest joint speeds of the arm.
    """

    governed = True

    def __init__(
        self,
        start: Array,
        target: Array,
        acceleration: float,
        speed: float,
        time: float = 0.0,
        blend_m: float = 0.0,
        *,
        joint_speed_rad_s: Array,
    ) -> None:
        self._start, self.end, self._displacement = start, target, target - start
        self.blend_m = blend_m
        distances = np.abs(self._displacement)
        distance = float(distances.max())
        limit = distance / float((distances / joint_speed_rad_s).max()) if distance else 1.0
        if time > 0.0:
            self.profile = Trapezoid.timed(distance, time, limit, ACCELERATION_LIMIT_RAD_S2)
        else:
            self.profile = Trapezoid(distance, min(speed, limit), min(acceleration, ACCELERATION_LIMIT_RAD_S2))
        self.duration = self.profile.duration

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        fraction = self.profile.fraction
        fractions = [fraction(self.t + step * count) for count in counts.tolist()]
        q = self._start + np.multiply.outer(fractions, self._displacement)
        if fractions[-1] == 1.0:
            q[[each == 1.0 for each in fractions]] = self.end
        return q

    def rate(self) -> Array:
        """Return the joint speeds (6,) now."""
        return self._displacement * self.profile.slope(self.t)


class JointBrake(Trajectory):
    """Braking from joint speeds to rest.

    Args:
        start: (6,) joint positions.
        rate: (6,) joint speeds.
        times: (6,) braking time of each joint, s.
    """

    def __init__(self, start: Array, rate: Array, times: Array) -> None:
        self._start, self._rate, self._times = start, rate, np.maximum(times, _TINY)
        self.end: Array = start + 0.5 * rate * times
        self.duration = float(times.max())

    @classmethod
    def together(cls, start: Array, rate: Array, time: float) -> JointBrake:
        """Stop all joints after `time`."""
        return cls(start, rate, np.full(6, time))

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        t = np.minimum((self.t + step * counts)[:, None], self._times)
        q: Array = self._start + self._rate * (t - t * t / (2 * self._times))
        if self.t + step * counts[-1] >= self.duration - TIME_EPSILON_S:
            q[-1] = self.end
        return q

    def rate(self) -> Array:
        """Return the joint speeds (6,) now."""
        left: Array = self._rate * (1.0 - np.minimum(self.t / self._times, 1.0))
        return left


class SpeedJoints(Trajectory):
    """Acceleration to joint speeds, which are then held.

    Args:
        start: (6,) joint positions.
        rate: (6,) joint speeds at the start.
        target: (6,) commanded joint speeds.
        acceleration: Acceleration of the joint whose speed changes most, rad/s².
        ticks: Ticks after which the command returns; 0: when the speed is reached.
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
        """Return joint positions (n, 6); see `Trajectory`."""
        t = self.t + step * counts[:, None]
        ramp = np.minimum(t, self._reached_s)
        q: Array = self._start + self._rate * ramp + (0.5 * ramp * ramp) * self._acceleration
        q += (t - ramp) * self._target
        return q

    def rate(self) -> Array:
        """Return the joint speeds (6,) now."""
        speed: Array = self._rate + min(self.t, self._reached_s) * self._acceleration
        return speed

    @property
    def returns(self) -> bool:
        """True once the command returns to its program."""
        return self.ticks_left <= 0 if self._timed else self.t >= self._reached_s - TIME_EPSILON_S


class Superposed(Trajectory):
    """Move that starts before the previous motion has ended: the sum of both displacements.

    Args:
        main: The move, which starts at the end of `ending`.
        ending: The previous motion.
        end: (6,) joint positions at the end of `ending`.
    """

    governed = True
    most_rad_s2 = 2 * ACCELERATION_LIMIT_RAD_S2

    def __init__(self, main: Trajectory, ending: Trajectory, end: Array) -> None:
        self.main, self.ending, self._end = main, ending, end
        self.pace = ending.pace

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        q: Array = self.main.positions(step, counts) + (self.ending.positions(step, counts) - self._end)
        return q

    def commit(self, time: float) -> None:
        """Advance by `time`."""
        self.main.commit(time)
        self.ending.commit(time)

    def rate(self) -> Array | None:
        """Return the joint speeds (6,) now, or None."""
        main, ending = self.main.rate(), self.ending.rate()
        return None if main is None or ending is None else main + ending

    @property
    def finished(self) -> bool:
        """True once the arm has stopped."""
        return self.main.finished and self.ending.finished
