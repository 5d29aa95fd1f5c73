"""Scripted policy for SyncCarry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from dual_ur10.assets.props import BAR_WIDTH_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.geometry import LEARNERS_ROOM_M, flanges_of
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.envs.tasks.sync_carry.task import SyncCarry
from dual_ur10.envs.tasks.task import Timing, duration_ratio
from dual_ur10.policies.scripted.base import ScriptedPolicy, on_table
from dual_ur10.policies.scripted.free_motion import FreeMotion, Waypoint
from dual_ur10.policies.scripted.recovery import Recovery
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.poses import Poses, compose, relative_to
from ur_core.tools.tool import Tool
from ur_core.types import Array, Rows

_ABOVE_M: Final = 0.03  # the passing point above the grip
_DOWN_M_S: Final = 0.04  # speed at which it is passed
_ACCELERATION_RAD_S2: Final = 0.6
_JERK_RAD_S3: Final = 4.0
_SMOOTH_S: Final = 0.2  # the adapter follows jumps of jerk with a lag, which would be too low near the table
_SPEED_RATIO: Final = 0.5  # of the task's limit, in the approach
_CLOSE_AFTER_S: Final = 0.15  # from the end of the approach until the fingers close


class SyncCarryPolicy(ScriptedPolicy):
    """Lowers both grippers to the bar, closes them, and moves both flanges with the bar's reference.

    The reference is a pose of the bar. Both arms' configurations follow from it at every step, so that the grips keep
    their distance on any path.
    """

    task: ClassVar[type[SyncCarry]] = SyncCarry
    settings: CarrySettings

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "joint_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: CarrySettings | None = None,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        super().__init__(timing, action_mode, mounts, limits, settings, tools)
        self._speed = np.tile(SyncCarry.limits.speed_rad_s, 2) * (
            _SPEED_RATIO / duration_ratio(SyncCarry.limits, self.limits)
        )
        self._name = f"SyncCarry with grasp={self.settings.grasp!r}"
        self._higher_m, self._is_expert = 0.0, False
        self._recovery = Recovery(self.limits, timing.period_s)
        self.reset()

    def teach(self) -> None:
        """Grip higher, because a less exact learner needs more room above the table; see `Teaching`.

        An expert does not remember where it measured the bar before the lift. It grips the bar where its path begins,
        which is where it lies, apart from the error of the measurement.
        """
        self._higher_m, self._is_expert = LEARNERS_ROOM_M, True

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._clock: Array | None = None
        self._recovery.reset()

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows of the batch; see `dual_ur10.policies.policy.EpisodeAware`."""
        if self._clock is not None:
            self._clock[rows] = np.inf

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of SyncCarry with these settings.
            UnreachableError: The bar or its path cannot be reached.
        """
        batch = self.batch(observation, None if self._clock is None else len(self._clock))
        fields, n = self.layout.split(batch), len(batch)
        if self._clock is None:
            self._clock = np.full(n, np.inf)
            self._time_s = np.zeros(n)
            self._motion: list[FreeMotion | None] = [None] * n
            self._offset = Poses(np.zeros((n, 2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 2, 1)))
        commanded = fields["commanded_q_rad"]
        names = ("flange_base", "bar_base", "reference_base", "ahead_base")
        flange, bar, now, ahead = (pose_of(fields, name) for name in names)
        clock = fields["time_to_path_s"][:, 0, 0] + fields["progress"][:, 0, 0]
        fresh = np.flatnonzero(clock < self._clock)
        self._clock = clock
        for row in fresh.tolist():
            poses = (Poses(*(part[row] for part in each)) for each in (flange, now if self._is_expert else bar, now))
            self._plan(row, commanded[row], *poses)
        goal = self.inverse(compose(ahead, self._offset), commanded)
        closed = np.full(n, -1.0)
        for row, motion in enumerate(self._motion):
            if motion is None:
                continue
            if clock[row] >= 0.0:
                self._motion[row] = None
                continue
            end = self._time_s[row] + self.timing.ahead_s
            goal[row] = motion.at(end).reshape(2, 6)
            closed[row] = -1.0 if end > motion.duration_s + _CLOSE_AFTER_S else 1.0
        self._time_s += self.timing.period_s
        goal, commanded = goal.reshape(n, 12), commanded.reshape(n, 12)
        if not self._is_expert:
            self._recovery.forget(fresh, commanded)
            goal = self._recovery(goal, commanded, fields["qd_rad_s"].reshape(n, 12))
        action = self.action(goal, commanded).reshape(n, 2, 6)
        if not self.settings.rigid:
            action = np.concatenate([action, np.broadcast_to(closed[:, None, None], (n, 2, 1))], axis=2)
        return action.reshape(*np.shape(observation)[:-1], -1).astype(np.float32)

    def _plan(self, row: int, commanded: Array, flange: Poses, bar: Poses, reference: Poses) -> None:
        """Plan the path of one row to the grips, and the flanges' poses in the reference, (2, ...) each."""
        self._time_s[row] = 0.0
        if not self.settings.rigid:
            bar = on_table(bar, self.mounts, BAR_WIDTH_M / 2 + self._higher_m)
            flange = flanges_of(compose(bar, self.settings.grip), self._levers_m)
            above = Poses(flange.position_m + np.array([0.0, 0.0, _ABOVE_M]), flange.quat)
            lower = Poses(above.position_m - np.array([0.0, 0.0, 1e-3]), flange.quat)
            points = np.concatenate([self.inverse(pose, commanded).reshape(1, 12) for pose in (above, lower, flange)])
            down = (points[1] - points[0]) * (_DOWN_M_S / 1e-3)
            passing = Waypoint(points[0], down * min(1.0, 0.5 / float((np.abs(down) / self._speed).max())))
            self._motion[row] = FreeMotion(
                commanded.reshape(12),
                [passing, Waypoint(points[2], np.zeros(12))],
                self._speed,
                _ACCELERATION_RAD_S2,
                _JERK_RAD_S3,
                max(_SMOOTH_S, 3 * self.timing.period_s),
            )
        self._offset.position_m[row], self._offset.quat[row] = relative_to(reference, flange)
