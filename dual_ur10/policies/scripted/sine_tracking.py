"""Scripted policy for SineTracking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.tasks.sine_tracking.path import SineSettings
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.kinematics import nearest
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.rotations import quat_multiply, quat_to_matrix
from dual_ur10.policies.scripted.lag_model import DeviationModel
from dual_ur10.policies.scripted.recovery import Rejoin
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array, Rows

_RESTART_RAD = 2e-3  # a reference that is so far from where it was going belongs to another episode
_CHANGE_RAD_S3 = 5.0  # with long periods it goes elsewhere by itself: more than the jerk of a sine of 0.2 rad at 0.5 Hz
_SETTLE_S = 0.5  # for which arms that did not obey, or rested, move otherwise than is wanted: nothing is learned then
_LATENCY_S = 0.12  # beyond it limits hold back the first commands of an episode, and it would learn from that
_LATENCY_PERIODS = 6.5  # as much, with short periods


class SineTrackingPolicy:
    """Inverse kinematics of the reference at the end of the next motion, less what the arm is expected to deviate.

    Args:
        timing: Rate and latency of actions.
        action_mode: "joint_delta" or "joint_position".
        mounts: Where the arms stand, and their kinematics.
        limits: What the arms may do, as the cell allows it.
        settings: Those of the task; they do not matter.
        learn: Whether to learn the deviation while moving. Without it, and with a latency beyond 0.12 s or six
            periods, the policy commands the reference as it is.
    """

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "joint_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: SineSettings | None = None,
        *,
        learn: bool = True,
    ) -> None:
        if action_mode not in ("joint_delta", "joint_position"):
            raise SettingsError(f"the scripted policy commands joints: action_mode {action_mode!r} is not for it")
        self.timing, self.action_mode = timing, action_mode
        latency_s = timing.ahead_s - timing.period_s
        self.learn = learn and latency_s <= min(_LATENCY_S, _LATENCY_PERIODS * timing.period_s)
        self._restart_rad = max(_RESTART_RAD, _CHANGE_RAD_S3 * timing.period_s**3)
        self.dh = [mount.dh for mount in (SceneSettings().mounts if mounts is None else mounts)]
        allowed = limits or SineTracking.limits
        self._step = np.tile(allowed.speed_rad_s, 2) * timing.period_s
        self._rejoin: Rejoin | None = Rejoin(allowed, timing.period_s)
        # Derivatives of the parabola through the wanted positions one period ago, now and ahead, at the latter two.
        h, ahead = timing.period_s, timing.ahead_s
        times = np.array([-h, 0.0, ahead])
        fit = np.linalg.inv(np.vander(times, 3, increasing=True))
        self._speeds = np.array([fit[1], fit[1] + 2 * ahead * fit[2]])
        self._acceleration = 2 * fit[2]
        self._next = fit[0] + h * fit[1] + h * h * fit[2]
        self.reset()

    def reset(self) -> None:
        """Forget what was learned: an episode begins."""
        self._model: DeviationModel | None = None
        self._before: Array | None = None
        self._predicted: Array | None = None
        self._expected: Array | None = None
        self._unsettled: Array | None = None
        self._added: list[Array] = []
        if self._rejoin is not None:
            self._rejoin.reset()

    def teach(self) -> None:
        """See `dual_ur10.policies.policy.Teaching`: what it learned from commands of others would be wrong."""
        self.learn, self._rejoin = False, None

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Rows of the batch begin episodes; see `dual_ur10.policies.evaluation.evaluate.EpisodeAware`."""
        if self._predicted is not None:
            self._predicted[rows] = np.inf  # nothing goes on from there

    def __call__(self, observation: Array) -> Array:
        """Action, (12,) of float32, for an observation, (68,), or (n, 12) for (n, 68).

        Raises:
            ActionError: Not an observation of SineTracking.
            UnreachableError: The reference cannot be reached.
        """
        batch = SineTracking.layout.batch(observation, SineTracking.name)
        fields, n = SineTracking.layout.split(batch), len(batch)
        commanded = fields["commanded_q_rad"].reshape(n, 12)
        now, ahead = self._wanted(fields)
        before = self._continued(now, ahead, commanded)
        points = np.stack([before, now, ahead])
        self._before, self._predicted = now, np.tensordot(self._next, points, axes=1)
        speed_now, speed_ahead = np.tensordot(self._speeds, points, axes=1)
        acceleration = np.tensordot(self._acceleration, points, axes=1)
        goal = ahead
        if self.learn:
            if self._model is None or self._expected is None:
                self._model, self._expected = DeviationModel((n, 12)), commanded
            # What the last motion ended with beyond what was wanted there: a limit may have kept it from the rest.
            self._added.append(commanded - self._expected)
            measured = fields["q_rad"].reshape(n, 12)
            settled = self._settled(commanded)
            self._model.learn(speed_now, acceleration, measured - now - self._in_force(), settled)
            self._expected = ahead
            goal = ahead - self._model.predict(speed_ahead, acceleration)
        if self._rejoin is not None:
            goal = self._rejoin(goal, commanded, fields["qd_rad_s"].reshape(n, 12))
        # What is left to go may be more than an action can ask for.
        action = goal if self.action_mode == "joint_position" else np.clip((goal - commanded) / self._step, -1.0, 1.0)
        return action.reshape(*np.shape(observation)[:-1], 12).astype(np.float32)

    def _continued(self, now: Array, ahead: Array, commanded: Array) -> Array:
        """Where the wanted motion was one period ago; forgets the rows whose reference is not where it was to be.

        So a vector environment's rows may begin new episodes by themselves.
        """
        linear = now - (ahead - now) * (self.timing.period_s / self.timing.ahead_s)
        if self._before is None or self._predicted is None:
            return linear
        if self._before.shape != now.shape:
            raise ActionError(f"{len(now)} observations after {len(self._before)}: call reset() before another number")
        fresh = np.abs(now - self._predicted).max(axis=1) > self._restart_rad
        if fresh.any():
            self._before = np.where(fresh[:, None], linear, self._before)
            if self._rejoin is not None:
                self._rejoin.forget(fresh, commanded)
            if self._model is not None and self._expected is not None:
                self._model.forget(fresh)
                self._expected = np.where(fresh[:, None], commanded, self._expected)
                if self._unsettled is not None:
                    self._unsettled[fresh] = 0.0
                self._added = [np.where(fresh[:, None], 0.0, added) for added in self._added]
        return self._before

    def _settled(self, commanded: Array) -> NDArray[np.bool_]:
        """(n,) where the arms have long enough done what they were commanded to."""
        if self._unsettled is None:
            self._unsettled = np.zeros(len(commanded))
        if self._rejoin is not None:
            left = self._unsettled - self.timing.period_s
            self._unsettled = np.where(self._rejoin.off(commanded), _SETTLE_S + self.timing.ahead_s, left)
        settled: NDArray[np.bool_] = self._unsettled <= 0.0
        return settled

    def _in_force(self) -> Array:
        """What was added to the command that is in force now, which the action latency has held back since."""
        back = self.timing.ahead_s / self.timing.period_s - 1.0
        whole = int(back + 1e-9)
        part = back - whole
        del self._added[: -(whole + 2)]
        history = [self._added[0]] * (whole + 2) + self._added
        return history[-1 - whole] * (1.0 - part) + history[-2 - whole] * part

    def _wanted(self, fields: Mapping[str, Array]) -> tuple[Array, Array]:
        """Joint positions, (n, 12) each, that put the flanges on the reference now and ahead."""
        half = fields["rotation"] / 2
        scalar = np.sqrt(np.maximum(1.0 - (half * half).sum(axis=-1, keepdims=True), 0.0))
        reference = quat_to_matrix(quat_multiply(np.concatenate([scalar, half], axis=-1), fields["flange_base_quat"]))
        wanted = np.empty((2, len(half), 2, 6))
        positions = np.stack([fields["reference_base_m"], fields["ahead_base_m"]])
        references = np.broadcast_to(reference, (2, *reference.shape))
        near = np.broadcast_to(fields["commanded_q_rad"], wanted.shape)
        # One call for arms with the same kinematics: it costs little more than for a single pose.
        for group in ([0, 1],) if self.dh[0] == self.dh[1] else ([0], [1]):
            wanted[:, :, group] = nearest(
                positions[:, :, group], references[:, :, group], near[:, :, group], self.dh[group[0]]
            )
        now, ahead = wanted.reshape(2, len(half), 12)
        return now, ahead
