"""One path on its way to two controllers that interpolate its points; see `point_stream`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import LinkError
from dual_ur10.sim2real.control.link_profiles import LinkProfile
from dual_ur10.sim2real.programs.program_link import ProgramLink, check_ended, stop_programs
from dual_ur10.sim2real.programs.stream_script import (
    MOVE_PART,
    NOMINAL_RATE,
    PATH_TIME,
    RATE_BAND,
    REASONS,
    STATE,
    TOKEN,
    ProgramCommand,
    State,
)
from dual_ur10.sim2real.trajectory.point_path import PointPath
from ur_core.links.arm_status import ArmStatus, stop_reason
from ur_core.processes.clock import Clock
from ur_core.processes.machine_load import SHORT_S, StallWatch, too_busy
from ur_core.protocol.modes import RuntimeState

DWELL_S: Final = 0.6
"""Least time for which both arms rest before they move, while their path times are brought together."""

_STALE_S: Final = 0.2  # oldest state of a controller, in addition to an interval
_GAIN_1_S: Final = 0.5  # of the correction of the rate, per second of difference


class PathProgress(NamedTuple):
    """State of one arm on its path, as its controller reported it.

    Attributes:
        arm: Index of the arm.
        path_s: Time on the path, with the dwell.
        late_s: Time by which that is behind the sender's, s; NaN with `movej`.
        status: Status of the arm.
    """

    arm: int
    path_s: float
    late_s: float
    status: ArmStatus


class StreamMotion:
    """One path on its way to both controllers."""

    def __init__(
        self,
        arms: Sequence[ProgramLink],
        path: PointPath,
        profile: LinkProfile,
        clock: Clock,
        feedback: Callable[[PathProgress], None] | None,
        *,
        emulated: bool = False,
    ) -> None:
        self._stalls = StallWatch(emulated)
        self._arms, self._clock, self._feedback = arms, clock, feedback
        self._moves = profile.mode == "movej"
        self._interval_s = path.interval_s
        dwell_s = math.ceil(DWELL_S / path.interval_s) * path.interval_s
        self._time_s = np.concatenate([[0.0], dwell_s + path.interval_s * np.arange(len(path.q_rad))])
        self._q = np.concatenate([path.q_rad[:1], path.q_rad])
        self._qd = np.concatenate([path.qd_rad_s[:1], path.qd_rad_s])
        self._begin_s = math.inf
        self._late_s = 0.0  # of this program, with the last point
        self._next_s = math.inf  # time at which the next one is due
        self._count = [arm.link.count for arm in arms]

    @property
    def begun(self) -> bool:
        """True once the arms were told to move."""
        return self._begin_s < math.inf

    def run(self, canceled: Callable[[], bool]) -> bool:
        """Send all points; see `PointStream.run`.

        Raises:
            StartError: A program does not begin.
            LinkError: An arm does not go on, or a stop on request was not seen.
        """
        number = 0
        for arm in self._arms:
            arm.values["last"] = len(self._q)
        if not self._moves:
            for number in (1, 2):
                self._put(number)
                for arm in self._arms:
                    arm.wait(lambda state, seen, number=number: state == State.WAITING and seen == number, "a point")  # type: ignore[misc]  # a default binds the loop's value
        self._begin_s = self._clock.now_s()
        for arm in self._arms:
            arm.values["command"] = ProgramCommand.RUN
            arm.send()
        while True:
            self._next_s = self._due_s(number + 1)
            if canceled():
                check_ended(stop_programs(self._arms, self._clock))
                return False
            if self._poll():
                return True
            now_s = self._clock.now_s()
            if now_s >= self._next_s:
                number += 1
                self._late_s = now_s - self._next_s
                self._steer()
                self._put(number)
                continue
            until_s = min(self._next_s, now_s + self._interval_s)
            self._clock.wait([arm.link.fileno() for arm in self._arms], until_s)

    def _due_s(self, number: int) -> float:
        """Return the time at which a point is sent: in the middle of the interval before the one that ends with it."""
        if number > len(self._q):
            return math.inf
        if self._moves:
            return self._begin_s + self._interval_s * (number - 1)
        before = self._time_s[number - 2] if number > 2 else 0.0
        return float(self._begin_s + (before - self._interval_s / 2) / NOMINAL_RATE)

    def _put(self, number: int) -> None:
        time_s = MOVE_PART * self._interval_s if self._moves else float(self._time_s[number - 1])
        for k, arm in enumerate(self._arms):
            arm.put(number, self._q[number - 1, k], self._qd[number - 1, k], time_s)

    def _steer(self) -> None:
        """Correct the path times of both controllers by what they were behind since the last point.

        The least of several counts: delays of the network and of this machine only add to it.
        """
        if self._moves:
            return
        for arm in self._arms:
            late, arm.late_s = arm.late_s, []
            if not late:
                continue
            late_s = min(late)
            resting = (self._clock.now_s() - self._begin_s) * NOMINAL_RATE < self._time_s[1]
            if resting:
                arm.values["shift"] += late_s
            arm.values["rate"] = NOMINAL_RATE + min(max(_GAIN_1_S * late_s, -RATE_BAND / 2), RATE_BAND / 2)

    def _starved(self, found: str, now_s: float) -> str:
        """Return the text about a point that did not come in time."""
        late_s = max(self._late_s, now_s - self._next_s)
        if late_s > SHORT_S:
            return too_busy(f"{found}; this program was {1e3 * late_s:.0f} ms late with one")
        reason = self._stalls.explained(found, now_s)
        return (
            f"{reason}: check the link, and with `uptime` what else runs on this machine" if reason == found else reason
        )

    def _poll(self) -> bool:
        """Read the states of both arms; return True once both have finished.

        Raises:
            LinkError: An arm does not go on, or a connection was lost.
        """
        ended = []
        for number, arm in enumerate(self._arms):
            arm.poll()
            sample, now_s = arm.link.latest, self._clock.now_s()
            age_s = arm.link.age_s(now_s)
            if sample is None or age_s > self._interval_s + _STALE_S:
                other_s = self._arms[1 - number].link.age_s(now_s) - self._interval_s  # also without a stall
                raise LinkError(f"{arm.name}: {self._stalls.controller_silent(age_s, other_s, now_s)}")
            values: Any = sample.values
            state = values[STATE]
            status = ArmStatus.from_sample(sample)
            self._stalls.packet(number, sample.timestamp_s, sample.arrival_s)
            reason = stop_reason(status, playing=state < State.FINISHED) or REASONS.get(state) or slowed(status)
            if state == State.STARVED:
                reason = self._starved(REASONS[state], now_s)
            if values[TOKEN] != arm.token:
                reason = "another program runs on its controller"
            if reason is not None:
                raise LinkError(f"{arm.name}: {reason}")
            path_s = float(values[PATH_TIME])
            if arm.link.count > self._count[number] and state == State.MOVING and path_s < self._time_s[-1]:
                self._count[number] = arm.link.count
                late_s = math.nan if self._moves else (sample.arrival_s - self._begin_s) * NOMINAL_RATE - path_s
                arm.late_s.append(late_s)
                if self._feedback is not None:
                    self._feedback(PathProgress(number, path_s, late_s, status))
            ended.append(state == State.FINISHED and status.runtime_state == RuntimeState.STOPPED)
        return all(ended)


def slowed(status: ArmStatus) -> str | None:
    """Return the reason why an arm cannot keep the path's time; None: it can."""
    scaling = min(status.slider, status.speed_scaling)
    if scaling < 1.0 - 1e-6:
        return f"its speed is scaled to {100 * scaling:.0f} %: points have fixed times, so set the slider to 100 %"
    return None
