"""Online model of an arm's deviation from its commands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dual_ur10.types import Array

_FEATURES = 4


class DeviationModel:
    """Recursive least squares fit, per joint, of the deviation from the command along a wanted motion.

    deviation = offset + lag · speed + friction · sign(speed) + inertia · acceleration

    These four terms are the effects of masses, friction, a wrong lookahead and an unknown latency on a position servo.
    The model depends on the wanted motion, known ahead, so that its prediction can be subtracted from the command
    without feedback delay.

    Args:
        shape: Shape of the joint arrays, such as (n, 12).
    """

    # Prior deviation per unit of each scaled feature (rad), noise (rad), and forgetting factor (0.99 at 25 Hz: 4 s).
    # Orders of magnitude, not tuned values.
    _PRIOR_RAD = 5e-3
    _NOISE_RAD = 1e-4
    _MEMORY = 0.99
    # A larger surprise has another cause, such as a late measurement, and counts as this one. A deviation that persists
    # is learned nevertheless, from some more samples.
    _SURPRISE_RAD = 1e-3
    _SPEED_RAD_S, _ACCELERATION_RAD_S2 = 0.5, 2.0
    # A step of the correction at a reversal would need more acceleration than the adapter may command. So it is spread
    # over some periods, and the fit is applied gradually.
    _REVERSAL_RAD_S = 0.25
    _TRUST = 0.4

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._weights: Array = np.zeros((*shape, _FEATURES))
        self._trusted: Array = self._weights.copy()
        prior = (self._PRIOR_RAD / self._NOISE_RAD) ** 2
        self._limit = prior
        self._covariance: Array = np.broadcast_to(prior * np.eye(_FEATURES), (*shape, _FEATURES, _FEATURES)).copy()

    def forget(self, rows: NDArray[np.bool_]) -> None:
        """Forget the fit of the masked rows of the first axis."""
        self._weights[rows] = self._trusted[rows] = 0.0
        self._covariance[rows] = self._limit * np.eye(_FEATURES)

    def _features(self, speed: Array, acceleration: Array) -> Array:
        return np.stack(
            [
                np.ones_like(speed),
                speed / self._SPEED_RAD_S,
                np.tanh(speed / self._REVERSAL_RAD_S),
                acceleration / self._ACCELERATION_RAD_S2,
            ],
            axis=-1,
        )

    def learn(self, speed: Array, acceleration: Array, deviation: Array, rows: NDArray[np.bool_] | None = None) -> None:
        """Fit one sample of the masked rows, or of all: the measured minus the commanded position in this motion."""
        feature = self._features(speed, acceleration)
        spread = (self._covariance @ feature[..., None])[..., 0]
        gain = spread / (self._MEMORY + (feature * spread).sum(axis=-1, keepdims=True))
        surprise = deviation - (self._weights * feature).sum(axis=-1)
        ratio = self._SURPRISE_RAD / np.maximum(np.abs(surprise), self._SURPRISE_RAD)
        weights = self._weights + gain * (ratio * surprise)[..., None]
        trusted = self._trusted + self._TRUST * (weights - self._trusted)
        covariance = (self._covariance - (ratio[..., None] * gain)[..., None] * spread[..., None, :]) / self._MEMORY
        # The covariance of terms that are not excited must not grow without bound.
        trace = np.trace(covariance, axis1=-2, axis2=-1)[..., None, None]
        covariance = covariance * np.minimum(1.0, _FEATURES * self._limit / trace)
        if rows is not None and not rows.all():
            weights[~rows], trusted[~rows], covariance[~rows] = (
                self._weights[~rows],
                self._trusted[~rows],
                self._covariance[~rows],
            )
        self._weights, self._trusted, self._covariance = weights, trusted, covariance

    def predict(self, speed: Array, acceleration: Array) -> Array:
        """Return the deviation to expect in this motion."""
        prediction: Array = (self._trusted * self._features(speed, acceleration)).sum(axis=-1)
        return prediction
