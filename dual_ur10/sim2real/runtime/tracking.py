"""Whether an arm goes where it is led: what is sent, what its controller makes of it, and where the arm is.

And whether it gets hot, which comes before it does not.
"""

from __future__ import annotations

import logging
import math
from typing import Final

import numpy as np

from dual_ur10.kinematics.ur10 import JOINTS
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.links.arm_status import ArmStatus
from dual_ur10.types import Array

log = logging.getLogger(__name__)

HOT_C: Final = 70.0
"""From which temperature of a joint on a person is warned. Ours: Universal Robots publishes no figure."""

DEVIATION_RAD: Final = 0.1
"""How far an arm may be from where its controller wants it: half of what Universal Robots' ROS 2 driver allows."""

_ROWS: Final = 3  # states in a row: one alone may be a state between two updates
_ON_ITS_WAY_S: Final = 0.08  # for which a target may be on its way
_SLACK_RAD: Final = 0.02
_FORGETTING_S: Final = 0.4  # in which the greatest speed of late is forgotten


class Deviation:
    """Counts states in which joints are farther apart than they may be.

    Args:
        text: What is said of it, with `{joint}`, `{found}` and `{allowed}`.
    """

    def __init__(self, text: str) -> None:
        self._text, self._rows = text, 0

    def __call__(self, apart_rad: Array, allowed_rad: Array) -> str | None:
        """Why the arm must stop, or None."""
        over = apart_rad - allowed_rad
        over = np.where(np.isnan(over), np.inf, over)
        self._rows = self._rows + 1 if (over > 0.0).any() else 0
        if self._rows < _ROWS:
            return None
        joint = int(over.argmax())
        return self._text.format(
            joint=JOINTS[joint], found=f"{apart_rad[joint]:.3f}", allowed=f"{allowed_rad[joint]:.3f}"
        )


class Tracking:
    """Whether an arm is where its controller wants it to be."""

    def __init__(self) -> None:
        self._deviation = Deviation("{joint} is {found} rad from where its controller wants it, allowed are {allowed}")
        self._allowed: Array = np.full(6, DEVIATION_RAD)

    def __call__(self, status: ArmStatus) -> str | None:
        """Why the arm must stop, or None."""
        return self._deviation(np.abs(np.subtract(status.target_q_rad, status.q_rad)), self._allowed)


class Following:
    """Whether a controller follows what it is sent: if it took nothing any more, its connection would not show it.

    Args:
        servoj: Settings of `servoj`, which say how far behind it may be.
    """

    def __init__(self, servoj: ServojProfile) -> None:
        self._behind_s = servoj.lookahead_s + _ON_ITS_WAY_S
        self._forgetting = math.exp(-servoj.tick_s / _FORGETTING_S)
        self._target: Array | None = None
        self._speed: Array = np.zeros(6)
        self._tracking = Tracking()
        self._deviation = Deviation(
            "{joint} is led {found} rad from what was sent, allowed are {allowed}: the controller does not follow"
        )

    def sent(self, target_rad: Array, speed_rad_s: Array) -> None:
        """A target was sent, as fast as this."""
        self._target = target_rad
        self._speed = np.maximum(speed_rad_s, self._forgetting * self._speed)

    def __call__(self, status: ArmStatus) -> str | None:
        """Why the arm must stop, or None."""
        reason = self._tracking(status)
        if reason is not None or self._target is None:
            return reason
        return self._deviation(np.abs(self._target - status.target_q_rad), self._speed * self._behind_s + _SLACK_RAD)


class Heat:
    """Warns of joints that get hot, of each once until it has cooled down again.

    Args:
        name: Of the arm.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._told: set[int] = set()

    def __call__(self, status: ArmStatus) -> None:
        """Look at a state."""
        hot = {joint for joint, found in enumerate(status.temperature_c) if found > HOT_C}
        for joint in sorted(hot - self._told):
            log.warning(
                "%s: %s has %.0f °C: let it rest soon, a joint that is too hot stops the arm",
                self._name,
                JOINTS[joint],
                status.temperature_c[joint],
            )
        self._told = hot
