"""Motions of both tools for scripts: in joint space, on straight lines, and step by step after a moving goal."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import TypeAlias

import numpy as np

from dual_ur10.envs.tasks.geometry import flanges_of
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.policies.scripted.base import Fields, Script, Wish, on_table
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, length
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_rotvec
from ur_core.tools.tool import levers_m
from ur_core.types import Array

Steps: TypeAlias = Generator[Wish, Fields, None]
"""Commands of a motion, for `yield from`."""

_SPEED_RATIO = 0.7  # of the joints' limits, in motions of the joints
_TURN_RAD_S = 0.5  # of tools on a line
_PEAK = 1.875  # largest speed of a motion with the least jerk, in units of its mean
_ARRIVED_RAD = 1e-3  # of the command from the wish, at the end of a motion
_ARRIVED_S = 1.0  # for which a motion waits for that
_STILL_M = 1e-4  # change of a gripper's width between two observations
_STILL_S, _MOVED_S, _MOST_S = 0.15, 0.3, 3.0  # of fingers: at rest for, not before, at the latest
_TOUCH_M = 0.012  # from an object's width, within which fingers are slow: its pose has errors


class Motions:
    """Both tools of one episode of a `Script`, as last commanded, and their motions.

    Each motion is a generator; a script runs it with `yield from`. Poses are in the cell frame, (2, 3) and (2, 4) those
    of both tools. A tool is at its gripper's tool centre point; where the task has no grippers, it is the flange.

        def script(self, fields):
            arms = Motions(self, fields)
            above = ...
            yield from arms.move(above)
            yield from arms.grip(-1.0)

    Args:
        script: The script.
        fields: Fields of the first observation.

    Attributes:
        fields: Fields of the last observation.
        period_s: Time between two actions.
        tools: Poses of both tools as last commanded.
        q_rad: (2, 6) joint positions as last commanded.
        opening: (2,) commands of the grippers, -1 closed to 1 open; None: the task has none.
    """

    def __init__(self, script: Script, fields: Fields) -> None:
        self._script, self._frames = script, Frames((script.mounts[0], script.mounts[1]))
        self.fields, self.q_rad, self.period_s = fields, fields["commanded_q_rad"].copy(), script.timing.period_s
        self.opening: Array | None = np.ones(2) if "gripper_m" in fields else None
        self._lever_m = np.zeros((2, 3)) if self.opening is None else levers_m(script.tools)
        flanges = [flange_pose_quat(q, mount.dh) for q, mount in zip(self.q_rad, script.mounts, strict=True)]
        position, quat = (np.stack(parts) for parts in zip(*flanges, strict=True))
        flange = Poses(self._frames.position_to_cell(position), self._frames.quat_to_cell(quat))
        self.tools = compose(flange, Poses(self._lever_m, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))))

    def pose(self, name: str, lying_m: float | None = None) -> Poses:
        """Return the pose, (3,) and (4,), in the fields `<name>_m` and `<name>_quat`, which the task gives in bases.

        Args:
            name: As in `pose_fields`.
            lying_m: Height at which the object lies on the table, upright: errors of the measurement that contradict
                this are corrected.
        """
        measured = pose_of(self.fields, name)
        if lying_m is not None:
            measured = on_table(measured, self._script.mounts, lying_m)
        cell = Poses(self._frames.position_to_cell(measured.position_m), self._frames.quat_to_cell(measured.quat))
        return Poses(cell.position_m[0], cell.quat[0])

    def vector(self, name: str) -> Array:
        """Return the vectors, (2, 3) in the cell frame, in a field that gives them in bases, such as `force_n`."""
        return self._frames.vector_to_cell(self.fields[name])

    def step(self, tools: Poses) -> Steps:
        """Command poses of both tools for the end of the next motion of the arms: one action.

        Raises:
            UnreachableError: A pose cannot be reached.
        """
        flange = flanges_of(tools, self._lever_m)
        in_bases = Poses(self._frames.position_to_base(flange.position_m), self._frames.quat_to_base(flange.quat))
        yield from self._command(self._script.inverse(in_bases, self.q_rad), tools)

    def follow(self, tools: Poses, speed_m_s: float = 0.05, turn_rad_s: float = 0.2, smooth_s: float = 0.3) -> Steps:
        """Go one step towards poses that may change with every observation: one action of a servo loop.

        Both tools go the same fraction of their paths, so that what both hold keeps its shape.

        Args:
            tools: Goals of both tools.
            speed_m_s: Largest speed.
            turn_rad_s: Largest speed of rotation.
            smooth_s: Time constant of the approach.
        """
        period_s = self.period_s
        path_m, turn = self._change(tools)
        needed_s = max(length(path_m).max() / speed_m_s, length(turn).max() / turn_rad_s, smooth_s, period_s)
        yield from self.step(_part(self.tools, path_m, turn, period_s / needed_s))

    def line(self, tools: Poses, speed_m_s: float = 0.2) -> Steps:
        """Move both tools on straight lines, from rest to rest; both arrive together.

        Args:
            tools: Goals of both tools.
            speed_m_s: Largest speed.
        """
        begin, (path_m, turn) = self.tools, self._change(tools)
        duration_s = _PEAK * max(length(path_m).max() / speed_m_s, length(turn).max() / _TURN_RAD_S)
        for ratio in self._ratios(duration_s):
            yield from self.step(_part(begin, path_m, turn, ratio))
        yield from self._arrive()

    def move(self, tools: Poses) -> Steps:
        """Move all joints in proportion, from rest to rest, on the way to poses of both tools; for free space.

        Args:
            tools: Goals of both tools.

        Raises:
            UnreachableError: A pose cannot be reached.
        """
        flange = flanges_of(tools, self._lever_m)
        in_bases = Poses(self._frames.position_to_base(flange.position_m), self._frames.quat_to_base(flange.quat))
        begin = self.q_rad
        change = self._script.inverse(in_bases, begin) - begin
        speed = _SPEED_RATIO * np.asarray(self._script.limits.speed_rad_s)
        for ratio in self._ratios(_PEAK * float(np.abs(change / speed).max())):
            yield from self._command(begin + ratio * change, tools)
        yield from self._arrive()

    def grip(self, left: float, right: float | None = None, width_m: Sequence[float] | None = None) -> Steps:
        """Open or close the grippers, and wait until their fingers are at rest, at most 3 s.

        Fingers at their full speed strike an object with many times the force of their grip, and let go of it with a
        jolt. With its width, they touch and leave it at the least speed of their tool.

        Args:
            left: Command of the left gripper, -1 closed to 1 open.
            right: That of the right one; None: the same.
            width_m: (2,) widths of the objects between the fingers; None: there are none.
        """
        goal = np.array([left, left if right is None else right], dtype=np.float64)
        if width_m is not None:
            begin, tools, period_s = np.asarray(self.opening), self._script.tools, self.period_s
            per_m = 2.0 / np.array([tool.stroke_m for tool in tools])
            step_m = np.array([tool.speed_m_s[0] for tool in tools]) * period_s
            low, high, way = np.minimum(begin, goal), np.maximum(begin, goal), np.sign(goal - begin)
            self.opening = np.clip((width_m - way * _TOUCH_M) * per_m - 1.0, low, high)
            yield from self._fingers_rest()
            for _ in range(math.ceil(2.0 * _TOUCH_M / step_m.min())):
                self.opening = np.clip(self.opening + way * step_m * per_m, low, high)
                yield from self.hold(period_s)
        self.opening = goal
        yield from self._fingers_rest()

    def _fingers_rest(self) -> Steps:
        """Wait until all fingers are at rest."""
        period_s, still_s, time_s = self.period_s, 0.0, 0.0
        while time_s < _MOST_S and (still_s < _STILL_S or time_s < _MOVED_S):
            before_m = self.fields["gripper_m"]
            yield from self.hold(period_s)
            time_s += period_s
            still_s = still_s + period_s if np.abs(self.fields["gripper_m"] - before_m).max() < _STILL_M else 0.0

    def hold(self, time_s: float) -> Steps:
        """Keep both tools where they are, for a time."""
        for _ in range(math.ceil(time_s / self.period_s - 1e-9)):
            yield from self._command(self.q_rad, self.tools)

    def _command(self, q_rad: Array, tools: Poses) -> Steps:
        self.q_rad, self.tools = q_rad, tools
        self.fields = yield Wish(q_rad, self.opening)

    def _arrive(self) -> Steps:
        """Wait until the command is where the motion ends: it may lag behind, because it keeps limits."""
        for _ in range(math.ceil(_ARRIVED_S / self.period_s)):
            if np.abs(self.fields["commanded_q_rad"] - self.q_rad).max() < _ARRIVED_RAD:
                return
            yield from self._command(self.q_rad, self.tools)

    def _change(self, tools: Poses) -> tuple[Array, Array]:
        """Return paths, (2, 3), and rotation vectors in the cell frame, (2, 3), to poses."""
        back = Poses(np.zeros((2, 3)), self.tools.quat * np.array([1.0, -1.0, -1.0, -1.0]))
        turn = quat_to_rotvec(quat_multiply(tools.quat, back.quat))
        return tools.position_m - self.tools.position_m, turn

    def _ratios(self, duration_s: float) -> Array:
        """Return the fractions of a path at the ends of all periods of a motion with the least jerk."""
        steps = max(1, math.ceil(duration_s / self.period_s))
        return least_jerk(np.arange(1, steps + 1) / steps)


def _part(begin: Poses, path_m: Array, turn: Array, ratio: float) -> Poses:
    """Return poses after a part of a path."""
    return Poses(begin.position_m + ratio * path_m, quat_multiply(quat_from_rotvec(ratio * turn), begin.quat))


def least_jerk(ratio: Array) -> Array:
    """Return the fractions of a path at fractions of its time, for a motion from rest to rest with the least jerk.

    Before 0 it is 0, after 1 it is 1.
    """
    s = np.clip(ratio, 0.0, 1.0)
    result: Array = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return result


def pair(left: Poses, right: Poses) -> Poses:
    """Return poses of the left and of the right arm, (..., 3) and (..., 4) each, as those of both, (..., 2, 3)."""
    return Poses(*(np.stack(parts, axis=-2) for parts in zip(left, right, strict=True)))


def raised(poses: Poses, by_m: float) -> Poses:
    """Return poses that are higher in the cell frame."""
    return Poses(poses.position_m + np.array([0.0, 0.0, by_m]), poses.quat)
