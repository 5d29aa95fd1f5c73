"""Scripted policy for SineTracking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.sine_tracking.settings import SineSettings
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.policies.scripted.base import ScriptedPolicy
from dual_ur10.policies.scripted.lag_model import DeviationModel
from dual_ur10.policies.scripted.recovery import Recovery
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_multiply
from ur_core.tools.tool import Tool
from ur_core.types import Array, Rows

_RESTART_RAD = 2e-3  # a reference so far from its prediction belongs to another episode
_CHANGE_RAD_S3 = 5.0  # with long periods the prediction errs more: above the jerk of a sine of 0.2 rad at 0.5 Hz
_SETTLE_S = 0.5  # no learning for this time after the arms stopped or did not follow: they do not move as wanted
_LATENCY_S = 0.12  # beyond it, limits hold back the first commands of an episode, and learning would be wrong
_LATENCY_PERIODS = 6.5  # the same bound for short periods


class SineTrackingPolicy(ScriptedPolicy):
    """Inverse kinematics of the reference at the end of the next motion, minus the expected deviation of the arm.

    Args:
        timing: See `ScriptedPolicy`.
        action_mode: Likewise.
        mounts: Likewise.
        limits: Likewise.
        settings: Likewise; they have no effect.
        learn: Learn the deviation while moving. Without it, and with a latency beyond 0.12 s or 6.5 periods, the policy
            commands the reference itself.
    """

    task: ClassVar[type[SineTracking]] = SineTracking

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "joint_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: SineSettings | None = None,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
        *,
        learn: bool = True,
    ) -> None:
        super().__init__(timing, action_mode, mounts, limits, settings, tools)
        latency_s = timing.ahead_s - timing.period_s
        self.learn = learn and latency_s <= min(_LATENCY_S, _LATENCY_PERIODS * timing.period_s)
        self._restart_rad = max(_RESTART_RAD, _CHANGE_RAD_S3 * timing.period_s**3)
        self._recovery: Recovery | None = Recovery(self.limits, timing.period_s)
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
        if self._recovery is not None:
            self._recovery.reset()

    def teach(self) -> None:
        """Stop learning, because deviations under commands of others would be wrong; see `Teaching`."""
        self.learn, self._recovery = False, None

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows of the batch; see `dual_ur10.policies.policy.EpisodeAware`."""
        if self._predicted is not None:
            self._predicted[rows] = np.inf  # any reference differs from it

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action, (12,), for an observation, (80,), or (n, 12) for (n, 80).

        Raises:
            ActionError: Not an observation of SineTracking.
            UnreachableError: The reference cannot be reached.
        """
        batch = self.batch(observation, None if self._before is None else len(self._before))
        fields, n = self.layout.split(batch), len(batch)
        commanded = fields["commanded_q_rad"].reshape(n, 12)
        now, ahead = self._wanted(fields)
        before = self._continued(now, ahead, commanded)
        points = np.stack([before, now, ahead])
        self._before, self._predicted = now, np.tensordot(self._next, points, axes=1)
        goal = ahead
        if self.learn:
            if self._model is None or self._expected is None:
                self._model, self._expected = DeviationModel((n, 12), self.timing.period_s), commanded
            # The correction in the last command; a limit may have held back the rest.
            self._added.append(commanded - self._expected)
            measured = fields["q_rad"].reshape(n, 12)
            speeds, acceleration = (np.tensordot(fit, points, axes=1) for fit in (self._speeds, self._acceleration))
            feature_now, feature_ahead = self._model.features(speeds, acceleration)
            self._model.learn(feature_now, measured - now - self._in_force(), self._settled(commanded))
            self._expected = ahead
            goal = ahead - self._model.predict(feature_ahead)
        if self._recovery is not None:
            goal = self._recovery(goal, commanded, fields["qd_rad_s"].reshape(n, 12))
        action = self.action(goal, commanded)
        if self.action_mode == "joint_delta":
            action = np.clip(action, -1.0, 1.0)
        return action.reshape(*np.shape(observation)[:-1], 12).astype(np.float32)

    def _continued(self, now: Array, ahead: Array, commanded: Array) -> Array:
        """Return the wanted positions one period ago; forget rows whose reference is not the predicted one.

        Rows of a vector environment may thus begin new episodes by themselves.
        """
        linear = now - (ahead - now) * (self.timing.period_s / self.timing.ahead_s)
        if self._before is None or self._predicted is None:
            return linear
        fresh = np.abs(now - self._predicted).max(axis=1) > self._restart_rad
        if fresh.any():
            self._before = np.where(fresh[:, None], linear, self._before)
            if self._recovery is not None:
                self._recovery.forget(fresh, commanded)
            if self._model is not None and self._expected is not None:
                self._model.forget(fresh)
                self._expected = np.where(fresh[:, None], commanded, self._expected)
                if self._unsettled is not None:
                    self._unsettled[fresh] = 0.0
                self._added = [np.where(fresh[:, None], 0.0, added) for added in self._added]
        return self._before

    def _settled(self, commanded: Array) -> NDArray[np.bool_]:
        """Return the rows, (n,), whose arms have followed their commands for long enough."""
        if self._unsettled is None:
            self._unsettled = np.zeros(len(commanded))
        if self._recovery is not None:
            left = self._unsettled - self.timing.period_s
            self._unsettled = np.where(self._recovery.active(commanded), _SETTLE_S + self.timing.ahead_s, left)
        settled: NDArray[np.bool_] = self._unsettled <= 0.0
        return settled

    def _in_force(self) -> Array:
        """Return the correction in the command in force, which the action latency has delayed."""
        back = self.timing.ahead_s / self.timing.period_s - 1.0
        whole = int(back + 1e-9)
        part = back - whole
        del self._added[: -(whole + 2)]
        history = [self._added[0]] * (whole + 2) + self._added
        return history[-1 - whole] * (1.0 - part) + history[-2 - whole] * part

    def _wanted(self, fields: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return the joint positions, (n, 12) each, that put the flanges on the reference now and ahead."""
        half = fields["rotation"] / 2
        scalar = np.sqrt(np.maximum(1.0 - (half * half).sum(axis=-1, keepdims=True), 0.0))
        reference = quat_multiply(np.concatenate([scalar, half], axis=-1), fields["flange_base_quat"])
        positions = np.stack([fields["reference_base_m"], fields["ahead_base_m"]])
        orientations = np.broadcast_to(reference, (2, *reference.shape))
        near = np.broadcast_to(fields["commanded_q_rad"], (2, *half.shape[:-1], 6))
        wanted = self.inverse(Poses(positions, orientations), near)
        now, ahead = wanted.reshape(2, len(half), 12)
        return now, ahead
