"""Tracking errors of an arm: of the controller against the targets sent, and of the arm against its controller.

Joint temperatures, too: an overheated joint stops tracking.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.errors import distinguishable
from ur_core.kinematics.ur10 import HARD_ACCELERATION_RAD_S2, HARD_SPEED_RAD_S, JOINTS
from ur_core.links.arm_status import ArmStatus
from ur_core.servoj import ServojLaw, ServojProfile
from ur_core.types import Array

log = logging.getLogger(__name__)

HOT_C: Final = 70.0
"""Joint temperature above which a warning is logged. Our choice: Universal Robots publishes no figure."""

DEVIATION_RAD: Final = 0.1
"""Largest deviation of an arm from its controller's target: half of what Universal Robots' ROS 2 driver allows."""

_ROWS: Final = 3  # consecutive states: a single one may lie between two updates
_TRANSIT_S: Final = 0.06  # longest time from sending a target to its effect
_SLACK_RAD: Final = 0.005  # of a controller's target, besides overshoot
_PATH_S: Final = 0.5  # of targets, before those of the lag, where a controller with a slow network may be

_BESIDE_RAD: Final = 1e-3  # from a straight path, of a controller's target that is only late

_BETWEEN: Final = 8  # points of that path per target
_NEXT: Final = 0.99  # numbers from one target to the next, but for drifting clocks

_NOT_FOLLOWING: Final = (
    "the controller does not follow; look at its network, and for another program that holds the arm"
)
_REPLACED: Final = "another program replaced the control script"

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


class TrackingMonitor:
    """Deviation of an arm from its controller's target."""

    def __init__(self) -> None:
        self._deviation = Deviation("{joint} is {found} rad from where its controller wants it, allowed are {allowed}")

    def __call__(self, status: ArmStatus) -> str | None:
        """Return the reason why the arm must stop, or None."""
        return self._deviation(_distances(status.target_q_rad, status.q_rad), _ALLOWED_RAD)


