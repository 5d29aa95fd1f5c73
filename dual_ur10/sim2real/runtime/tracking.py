"""Tracking errors of an arm: of the controller against the targets sent, and of the arm against its controller.

Joint temperatures, too: an overheated joint stops tracking.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.errors import distinguishable
from dual_ur10.kinematics.ur10 import JOINTS
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.links.arm_status import ArmStatus
from dual_ur10.types import Array

log = logging.getLogger(__name__)

HOT_C: Final = 70.0
"""Joint temperature above which a warning is logged. Our choice: Universal Robots publishes no figure."""

DEVIATION_RAD: Final = 0.1
"""Largest deviation of an arm from its controller's target: half of what Universal Robots' ROS 2 driver allows."""

_ROWS: Final = 3  # consecutive states: a single one may lie between two updates
_TRANSIT_S: Final = 0.08  # longest time from sending a target to its effect
_SLACK_RAD: Final = 0.02
_FORGETTING_S: Final = 0.4  # time constant with which the largest recent speed decays


_ALLOWED_RAD: Final = (DEVIATION_RAD,) * 6


class Deviation:
    """Counts consecutive states with a deviation above its limit.

    Args:
        text: Reason to report, with `{joint}`, `{found}` and `{allowed}`.
    """

    def __init__(self, text: str) -> None:
        self._text, self._rows = text, 0

    def __call__(self, apart_rad: Sequence[float] | Array, allowed_rad: Sequence[float] | Array) -> str | None:
        """Return the reason why the arm must stop, or None."""
        for apart, allowed in zip(apart_rad, allowed_rad, strict=True):
            if not apart <= allowed:  # NaN, too
                break
        else:
            self._rows = 0
            return None
        self._rows += 1
        if self._rows < _ROWS:
            return None
        over = np.subtract(apart_rad, allowed_rad)
        joint = int(np.where(np.isnan(over), np.inf, over).argmax())
        found, allowed = distinguishable(apart_rad[joint], allowed_rad[joint])
        return self._text.format(joint=JOINTS[joint], found=found, allowed=allowed)


class Tracking:
    """Deviation of an arm from its controller's target."""

    def __init__(self) -> None:
        self._deviation = Deviation("{joint} is {found} rad from where its controller wants it, allowed are {allowed}")

    def __call__(self, status: ArmStatus) -> str | None:
        """Return the reason why the arm must stop, or None."""
        return self._deviation(_distances(status.target_q_rad, status.q_rad), _ALLOWED_RAD)


class Following:
    """Deviation of a controller from the targets sent: a controller that takes no more targets keeps its connection.

    Args:
        servoj: Settings of `servoj`, from which its lag follows.
    """

    def __init__(self, servoj: ServojProfile) -> None:
        self._behind_s = servoj.lookahead_s + _TRANSIT_S
        self._forgetting = math.exp(-servoj.tick_s / _FORGETTING_S)
        self._target: Sequence[float] | Array | None = None
        self._speed = [0.0] * 6
        self._tracking = Tracking()
        self._deviation = Deviation(
            "{joint} has a target {found} rad from the one sent, allowed are {allowed}: the controller does not follow"
        )

    def sent(self, target_rad: Sequence[float] | Array, speed_rad_s: Sequence[float] | Array) -> None:
        """Record a target sent and its speed, six plain numbers each."""
        self._target = target_rad
        kept = self._forgetting
        self._speed = [max(new, kept * old) for new, old in zip(speed_rad_s, self._speed, strict=True)]

    def __call__(self, status: ArmStatus) -> str | None:
        """Return the reason why the arm must stop, or None."""
        reason = self._tracking(status)
        if reason is not None or self._target is None:
            return reason
        allowed = [speed * self._behind_s + _SLACK_RAD for speed in self._speed]
        return self._deviation(_distances(self._target, status.target_q_rad), allowed)


def _distances(first: Sequence[float] | Array, second: Sequence[float]) -> list[float]:
    # Six plain numbers: an array for so few takes ten times as long, in every control period.
    return [abs(one - other) for one, other in zip(first, second, strict=True)]


class TemperatureWarning:
    """Warns of hot joints, of each once until it has cooled down.

    Args:
        name: Arm.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._warned: set[int] = set()

    def __call__(self, status: ArmStatus) -> None:
        """Check a state."""
        hot = {joint for joint, found in enumerate(status.temperature_c) if found > HOT_C}
        for joint in sorted(hot - self._warned):
            log.warning(
                "%s: %s has %.0f °C: let it rest soon, an overheated joint stops the arm",
                self._name,
                JOINTS[joint],
                status.temperature_c[joint],
            )
        self._warned = hot
