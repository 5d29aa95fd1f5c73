"""Scripted policy for SyncCarry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.assets.props import BAR_WIDTH_M
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.tasks.holding import flanges_of
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.envs.tasks.sync_carry.task import SyncCarry
from dual_ur10.envs.tasks.task import Timing, slower
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.poses import Poses, compose, relative_to
from dual_ur10.policies.scripted.carrying import TAUGHT_HIGHER_M, lying, postures
from dual_ur10.policies.scripted.free_motion import FreeMotion, Waypoint
from dual_ur10.policies.scripted.recovery import Rejoin
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array, Rows

_ABOVE_M: Final = 0.03  # the passing point above the grip
_DOWN_M_S: Final = 0.04  # speed at which it is passed
_ACCELERATION_RAD_S2: Final = 0.6
_JERK_RAD_S3: Final = 4.0
_SMOOTH_S: Final = 0.2  # what jumps in jerk, the adapter follows late, which is lower than commanded near the table
_SPEED_SHARE: Final = 0.5  # of the task's limit, in the approach
_CLOSE_AFTER_S: Final = 0.15  # from the end of the approach until the fingers are told to close


class SyncCarryPolicy:
    """Goes down to the bar's grips, closes, and moves both flanges with the reference of the bar.

    The reference is a pose of the bar; both arms' postures follow from it at every step, so that the grips keep their
    distance whatever the way.

    Args:
        timing: Rate and latency of actions.
        action_mode: "joint_delta" or "joint_position".
        mounts: Where the arms stand, and their kinematics.
        limits: What the arms may do, as the cell allows it.
        settings: Those of the task.
    """

    def __init__(
        self,
        timing: Timing,
        action_mode: str,
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: CarrySettings | None = None,
    ) -> None:
        if action_mode not in ("joint_delta", "joint_position"):
            raise SettingsError(f"the scripted policy commands joints: action_mode {action_mode!r} is not for it")
        self.timing, self.action_mode = timing, action_mode
        self.mounts = SceneSettings().mounts if mounts is None else tuple(mounts)
        self.dh = [mount.dh for mount in self.mounts]
        self.settings = CarrySettings() if settings is None else settings
        allowed = limits or SyncCarry.limits
        self._step = np.tile(allowed.speed_rad_s, 2) * timing.period_s
        self._speed = np.tile(SyncCarry.limits.speed_rad_s, 2) * (_SPEED_SHARE / slower(SyncCarry.limits, allowed))
        self._layout = SyncCarry.layout_for(self.settings)
        self._higher_m, self._teaches = 0.0, False
        self._rejoin = Rejoin(allowed, timing.period_s)
        self.reset()

    def teach(self) -> None:
        """See `dual_ur10.policies.policy.Teaching`: a pupil who is not so exact needs more room above the table.

        And it does not remember where the bar was seen before it was lifted. It is told to take it where its path
        begins, which is where it lies but for the error of what measures it.
        """
        self._higher_m, self._teaches = TAUGHT_HIGHER_M, True

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._clock: Array | None = None
        self._rejoin.reset()

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Rows of the batch begin episodes; see `dual_ur10.policies.evaluation.evaluate.EpisodeAware`."""
        if self._clock is not None:
            self._clock[rows] = np.inf

    def _begin(self, n: int) -> None:
        self._clock = np.full(n, np.inf)
        self._time_s = np.zeros(n)
        self._motion: list[FreeMotion | None] = [None] * n
        self._offset = Poses(np.zeros((n, 2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 2, 1)))

    def __call__(self, observation: Array) -> Array:
        """Action of float32 for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of SyncCarry with these settings.
            UnreachableError: The bar or its way cannot be reached.
        """
        batch = self._layout.batch(observation, f"SyncCarry with grasp={self.settings.grasp!r}")
        fields, n = self._layout.split(batch), len(batch)
        if self._clock is None:
            self._begin(n)
        if self._clock is None or len(self._clock) != n:
            raise ActionError(f"{n} observations after another number: call reset() first")
        commanded = fields["commanded_q_rad"]
        names = ("flange_base", "bar_base", "reference_base", "ahead_base")
        flange, bar, now, ahead = (pose_of(fields, name) for name in names)
        clock = fields["time_to_path_s"][:, 0, 0] + fields["progress"][:, 0, 0]
        fresh = np.flatnonzero(clock < self._clock)
        self._clock = clock
        for row in fresh.tolist():
            reference = Poses(*(part[row] for part in now))
            seen = reference if self._teaches else Poses(*(part[row] for part in bar))
            self._plan(row, commanded[row], Poses(*(part[row] for part in flange)), seen, reference)
        goal = postures(compose(ahead, self._offset), commanded, self.dh)
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
        if not self._teaches:
            self._rejoin.forget(fresh, commanded.reshape(n, 12))
            whole = self._rejoin(goal.reshape(n, 12), commanded.reshape(n, 12), fields["qd_rad_s"].reshape(n, 12))
            goal = whole.reshape(n, 2, 6)
        step = self._step.reshape(2, 6)
        action = goal if self.action_mode == "joint_position" else (goal - commanded) / step
        if not self.settings.rigid:
            action = np.concatenate([action, np.broadcast_to(closed[:, None, None], (n, 2, 1))], axis=2)
        return action.reshape(*np.shape(observation)[:-1], -1).astype(np.float32)

    def _plan(self, row: int, commanded: Array, flange: Poses, bar: Poses, reference: Poses) -> None:
        """Plan the path of one cell to the grips, and the poses of the flanges in the reference, (2, ...) each."""
        self._time_s[row] = 0.0
        if not self.settings.rigid:
            flange = flanges_of(compose(lying(bar, self.mounts, BAR_WIDTH_M / 2 + self._higher_m), self.settings.grip))
            above = Poses(flange.position_m + np.array([0.0, 0.0, _ABOVE_M]), flange.quat)
            lower = Poses(above.position_m - np.array([0.0, 0.0, 1e-3]), flange.quat)
            ways = np.concatenate(
                [
                    postures(Poses(*(p[None] for p in pose)), commanded[None], self.dh).reshape(1, 12)
                    for pose in (above, lower, flange)
                ]
            )
            down = (ways[1] - ways[0]) * (_DOWN_M_S / 1e-3)
            passing = Waypoint(ways[0], down * min(1.0, 0.5 / float((np.abs(down) / self._speed).max())))
            self._motion[row] = FreeMotion(
                commanded.reshape(12),
                [passing, Waypoint(ways[2], np.zeros(12))],
                self._speed,
                _ACCELERATION_RAD_S2,
                _JERK_RAD_S3,
                max(_SMOOTH_S, 3 * self.timing.period_s),
            )
        offset = relative_to(reference, flange)
        self._offset.position_m[row], self._offset.quat[row] = offset
