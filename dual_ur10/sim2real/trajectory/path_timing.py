"""Timing of a path that has no times: as fast as the limits allow, from rest to rest, both arms together.

Three steps. Parabolas round the corners. TOPP-RA (Pham and Pham, IEEE Transactions on Robotics 34-3, 2018) finds the
fastest motion along the path with bounded joint speeds, joint accelerations and Cartesian speeds. Two moving averages
over time then bound the jerk: an average of motions within convex limits is within them, too. What the first step cuts
off and what the last one flattens are bounded in advance.

The result is passed through the safety gate as the executor would, and made more careful until it is released.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import SettingsError, TrajectoryError
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import HISTORY, MotionLimits
from dual_ur10.sim2real.trajectory.interpolation import Interpolation, make_interp_spline
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, too_long
from dual_ur10.sim2real.trajectory.path_check import PathCheck, Refusal, TargetLaw
from dual_ur10.sim2real.trajectory.smooth_path import SmoothPath
from ur_core.kinematics.forward import elbow_flange_and_tcp
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

BLEND_RAD: Final = 0.02
"""Largest distance of a joint from the straight parts of its path: half of it for corners, half for the averages."""

_CARE: Final = (1.0, 0.5, 0.25, 0.1, 0.04, 0.015)  # factors on accelerations and blends that are tried in this order

# Fractions of the limits. The targets lead the motion by the law's lookahead, so that its acceleration adds to their
# speed and its jerk to their acceleration. The brake may begin while the arms still accelerate.
_OF_SPEED, _OF_ACCELERATION, _OF_JERK, _OF_TCP_SPEED = 0.7, 0.5, 0.25, 0.8
_LEADING: Final = 0.2  # of the speed limit that the leading may use up
_OF_LEAD, _OF_SNAP = 0.25, 0.15  # of the acceleration limit that the jerk and its change may use up

_GRID_RAD: Final = 0.02
_SAME_RAD: Final = 1e-9  # distance of points that are one
_LEAST_STEPS: Final = 6  # of the grid in each straight part and each blend
_SAMPLES: Final = 4  # in the shorter average
_AT_REST: Final = 2  # samples at the end in which the jerk decays: the targets follow a jump of it at once


class _Rates(NamedTuple):
    """Bounds of a motion.

    Attributes:
        speed_rad_s: (12,) joint speeds.
        acceleration_rad_s2: (12,) joint accelerations.
        tcp_speed_m_s: Speed of elbow, flange and tool centre point.
        first_s: Duration of the longer average.
        second_s: Duration of the shorter average.
    """

    speed_rad_s: Array
    acceleration_rad_s2: Array
    tcp_speed_m_s: float
    first_s: float
    second_s: float

    @classmethod
    def within(cls, limits: MotionLimits, law: TargetLaw, blend_rad: float, care: float) -> _Rates:
        """Return the bounds under which targets are within the limits."""
        speed, lookahead = np.tile(limits.speed_rad_s, 2), law.lookahead_s
        most, jerk = limits.acceleration_rad_s2, _OF_JERK * limits.jerk_rad_s3
        acceleration = care * np.minimum(_OF_ACCELERATION * most, _LEADING * speed / lookahead)
        while True:
            largest = float(acceleration.max())
            # From the largest acceleration to its opposite within the first average, at a constant jerk; and from the
            # largest jerk to its opposite within the second one. That change of the jerk begins within a sample.
            sample_s = max(2.0 * lookahead / _SAMPLES, law.tick_s)
            product = 4.0 * largest / law.gain / min(_OF_SNAP * most, jerk * sample_s / 2)
            first_s = max(2.0 * largest * lookahead / (_OF_LEAD * most), 2.0 * largest / jerk, math.sqrt(product))
            second_s = max(2.0 * lookahead, product / first_s)
            # An average over t flattens a motion with the acceleration a by at most a t² / 24.
            if largest * (first_s**2 + second_s**2) / 24 <= care * blend_rad / 2:
                break
            acceleration = 0.9 * acceleration
        slower = math.sqrt(care)
        return cls(
            slower * _OF_SPEED * speed, acceleration, slower * _OF_TCP_SPEED * limits.tcp_speed_m_s, first_s, second_s
        )


def time_path(
    path_rad: Array,
    gate: SafetyGate,
    law: TargetLaw,
    *,
    arms: Sequence[str] = ARMS,
    blend_rad: float = BLEND_RAD,
    duration_s: float | None = None,
) -> JointTrajectory:
    """Return a trajectory along a path, from rest to rest, that a safety gate releases.

    Args:
        path_rad: (k, 2, 6) or (k, 12) configurations of both arms, joined by straight parts in joint space.
        gate: Gate with the limits of motion and the distances that count. It does not change.
        law: Makes the targets that the gate sees.
        arms: Arms of the trajectory; the others must not move on the path.
        blend_rad: Largest distance of each joint from the straight parts.
        duration_s: Duration; None: the shortest.

    Raises:
        TrajectoryError: The path is no path, moves another arm, leaves the joint range or is too long, `duration_s` or
            `blend_rad` is not legal, the motion takes longer than `duration_s`, or the gate refuses it at any speed.
    """
    corners = _checked(path_rad, arms)
    _check_extent(corners, gate.limits)
    for name, value in (("blend_rad", blend_rad), ("duration_s", 1.0 if duration_s is None else duration_s)):
        if not (math.isfinite(value) and value > 0.0):
            raise TrajectoryError(f"{name} is {value!r}: it must be above 0 and finite")
    if duration_s is not None and (text := too_long(duration_s)):
        raise TrajectoryError(text)
    shortest_s, refusal = 0.0, None
    for care in _CARE:
        trajectory = _timed(
            corners, _Rates.within(gate.limits, law, blend_rad, care), gate.limits, care * blend_rad, arms
        )
        if duration_s is not None:
            shortest_s = trajectory.duration_s
            if shortest_s > duration_s:
                break
            trajectory = _stretched(trajectory, duration_s / shortest_s)
        refusal = refusal_of(trajectory, corners[0].reshape(2, 6), gate, law)
        if refusal is None:
            return trajectory
    if duration_s is not None and shortest_s > duration_s:
        why = f", since faster {refusal}" if refusal else ""
        raise TrajectoryError(
            f"duration_s is {duration_s:g}: the motion along the path takes {shortest_s:.3f} s or more{why}. Allow that"
        )
    raise TrajectoryError(
        f"the safety gate refuses the motion along the path at any speed: {refusal}. Choose another path there"
    )


def refusal_of(trajectory: JointTrajectory, others_rad: Array, gate: SafetyGate, law: TargetLaw) -> Refusal | None:
    """Return the first refusal of a trajectory by a safety gate, which does not change; None: it is released.

    Args:
        trajectory: The trajectory.
        others_rad: (2, 6) positions of the arms that are not in it.
        gate: The gate.
        law: Makes the targets.
    """
    rows = [ARMS.index(each) for each in trajectory.arms]
    path = SmoothPath.of(Interpolation(trajectory), rows, others_rad)
    return PathCheck(path, gate, law).work(path.end_s + HISTORY * law.tick_s)


def _checked(path_rad: Array, arms: Sequence[str]) -> Array:
    """Return the corners, (k, 12), without repetitions.

    Raises:
        TrajectoryError: They are no path, or one of an arm that has to stay.
    """
    try:
        corners: Array = np.asarray(path_rad, dtype=np.float64)
        corners = corners.reshape(len(corners), 12)
    except (TypeError, ValueError):
        raise TrajectoryError("a path must be configurations of both arms, (points, 2, 6)") from None
    if not len(corners) or not np.isfinite(corners).all():
        raise TrajectoryError("a path must have one point or more, and finite joint angles")
    with np.errstate(over="ignore"):  # such points are out of range
        moves = np.abs(np.diff(corners, axis=0)).max(axis=1) > _SAME_RAD
    for row, name in enumerate(ARMS):
        if name not in arms and (corners[:, 6 * row : 6 * row + 6] != corners[0, 6 * row : 6 * row + 6]).any():
            raise TrajectoryError(f"the path moves the {name} arm, which has to stay: time it for both arms")
    if not moves.any():
        raise TrajectoryError("the path moves no joint: there is nothing to time")
    last = int(np.flatnonzero(moves)[-1])
    # The last point itself is kept, not one that is nearly the same.
    return np.concatenate([corners[:1], corners[1 : last + 1][moves[:last]], corners[-1:]])


def _check_extent(corners: Array, limits: MotionLimits) -> None:
    """Check that a path is short enough for its grid.

    Raises:
        TrajectoryError: A corner is outside the joint range, or the path takes too long at the largest speed.
    """
    try:
        for extreme in (corners.min(axis=0), corners.max(axis=0)):
            limits.check_range(extreme.reshape(2, 6))
    except SettingsError as error:
        raise TrajectoryError(f"a point of the path is out of range: {error}") from None
    length = float(np.abs(np.diff(corners, axis=0)).max(axis=1).sum())
    if text := too_long(length / max(limits.speed_rad_s)):
        raise TrajectoryError(text)


class _Rounded:
    """Path with rounded corners: its direction changes linearly with its length along each piece of a grid.

    The length is that of the joint that moves most. A blend of length 2 l on both sides of a corner passes it at a
    distance of l / 4 times the change of direction.

    Args:
        corners: (k, 12) corners.
        off_rad: Largest distance from a corner.
    """

    def __init__(self, corners: Array, off_rad: float) -> None:
        moved = np.diff(corners, axis=0)
        lengths = np.abs(moved).max(axis=1)
        directions = moved / lengths[:, None]
        turn = np.abs(np.diff(directions, axis=0)).max(axis=1)
        half = np.minimum(np.minimum(lengths[:-1], lengths[1:]) / 2, 4.0 * off_rad / np.maximum(turn, 1e-9))
        before, after = np.append(half, 0.0), np.append(0.0, half)
        steps, ends = [], [directions[0]]
        for k, length in enumerate(lengths - before - after):
            pieces = [(length, directions[k])] + ([(2 * half[k], directions[k + 1])] if k < len(half) else [])
            for piece, direction in pieces:
                if piece > _SAME_RAD:
                    count = max(_LEAST_STEPS, math.ceil(piece / _GRID_RAD))
                    steps += [piece / count] * count
                    begin = ends[-1]
                    ends += [begin + (direction - begin) * (each / count) for each in range(1, count + 1)]
        self.step: Array = np.array(steps)
        """(n,) lengths of the pieces."""
        self.direction: Array = np.array(ends)
        """(n + 1, 12) derivatives of the positions by the length."""
        self.bend: Array = np.diff(self.direction, axis=0) / self.step[:, None]
        """(n, 12) second derivatives."""
        means = (self.direction[:-1] + self.direction[1:]) / 2
        self.q_rad: Array = corners[0] + np.append(
            np.zeros((1, 12)), np.cumsum(means * self.step[:, None], axis=0), axis=0
        )
        """(n + 1, 12) positions."""


def _squared_speeds(path: _Rounded, rates: _Rates, limits: MotionLimits) -> Array:
    """Return the squares of the largest speeds along a path, (n + 1,): the two passes of TOPP-RA.

    Along a piece with the speed v at its beginning and a constant acceleration a, the joints' acceleration is linear in
    the length. It is bounded at both ends, where it is linear in a and v².
    """
    step, unit = path.step, path.direction
    most = (rates.speed_rad_s / np.maximum(np.abs(unit), 1e-12)).min(axis=1)
    points = elbow_flange_and_tcp(path.q_rad.reshape(-1, 2, 6), limits.tcp_m, limits.robots)
    travel = np.linalg.norm(np.diff(points, axis=0), axis=-1).max(axis=(1, 2)) / step
    cartesian = rates.tcp_speed_m_s / np.maximum(travel, 1e-12)
    most = np.minimum(most, np.minimum(np.append(cartesian, np.inf), np.append(np.inf, cartesian))) ** 2

    of_a = np.hstack([unit[:-1], unit[1:] + 2 * step[:, None] * path.bend]) / np.tile(rates.acceleration_rad_s2, 2)
    of_v2 = np.hstack([path.bend, path.bend]) / np.tile(rates.acceleration_rad_s2, 2)
    # |of_a a + of_v2 v²| <= 1 as a range of a around slope v², with twice the step in it.
    of_a = np.where(np.abs(of_a) < 1e-12, 1e-12, of_a)
    half, slope = 2 * step[:, None] / np.abs(of_a), -2 * step[:, None] * of_v2 / of_a
    for row in range(of_a.shape[1]):  # two ranges must meet
        apart = slope[:, row : row + 1] - slope
        with np.errstate(divide="ignore", invalid="ignore"):
            meet = np.where(apart > 0.0, (half[:, row : row + 1] + half) / apart, np.inf)
            stops = np.where(slope < -1.0, half / (-1.0 - slope), np.inf)  # v² must not fall below 0 in the piece
        most[:-1] = np.minimum(most[:-1], np.minimum(meet, stops).min(axis=1))
    reachable = most
    reachable[-1] = 0.0
    for k in range(len(step) - 1, -1, -1):
        growing = 1.0 + slope[k]
        ahead = np.where(growing > 1e-12, (reachable[k + 1] + half[k]) / np.maximum(growing, 1e-12), np.inf)
        reachable[k] = min(reachable[k], float(ahead.min()))
    found = np.zeros(len(reachable))
    for k in range(len(step)):
        found[k + 1] = min(reachable[k + 1], found[k] + float((slope[k] * found[k] + half[k]).min()))
    return found


def _timed(
    corners: Array, rates: _Rates, limits: MotionLimits, blend_rad: float, arms: Sequence[str]
) -> JointTrajectory:
    """Return the fastest motion within bounds."""
    path = _Rounded(corners, blend_rad / 2)
    squared = _squared_speeds(path, rates, limits)
    speed = np.sqrt(squared)
    time = np.append(0.0, np.cumsum(2 * path.step / (speed[:-1] + speed[1:])))
    # Samples from rest to rest, for the averages.
    tick_s = rates.second_s / _SAMPLES
    first, second = (np.full(count, 1.0 / count) for count in (max(round(rates.first_s / tick_s), 1), _SAMPLES))
    kernel = np.convolve(first, second)
    samples = np.arange(math.ceil(time[-1] / tick_s) + 1) * tick_s
    piece = np.minimum(np.searchsorted(time, samples, side="right") - 1, len(path.step) - 1)
    passed = np.minimum(samples, time[-1]) - time[piece]
    along = passed * (speed[piece] + passed * np.diff(squared)[piece] / path.step[piece] / 4)
    along = np.clip(along, 0.0, path.step[piece])[:, None]
    q = path.q_rad[piece] + along * (path.direction[piece] + along * path.bend[piece] / 2)
    before, after = np.ones((len(kernel) - 1, 1)), np.ones((len(kernel) - 1 + _AT_REST, 1))
    q = np.concatenate([before * corners[0], q, after * corners[-1]])
    q = np.stack([np.convolve(joint, kernel, "valid") for joint in q.T], axis=1)
    q[0], q[-1] = corners[0], corners[-1]
    at_rest = [(1, np.zeros(12)), (2, np.zeros(12))]
    time = tick_s * np.arange(len(q), dtype=np.float64)
    spline = make_interp_spline(time, q, k=5, bc_type=(at_rest, at_rest))
    rows = [ARMS.index(each) for each in arms]
    values = [each.reshape(-1, 2, 6)[:, rows] for each in (q, spline(time, 1), spline(time, 2))]
    for each in values[1:]:
        each[[0, -1]] = 0.0
    return JointTrajectory(tuple(arms), time, *values)


def _stretched(trajectory: JointTrajectory, factor: float) -> JointTrajectory:
    """Return the same motion with times longer by a factor."""
    q, speeds, accelerations = trajectory.q_rad, trajectory.qd_rad_s, trajectory.qdd_rad_s2
    if speeds is None or accelerations is None:  # these are always there
        raise TrajectoryError("a trajectory without speeds and accelerations cannot be stretched")
    return JointTrajectory(trajectory.arms, trajectory.time_s * factor, q, speeds / factor, accelerations / factor**2)