class Following:
    """Deviation of a controller from the targets sent: a controller that takes no more targets keeps its connection.

    `servoj` leads each joint between the targets that it got: to the newest, or behind it by no more than its lag. A
    target of the controller outside the range of those sent within this time is none of ours. If it is near no point of
    the last path at all, whatever the delay, another program commands the arm.

    Args:
        servoj: Settings of `servoj`, from whose law its lag and overshoot follow.

    Attributes:
        lost: True once the controller does not follow.
    """

    def __init__(self, servoj: ServojProfile) -> None:
        lag_s, overshoot_rad = _lag_and_overshoot(servoj)
        periods = math.ceil((lag_s + _TRANSIT_S) / servoj.tick_s)
        # Second-order term by which the law differs from a pure delay, per second difference of the targets.
        self._cut = abs(servoj.lookahead_s**2 / 2.0 - 1.0 / servoj.gain) / servoj.tick_s**2
        self._slack_rad = _SLACK_RAD + overshoot_rad
        self._allowed = (self._slack_rad,) * 6
        self._recent: deque[Sequence[float]] = deque(maxlen=1 + periods)
        self._path: deque[Sequence[float]] = deque(maxlen=1 + periods + math.ceil(_PATH_S / servoj.tick_s))
        self._newest: Sequence[float] = ()
        self._index = -math.inf  # of the last target in both
        self._tracking = TrackingMonitor()
        self._deviation = Deviation("{joint} has a target {found} rad from those sent, allowed are {allowed}")
        self.lost = False

    def sent(self, target_rad: Sequence[float], index: float) -> None:
        """Record a target sent, six plain numbers.

        Args:
            target_rad: The target.
            index: Its number. A slider that slows numbers down lets a controller lag by as many of them, for longer.
        """
        self._newest = target_rad
        if index - self._index > _NEXT:
            self._index = index
            self._recent.append(target_rad)
            self._path.append(target_rad)

    def __call__(self, status: ArmStatus) -> str | None:
        """Return the reason why the arm must stop, or None."""
        reason = self._tracking(status)
        if reason is not None or not self._recent:
            return reason
        target, recent = status.target_q_rad, self._recent
        # Nearly always it is between a few of them, and so between all.
        few = list(zip(recent[0], recent[len(recent) // 2], recent[-1], self._newest, strict=True))
        outside = _outside(target, few)
        if not max(outside) <= self._slack_rad:  # NaN, too
            outside = _outside(target, list(zip(*recent, self._newest, strict=True)))
        reason = self._deviation(outside, self._allowed)
        if reason is None:
            return None
        self.lost = True
        return f"{reason}: {_REPLACED if self._is_off_path(target) else _NOT_FOLLOWING}"

    def _is_off_path(self, target_rad: Sequence[float]) -> bool:
        """Return True if a controller's target is near no point of the last path sent; False if it is no number.

        A late controller remains on the path, but for the corners that its law cuts: that shows slow programs, too.
        """
        path = np.array([*self._path, self._newest])
        curved = float(np.abs(np.diff(path, n=2, axis=0)).max(initial=0.0))
        beside_rad = min(self._slack_rad, _BESIDE_RAD + self._cut * curved)
        share = np.arange(_BETWEEN)[:, None, None] / _BETWEEN
        dense = np.concatenate([(path[:-1] + share * np.diff(path, axis=0)).reshape(-1, 6), path[-1:]])
        return bool(np.abs(dense - target_rad).max(axis=1).min() > beside_rad)


def _lag_and_overshoot(servoj: ServojProfile) -> tuple[float, float]:
    """Return the longest lag of the servoj law, s, and its overshoot, rad.

    The lag is the lookahead, or longer: until what is left of 1 rad/s, once targets rest, is within the slack by the
    law's slowest decay. A law that does not oscillate begins more slowly: there it is what is left of a joint's hard
    speed. The overshoot is twice that of a step, of the distance by which a joint is behind at the hard acceleration.
    """
    damping, frequency = servoj.damping, math.sqrt(servoj.gain)
    slowest_s = 1.0 / (frequency * (damping - math.sqrt(max(damping**2 - 1.0, 0.0))))
    lag_s = max(servoj.lookahead_s, slowest_s * math.log(servoj.lookahead_s / _SLACK_RAD))
    law = ServojLaw(servoj.lookahead_s, servoj.gain)
    left = law.transition(lag_s) @ np.array([-servoj.lookahead_s, 1.0]) * HARD_SPEED_RAD_S.max()
    while damping >= 1.0 and abs(left[0]) > _SLACK_RAD:
        left, lag_s = law.transition(servoj.tick_s) @ left, lag_s + servoj.tick_s
    part = math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2)) if damping < 1.0 else 0.0
    return lag_s, 2.0 * part * HARD_ACCELERATION_RAD_S2 / servoj.gain


def _outside(target_rad: Sequence[float], sent_rad: Sequence[Sequence[float]]) -> list[float]:
    """Return how far six joints are outside the range of the targets sent, (6, n); NaN stays NaN."""
    return [
        max(min(each) - joint, joint - max(each), 0.0) if math.isfinite(joint) else math.nan
        for joint, each in zip(target_rad, sent_rad, strict=True)
    ]


def _distances(first: Sequence[float] | Array, second: Sequence[float]) -> list[float]:
    # Six plain numbers: an array for so few takes ten times as long, in every control period.
    return [abs(one - other) for one, other in zip(first, second, strict=True)]


class PayloadWarning:
    """Warns of a payload that something sets while this program moves the arm: a start compared it with the cell file.

    Args:
        name: Arm.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._payload_kg: float | None = None

    def __call__(self, status: ArmStatus) -> None:
        """Check a state."""
        before_kg, self._payload_kg = self._payload_kg, status.payload_kg
        if before_kg is not None and status.payload_kg is not None and before_kg != status.payload_kg:
            log.warning(
                "%s: the payload that is set on its controller changed from %g to %g kg: another program or person set "
                "it. A wrong one causes tracking errors and protective stops",
                self._name,
                before_kg,
                status.payload_kg,
            )


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
