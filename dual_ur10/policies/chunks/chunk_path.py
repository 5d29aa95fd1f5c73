"""Paths of chunks: smooth through the knots of a chunk, from one chunk to the next, and to rest where none follows."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.polynomial import polynomial

from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.forward import elbow_flange_and_tcp
from ur_core.types import Array, constant

_ROOM: Final = 0.9  # of each limit: the adapter's path between two actions may exceed what it passes through
_ROUNDING: Final = 1.0 + 1e-6
_LONGEST_S: Final = 3.0  # of a fade, within which a joint may go through its whole range
_RATIO: Final = 1.1  # of the durations that are tried
_BLOCK: Final = 6  # durations that are tried at once
_SAMPLES: Final = np.linspace(0.0, 1.0, 21)
_EXPONENTS: Final = np.arange(1.0, 4.0)
_QUINTICS: Final = np.array([[1, 0, 0, -10, 15, -6], [0, 1, 0, -6, 8, -3], [0, 0, 0.5, -1.5, 1.5, -0.5]])
"""Polynomials that fade a difference, its speed and its acceleration of 1 to rest, over a duration of 1."""

_DERIVATIVES: Final = np.zeros((4, 6, 3))
_DERIVATIVES[0] = _QUINTICS.T
for _order in range(1, 4):
    _DERIVATIVES[_order, :-1] = np.arange(1.0, 6.0)[:, None] * _DERIVATIVES[_order - 1, 1:]


@lru_cache(maxsize=64)
def _slopes(count: int) -> Array:
    """Return the matrix from knots at distances of 1 to the slopes of the twice differentiable cubics through them.

    The first two pieces are one cubic, and the last two. Fewer than four knots give a parabola or a line.
    """
    if count < 4:
        times = np.arange(count, dtype=np.float64)
        fit = np.linalg.inv(np.vander(times, increasing=True))
        return constant(np.stack([polynomial.polyval(time, polynomial.polyder(fit)) for time in times]))
    left, right = np.zeros((2, count, count))
    for k in range(1, count - 1):
        left[k, k - 1 : k + 2] = 1.0, 4.0, 1.0
        right[k, [k - 1, k + 1]] = -3.0, 3.0
    left[0, :2], right[0, :3] = (1.0, 2.0), (-2.5, 2.0, 0.5)
    left[-1, -2:], right[-1, -3:] = (2.0, 1.0), (-0.5, -2.0, 2.5)
    return constant(np.linalg.solve(left, right))


class ChunkPath:
    """Path through the knots of a chunk that comes to rest at the last one.

    It is twice continuously differentiable. Before its end time slows down, so that the joints stay on the path.

    Args:
        begin_s: Time of the first knot.
        dt_s: Time between two knots.
        knots: (m, j) positions of the joints; at least one knot.

    Attributes:
        end_s: Time of the last knot for joints that do not slow down.
        brake_s: Duration of the motion to rest, of which half is before `end_s`; 0: the path ends abruptly.
    """

    def __init__(self, begin_s: float, dt_s: float, knots: Array) -> None:
        knots = knots if len(knots) > 1 else np.concatenate([knots, knots])
        self._begin_s, self._dt_s, self._pieces = begin_s, dt_s, len(knots) - 1
        self.end_s, self.brake_s = begin_s + dt_s * self._pieces, 0.0
        slopes = _slopes(len(knots)) @ knots
        rise, first, last = np.diff(knots, axis=0), slopes[:-1], slopes[1:]
        self._cubics = np.stack([knots[:-1], first, 3 * rise - 2 * first - last, first + last - 2 * rise], axis=1)

    @property
    def duration_s(self) -> float:
        """Time from the first knot to the last one."""
        return self._dt_s * self._pieces

    def __call__(self, time_s: Array, brake_s: Array | float | None = None) -> Array:
        """Return position, speed, acceleration and jerk at times, (4, ..., j).

        Before the first knot the first cubic goes on, for up to `dt_s`.

        Args:
            time_s: (...) times.
            brake_s: (...) durations of the motion to rest in place of `brake_s`.
        """
        brake = np.asarray(self.brake_s if brake_s is None else brake_s)
        begins = self.end_s - brake / 2
        if (time_s < begins).all():
            return self._motion(time_s)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.where(brake > 0.0, np.clip((time_s - begins) / brake, 0.0, 1.0), time_s >= self.end_s)
            inverse = np.where((x > 0.0) & (x < 1.0), 1.0 / brake, 0.0)
        q, qd, qdd, jerk = self._motion(np.where(x > 0.0, begins + brake * (x - x**3 + x**4 / 2), time_s))
        # Rate of time, and its two derivatives.
        rate = (1.0 - 3 * x**2 + 2 * x**3)[..., None]
        slowing, change = (inverse * 6 * (x * x - x))[..., None], (inverse**2 * (12 * x - 6))[..., None]
        jerk = jerk * rate**3 + 3 * qdd * rate * slowing + qd * change
        return np.stack([q, qd * rate, qdd * rate**2 + qd * slowing, jerk])

    def _motion(self, time_s: Array) -> Array:
        """Return position, speed, acceleration and jerk at times, (4, ..., j), without the motion to rest."""
        at = (time_s - self._begin_s) / self._dt_s
        piece = np.clip(at.astype(np.int64), 0, self._pieces - 1)
        u = np.maximum(at - piece, -1.0)
        cubics = self._cubics[piece]
        powers = np.zeros((4, *np.shape(at), 4))
        powers[0, ..., 0], powers[0, ..., 1], powers[0, ..., 2] = 1.0, u, u * u
        powers[0, ..., 3] = powers[0, ..., 2] * u
        for order in range(1, 4):
            powers[order, ..., 1:] = powers[order - 1, ..., :-1] * (_EXPONENTS / self._dt_s)
        motion: Array = (powers[..., None, :] @ cubics)[..., 0, :]
        return motion


class SplicedPath:
    """Path of a chunk, to which the difference of the motion before it fades.

    Args:
        path: Path of the chunk.
        begin_s: Time at which it takes over.
        ends: (3, j) difference of position, speed and acceleration there.
        fade_s: Duration of the fade.
    """

    def __init__(self, path: ChunkPath, begin_s: float, ends: Array, fade_s: float) -> None:
        self.path, self._begin_s, self._ends, self.fade_s = path, begin_s, ends, fade_s

    def __call__(self, time_s: Array) -> Array:
        """Return position, speed, acceleration and jerk at times, (4, k, j)."""
        x = np.clip((time_s - self._begin_s) / self.fade_s, 0.0, 1.0)
        if (x >= 1.0).all():
            return self.path(time_s)
        faded = _faded(x, np.full(len(x), self.fade_s)) @ self._ends
        faded[3, x >= 1.0] = 0.0  # the jerk of a quintic ends in a step
        found: Array = self.path(time_s) + faded
        return found


def _faded(x: Array, duration_s: Array) -> Array:
    """Return the factors (4, ..., 3) of a difference, its speed and acceleration in those of position to jerk."""
    powers_of_x = x[..., None] ** np.arange(6)
    terms = [powers_of_x @ each for each in _DERIVATIVES]
    powers = duration_s[..., None] ** np.arange(3)
    return np.stack([powers * terms[order] / duration_s[..., None] ** order for order in range(4)])


class Splicer:
    """Choice of the shortest durations in which chunks end and differences fade within the limits of motion.

    A duration is legal if joint speed, acceleration and jerk stay within nine tenths of their limits, and the Cartesian
    speed of elbow, flange and tool, too, or if the chunk alone exceeds them as far. If none is legal, the least
    violation is chosen: the adapter enforces the limits in any case.

    Args:
        limits: Limits of motion of each arm.
        period_s: Time between two actions; no fade is shorter than three.
    """

    def __init__(self, limits: MotionLimits, period_s: float) -> None:
        self._limits = limits
        speed = np.tile(np.asarray(limits.speed_rad_s), 2)
        rates = np.full(12, limits.acceleration_rad_s2), np.full(12, limits.jerk_rad_s3)
        self.speed_rad_s: Array = speed
        self._caps = _ROOM * np.stack([speed, *rates])[:, None, None]
        shortest = 3 * period_s
        count = 1 + max(1, math.ceil(math.log(_LONGEST_S / shortest) / math.log(_RATIO)))
        self._durations: Array = np.float64(shortest) * _RATIO ** np.arange(count, dtype=np.float64)
        self._times = self._durations[:, None] * _SAMPLES
        self._factors = _faded(np.broadcast_to(_SAMPLES, self._times.shape), self._durations[:, None])

    def end(self, path: ChunkPath) -> None:
        """Let a path end at rest, as late as is legal and, whatever is legal, from the middle of the path on."""
        longest = path.duration_s
        brakes = np.append(self._durations[self._durations < longest], longest)
        worst: list[float] = []
        for first in range(0, len(brakes), _BLOCK):
            some = brakes[first : first + _BLOCK, None]
            motion = path(path.end_s + some * (_SAMPLES - 0.5), some)
            worst += self._excess(motion, motion[:, :, :1]).tolist()
            if min(worst) <= _ROUNDING:
                break
        best = next((k for k, excess in enumerate(worst) if excess <= _ROUNDING), int(np.argmin(worst)))
        path.brake_s = float(brakes[best])

    def splice(self, path: ChunkPath, now_s: float, state: Array) -> SplicedPath:
        """Return the path that leads from a state of motion to a chunk's path.

        Args:
            path: Path of the chunk.
            now_s: Time of the state.
            state: (3, 12) position, speed and acceleration.
        """
        ends = state - path(np.array([now_s]))[:3, 0]
        worst: list[Array] = []
        for first in range(0, len(self._durations), _BLOCK):  # nearly always the first block has a legal one
            rows = slice(first, first + _BLOCK)
            alone = path(now_s + self._times[rows])
            motion = alone + self._factors[:, rows] @ ends
            worst.append(self._excess(motion, alone))
            for row in np.flatnonzero(worst[-1] <= _ROUNDING).tolist():
                if not self._is_fast(first + row, motion[0, row], alone[0, row]):
                    return SplicedPath(path, now_s, ends, float(self._durations[first + row]))
        return SplicedPath(path, now_s, ends, float(self._durations[np.concatenate(worst).argmin()]))

    def _excess(self, motion: Array, alone: Array) -> Array:
        """Return the largest ratio of motions, (4, rows, samples, 12), to what is allowed, (rows,)."""
        allowed = np.maximum(self._caps, np.abs(alone[1:]))
        excess: Array = (np.abs(motion[1:]) / allowed).max(axis=(0, 2, 3))
        return excess

    def _is_fast(self, row: int, q_rad: Array, alone_rad: Array) -> bool:
        """Return True if positions, (samples, 12), exceed the Cartesian speed, and those of the chunk alone do not."""
        both = np.stack([q_rad, alone_rad]).reshape(2, -1, 2, 6)
        points = elbow_flange_and_tcp(both, self._limits.tcp_m, self._limits.robots)
        step_s = self._durations[row] * (_SAMPLES[1] - _SAMPLES[0])
        speed, own = np.linalg.norm(np.diff(points, axis=1), axis=-1).max(axis=(1, 2, 3)) / step_s
        return bool(speed > max(_ROOM * self._limits.tcp_speed_m_s, own * _ROUNDING))
