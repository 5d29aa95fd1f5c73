"""UR's `servoj`: its settings, and the control law that models it here.

UR does not publish the law. Its manual describes `gain` as the P-term of a controller and `lookahead_time` as the time
by which the current position is projected forward. Read literally, that is

    qdd = gain (target - q - lookahead qd)

with the latest target held until the next. A step is answered with a natural frequency of sqrt(gain) and a delay of
about `lookahead`; measured on UR arms at lookahead 0.03 s are 34-35 ms, this law at 125 Hz gives 34 ms.
"""

from __future__ import annotations

import cmath
import math
import numbers
from dataclasses import dataclass
from typing import Final, get_args

import numpy as np

from ur_core.errors import RateError, SettingsError, UnknownNameError
from ur_core.kinematics.ur10 import TICK_S, Family
from ur_core.types import Array

MAX_PERIOD_S: Final = 2.0
"""Longest policy period: the gate checks distances once in it."""

# Ranges of the arguments of servoj: UR's article "Servoj command", and the argument checks of ur_rtde 1.6.5.
MEASURED_LOOKAHEAD_S: Final = (0.005, 0.5)
"""Range of a measured lookahead."""

LOOKAHEAD_RANGE_S: Final = (0.03, 0.2)
GAIN_RANGE: Final = (100.0, 2000.0)


@dataclass(frozen=True)
class ServojProfile:
    """Settings of `servoj` on one controller family.

    Attributes:
        family: "cb3" (8 ms) or "e-series" (2 ms).
        lookahead_s: `lookahead_time`, 0.03 to 0.2 s.
        gain: `gain`, 100 to 2000 (1/s²).

    Raises:
        SettingsError: A value is outside the range that a UR controller accepts.
    """

    family: Family = "cb3"
    lookahead_s: float = 0.03
    gain: float = 2000.0

    def __post_init__(self) -> None:
        if self.family not in get_args(Family):
            raise UnknownNameError("controller family", str(self.family), get_args(Family))
        for name, value, (low, high) in (
            ("lookahead_s", self.lookahead_s, LOOKAHEAD_RANGE_S),
            ("gain", self.gain, GAIN_RANGE),
        ):
            if not low <= value <= high:
                raise SettingsError(f"servoj {name} is {value!r}: a UR controller accepts {low} to {high}")

    @property
    def tick_s(self) -> float:
        """Control period of the controller, s."""
        return TICK_S[self.family]

    @property
    def damping(self) -> float:
        """Damping ratio of the law; 1: no overshoot."""
        return math.sqrt(self.gain) * self.lookahead_s / 2

    def ticks_per_action(self, policy_rate_hz: float) -> int:
        """Return the ticks of one policy period.

        Raises:
            RateError: The period is no whole number of ticks; the message names the nearest rates that are.
        """
        rate = 1.0 / self.tick_s
        slowest = 1.0 / MAX_PERIOD_S
        if not (isinstance(policy_rate_hz, numbers.Real) and slowest <= policy_rate_hz <= rate * (1 + 1e-9)):
            raise RateError(f"policy rate is {policy_rate_hz!r}: it must be a number, {slowest:g} to {rate:g} Hz")
        ticks = rate / policy_rate_hz
        whole = round(ticks)
        if abs(ticks - whole) > 1e-6 * ticks:
            below, above = int(ticks), int(ticks) + 1
            raise RateError(
                f"policy rate {policy_rate_hz:g} Hz is {ticks:.4g} ticks of {self.tick_s * 1e3:g} ms: it must be a "
                f"whole number. The neighbours are {rate / above:.6g} Hz ({above} ticks) and {rate / below:.6g} Hz "
                f"({below} ticks)"
            )
        return whole


DEFAULT_SERVOJ: Final = ServojProfile()
"""Settings of `servoj` where none are given, on a CB3."""


class ServojLaw:
    """Exact discretisation of the control law with a held target.

    Args:
        lookahead_s: T of the law; may be a true value that differs from the profile's.
        gain: Gain of the law, 1/s².
    """

    def __init__(self, lookahead_s: float, gain: float) -> None:
        self.lookahead_s, self.gain = lookahead_s, gain

    def transition(self, dt_s: float) -> Array:
        """Return the (2, 2) map of (q - target, qd) over `dt_s`."""
        alpha = self.gain * self.lookahead_s / 2
        root = cmath.sqrt(alpha * alpha - self.gain)
        # exp(A t) = exp(-alpha t) (cosh(root t) I + sinh(root t) / root (A + alpha I)), by Cayley-Hamilton.
        slope = cmath.sinh(root * dt_s) / root if root else complex(dt_s)
        decay = cmath.exp(-alpha * dt_s)
        system = np.array([[0.0, 1.0], [-self.gain, -2 * alpha]])
        value = decay * (cmath.cosh(root * dt_s) * np.eye(2) + slope * (system + alpha * np.eye(2)))
        result: Array = np.ascontiguousarray(value.real)
        return result

    def response(self, dt_s: float, steps: int, hold: int) -> Array:
        """Return the states at every step as a matrix on (q0, qd0, target 1, target 2, ...).

        Args:
            dt_s: Time between two rows.
            steps: Number of steps.
            hold: Steps for which each target is held.

        Returns:
            (steps, 2, 2 + ceil(steps / hold)): position and speed at the end of each step.
        """
        count = -(-steps // hold)
        transition = self.transition(dt_s)
        state = np.zeros((2, 2 + count))
        state[0, 0] = state[1, 1] = 1.0
        rows = np.empty((steps, 2, 2 + count))
        for step in range(steps):
            target = np.zeros(2 + count)
            target[2 + step // hold] = 1.0
            offset = state.copy()
            offset[0] -= target
            state = transition @ offset
            state[0] += target
            rows[step] = state
        return rows
