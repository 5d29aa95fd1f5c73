"""Online model of an arm's deviation from its commands."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ur_core.types import Array

_FEATURES = 4


class DeviationModel:
    """Recursive least squares fit, per joint, of the deviation from the command along a wanted motion.

    deviation = offset + lag · speed + friction · yield + inertia · acceleration

    These four terms are the effects of masses, friction, a wrong lookahead and an unknown latency on a position servo.
    Where a joint reverses, friction changes its sign at once, and the servo yields to it like a damped spring: "yield"
    is the sign of the speed behind a low-pass filter. The model depends on the wanted motion, known ahead, so that its
    prediction can be subtracted from the command without feedback delay.

    Args:
        shape: Shape of the joint arrays, such as (n, 12).
        period_s: Time between two motions.
    """

    # Prior deviation per unit of each scaled feature (rad), noise (rad), and forgetting factor (0.99 at 25 Hz: 4 s).
    # Orders of magnitude, not tuned values: a latency of 10 ms, friction of 10 N·m, gravity of 20 N·m.
    _PRIOR_RAD: Final = np.array([1e-3, 1e-2, 5e-4, 1e-3])
    _NOISE_RAD = 3e-4
    _MEMORY = 0.99
    # A larger surprise has another cause, such as a late measurement, and counts as this one. A deviation that persists
    # is learned nevertheless, from some more samples.
    _SURPRISE_RAD = 1e-3
    _SPEED_RAD_S, _ACCELERATION_RAD_S2 = 0.5, 2.0
    # Speed from which friction is nearly complete. Time constant of the servos, kv / kp of the large joints. The wrists
    # yield faster, but a faster correction would need more jerk than the adapter may command.
    _REVERSAL_RAD_S, _YIELD_S = 0.01, 0.05
    _SUBSTEPS = 4  # of the filter in a period, over which the speed is interpolated
    _TRUST = 0.4  # the fit is applied gradually, because commands must not jump
    _MOST = 2.0  # largest weight, in prior ones: errors of arms at their limits must not add up

    def __init__(self, shape: tuple[int, ...], period_s: float) -> None:
        self._period_s = period_s
        self._weights: Array = np.zeros((*shape, _FEATURES))
        self._trusted: Array = self._weights.copy()
        self._prior = np.diag((self._PRIOR_RAD / self._NOISE_RAD) ** 2)
        self._covariance: Array = np.broadcast_to(self._prior, (*shape, _FEATURES, _FEATURES)).copy()
        # At both instants of `features`.
        self._speed: Array = np.zeros((2, *shape))
        self._yield: Array = np.zeros((2, *shape))

    def forget(self, rows: NDArray[np.bool_]) -> None:
        """Forget the fit of the masked rows of the first axis, whose arms are at rest."""
        self._weights[rows] = self._trusted[rows] = 0.0
        self._covariance[rows] = self._prior
        self._speed[:, rows] = self._yield[:, rows] = 0.0

    def features(self, speed: Array, acceleration: Array) -> Array:
        """Advance the friction by a period, and return the features of the motion, (2, ..., 4).

        Args:
            speed: (2, ...) wanted speeds now and at the end of the next motion.
            acceleration: (...) wanted acceleration.
        """
        kept = np.exp(-self._period_s / (self._SUBSTEPS * self._YIELD_S))
        for part in (np.arange(self._SUBSTEPS) + 0.5) / self._SUBSTEPS:
            sign = np.tanh((self._speed + part * (speed - self._speed)) / self._REVERSAL_RAD_S)
            self._yield = sign + kept * (self._yield - sign)
        self._speed = speed
        inertia = np.broadcast_to(acceleration / self._ACCELERATION_RAD_S2, speed.shape)
        return np.stack([np.ones_like(speed), speed / self._SPEED_RAD_S, self._yield, inertia], axis=-1)

    def learn(self, feature: Array, deviation: Array, rows: NDArray[np.bool_] | None = None) -> None:
        """Fit one sample of the masked rows, or of all.

        Args:
            feature: (..., 4) features of the motion now.
            deviation: (...) measured minus commanded position.
            rows: Mask of the first axis.
        """
        spread = (self._covariance @ feature[..., None])[..., 0]
        gain = spread / (self._MEMORY + (feature * spread).sum(axis=-1, keepdims=True))
        surprise = deviation - (self._weights * feature).sum(axis=-1)
        ratio = self._SURPRISE_RAD / np.maximum(np.abs(surprise), self._SURPRISE_RAD)
        bound = self._MOST * self._PRIOR_RAD
        weights = np.clip(self._weights + gain * (ratio * surprise)[..., None], -bound, bound)
        trusted = self._trusted + self._TRUST * (weights - self._trusted)
        covariance = (self._covariance - (ratio[..., None] * gain)[..., None] * spread[..., None, :]) / self._MEMORY
        # The covariance of terms that are not excited must not grow without bound.
        trace = np.trace(covariance, axis1=-2, axis2=-1)[..., None, None]
        covariance = covariance * np.minimum(1.0, np.trace(self._prior) / trace)
        if rows is not None and not rows.all():
            weights[~rows], trusted[~rows], covariance[~rows] = (
                self._weights[~rows],
                self._trusted[~rows],
                self._covariance[~rows],
            )
        self._weights, self._trusted, self._covariance = weights, trusted, covariance

    def predict(self, feature: Array) -> Array:
        """Return the deviation to expect in a motion with these features."""
        prediction: Array = (self._trusted * feature).sum(axis=-1)
        return prediction
