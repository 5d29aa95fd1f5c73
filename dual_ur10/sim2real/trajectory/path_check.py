"""Targets of a course, and its check by a safety gate before anything moves."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np

from dual_ur10.sim2real.control.gate import SafetyGate, Verdict
from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.sim2real.trajectory.course import Course, Rate
from dual_ur10.sim2real.trajectory.interpolation import JointMotion
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.smooth_path import SmoothPath
from ur_core.servoj import ServojProfile
from ur_core.types import Array

_WINDOWS_AT_ONCE: Final = 1000  # of which a rehearsal computes the targets together


@dataclass(frozen=True)
class TargetLaw:
    """Inverse of the law of `servoj`: targets with which arms make a motion without lag.

    Attributes:
        tick_s: Time between two targets.
        ticks: Targets per window of the gate.
        lookahead_s: Lookahead of the law, in the trajectory's time.
        gain: Gain of the law, likewise.
        lead_s: Time by which targets are sent ahead: half of that for which one is held.
    """

    tick_s: float
    ticks: int
    lookahead_s: float
    gain: float
    lead_s: float

    @classmethod
    def of(cls, profile: ServojProfile, ticks: int, speed_factor: float, lookahead_s: float | None) -> Self:
        """Return the law of a cell.

        Args:
            profile: Settings of `servoj`.
            ticks: Targets per window.
            speed_factor: Rate of the trajectory's time in real time.
            lookahead_s: Measured lookahead; None: that of `profile`.
        """
        lookahead_s = profile.lookahead_s if lookahead_s is None else lookahead_s
        lead_s = profile.tick_s * speed_factor / 2
        return cls(profile.tick_s, ticks, lookahead_s * speed_factor, profile.gain / speed_factor**2, lead_s)

    @property
    def period_s(self) -> float:
        """Duration of a window."""
        return self.ticks * self.tick_s

    def inverse(self, motion: JointMotion) -> Array:
        """Return the targets of a motion, (m, 2, 6)."""
        return motion.q_rad + self.lookahead_s * motion.qd_rad_s + motion.qdd_rad_s2 / self.gain

    def windows(self, course: Course, from_s: float, count: int) -> Array:
        """Return the targets of some windows from a time on, (count, 1, ticks, 2, 6)."""
        times = from_s + self.lead_s + self.tick_s * np.arange(count * self.ticks, dtype=np.float64)
        return self.inverse(course(times)).reshape(count, 1, self.ticks, 2, 6)

    def past(self, path: SmoothPath) -> Array:
        """Return the targets before the start of a path, (1, HISTORY, 2, 6), as if it had begun earlier."""
        times = path.start_s + self.lead_s + self.tick_s * np.arange(-HISTORY, 0, dtype=np.float64)
        return self.inverse(path.extended(times))[None]


class Refusal(NamedTuple):
    """Reason why a safety gate refuses a course.

    Attributes:
        path_s: Time of the trajectory at the beginning of the refused window.
        verdict: Finding of the gate.
    """

    path_s: float
    verdict: Verdict

    def __str__(self) -> str:
        return f"at {self.path_s:.3f} s {reason_of(self.verdict)}"

    def between(self, trajectory: JointTrajectory) -> str:
        """Return the reason with the points between which it is."""
        remedy = "Give the points more time, and speeds and accelerations that fit"
        if self.verdict.kind in ("distance", "joint position"):
            remedy = "Choose another path there"
        return f"the path is refused {trajectory.place(self.path_s)}, {self}. {remedy}"


def reason_of(verdict: Verdict) -> str:
    """Return what a gate has found, without the reaction of an episode."""
    return str(verdict).split(" (tick ", 1)[0]


def rehearse(gate: SafetyGate, law: TargetLaw, course: Course, from_s: float, count: int) -> Refusal | None:
    """Pass windows of a course through a gate for checks, and return the first refusal."""
    for first in range(0, count, _WINDOWS_AT_ONCE):
        windows = law.windows(course, from_s + first * law.period_s, min(_WINDOWS_AT_ONCE, count - first))
        for number, window in enumerate(windows, first):
            verdicts = gate(window).verdicts
            if verdicts:
                return Refusal(course.path_s(from_s + number * law.period_s), verdicts[0])
    return None


class PathCheck:
    """Check of a path at full rate, in parts.

    Args:
        path: The path.
        gate: Gate whose limits and distances count; it does not change.
        law: Makes the targets.
    """

    def __init__(self, path: SmoothPath, gate: SafetyGate, law: TargetLaw) -> None:
        self.path, self._law = path, law
        self._gate = gate.rehearsal(law.past(path))
        self._start_s, self._windows = path.start_s, 0

    @property
    def checked_s(self) -> float:
        """Time of the trajectory up to which the path was checked."""
        return self._start_s + self._windows * self._law.period_s

    def on(self, path: SmoothPath) -> PathCheck:
        """Return a check that continues this one on a path that is equal so far."""
        result = copy.copy(self)
        result.path, result._gate = path, self._gate.rehearsal()
        return result

    def work(self, until_s: float, most: int | None = None) -> Refusal | None:
        """Check up to a time of the trajectory, at most some windows."""
        count = max(math.ceil((until_s - self.checked_s) / self._law.period_s - 1e-9), 0)
        count = count if most is None else min(count, most)
        course = Course(self.path, Rate.constant(0.0, self._start_s, 1.0))
        found = rehearse(self._gate, self._law, course, self._windows * self._law.period_s, count)
        self._windows += count
        return found
