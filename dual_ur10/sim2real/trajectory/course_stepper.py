"""Steps of a cell along a course: targets, safety gate, brake, and joins and rates that the gate releases."""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.cell.cell import Cell, CellStep, Start
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.sim2real.control.proximity import ProximityScaling
from dual_ur10.sim2real.trajectory.course import Course, Rate
from dual_ur10.sim2real.trajectory.interpolation import JointMotion
from dual_ur10.sim2real.trajectory.path_check import TargetLaw, reason_of, rehearse
from dual_ur10.sim2real.trajectory.smooth_path import ROUNDING_S, SmoothPath
from ur_core.processes.machine_load import too_busy
from ur_core.types import Array

_MOST_WINDOWS: Final = 5000  # of one way onto a path, which is checked within a period: 0.1 s
_JOINS_S: Final = (0.0, 0.06, 0.16, 0.36, 0.76, 1.56, 3.16)  # after the first instant at which a path can be met
_STRETCHES: Final = (1.0, 1.3, 1.7, 2.2, 3.0, 4.5, 7.0)  # of the shortest time in which the rate may change

# Largest first and second derivative of a quintic step, and the fractions of the limits that a change of the rate uses.
_PEAK, _SECOND_PEAK = 1.875, 5.78
_OF_ACCELERATION, _OF_JERK = 0.6, 0.5
_SHORTEST_S: Final = 0.04

_WAY_REFUSED: Final = "the way from the current motion onto the path is refused"
_NOT_STARTED: Final = "the arms have not been brought to a start: call start() first"


class Desired(NamedTuple):
    """Commanded motion at the end of a tick.

    Attributes:
        path_s: Time of the trajectory.
        rate: Rate of that time.
        q_rad: (2, 6) positions.
    """

    path_s: float
    rate: float
    q_rad: Array


class Departure(NamedTuple):
    """Reason why the arms have left their course.

    Attributes:
        reason: Short name, as in `Result`.
        text: Description.
    """

    reason: str
    text: str


class CourseStepper:
    """Follower of a course with both arms of a cell, period by period.

    Args:
        cell: The cell.
        gate: Safety gate, whose window is the period.
        law: Makes the targets.
        latency_ticks: Ticks from a command to its effect.
        proximity: Slows the cell down near things; None: nothing does.

    Attributes:
        course: Commanded motion; replace it between two periods only.
        why_not: Reason why nothing may move; "": there is none.
        brakes: True while both arms follow the gate's brake.
        in_time: True while commands come without a pause.
        measured_q_rad: (2, 6) positions measured last.
        measured_qd_rad_s: (2, 6) speeds, likewise.
    """

    def __init__(
        self, cell: Cell, gate: SafetyGate, law: TargetLaw, latency_ticks: int, proximity: ProximityScaling | None
    ) -> None:
        self.cell, self.gate, self.law = cell, gate, law
        self._latency_ticks, self._proximity = latency_ticks, proximity
        self.why_not, self.brakes, self.in_time = _NOT_STARTED, False, False
        self.course = Course.hold(np.zeros((2, 6)))
        self.measured_q_rad: Array = np.zeros((2, 6))
        self.measured_qd_rad_s: Array = np.zeros((2, 6))
        self._periods = 0
        self._past: deque[Desired] = deque(maxlen=latency_ticks + 1)

    @property
    def time_s(self) -> float:
        """Time since `start` at the end of the last period, in the trajectory's time at a scaling of 1."""
        return self._periods * self.law.period_s

    @property
    def desired_q_rad(self) -> Array:
        """(2, 6) positions commanded for the end of the last period."""
        desired: Array = self.course(np.array([self.time_s])).q_rad[0]
        return desired

    @property
    def effective(self) -> Desired:
        """Commanded motion that the state measured last shows, `latency_ticks` ago."""
        return self._past[0]

    @property
    def moves(self) -> bool:
        """True until the commanded motion has ended; False after a fault."""
        if self.why_not or self.brakes:
            return self.brakes
        return not self.course.is_over(self.time_s - self._latency_ticks * self.law.tick_s)

    def start(self, q_rad: Array) -> None:
        """Bring the arms to a configuration, (2, 6); see `TrajectoryExecutor.start`."""
        self.why_not, self.brakes = _NOT_STARTED, False
        step = self.cell.reset(Start(q_rad[None]))
        self._rest_at(q_rad if step.stopped_q_rad is None else step.stopped_q_rad[0])
        self._note(step)
        self._periods, self.why_not = 0, ""

    def release(self) -> tuple[Command, Departure | None]:
        """Return the next period's command from the gate, and why both arms brake, if that begins now."""
        released = self.gate(self.law.windows(self.course, self.time_s, 1)[0])
        departure, scaling = None, 1.0
        if released.verdicts and not self.brakes:
            self.brakes = True
            self.why_not = f"the safety gate refused a target, and both arms brake: {reason_of(released.verdicts[0])}"
            departure = Departure("refused", self.why_not)
        elif self._proximity is not None and not self.brakes:
            scaling = self._proximity(released.targets_rad[0, -1].reshape(12), self.gate.spare_m[0])
        return Command(released.targets_rad, scaling=scaling), departure

    def advance(self, command: Command) -> Departure | None:
        """Advance the cell by a period, and return why the arms have left the course, if they have."""
        now = self.time_s
        try:
            step = self.cell.advance(command)
        except DualUR10Error as error:
            self.brakes, self.why_not = False, str(error)
            return Departure("stopped", self.why_not)
        times = now + self.law.tick_s * np.arange(1, self.law.ticks + 1, dtype=np.float64)
        path_s, rate, _ = self.course.rate(times)
        self._past.extend(map(Desired, path_s.tolist(), rate.tolist(), self.course(times).q_rad))
        self._periods += 1
        self._note(step)
        if step.state.failed[0]:
            self.brakes, self.why_not = False, "the simulation diverged: call start() again"
            return Departure("diverged", self.why_not)
        if step.stopped_q_rad is not None:  # late; without a goal that ends a pause
            self.brakes = False
            self._rest_at(step.stopped_q_rad[0])
            found = "this program missed the deadline of a period, and both arms stopped"
            return Departure("late", too_busy(found))
        self.in_time = True
        if self.brakes and self.gate.rests[0]:
            self.brakes = False
            self.why_not = f"{self.why_not}; they rest: call start() again"
            self.cell.finish()
        return None

    def _note(self, step: CellStep) -> None:
        self.measured_q_rad = step.state.q_rad[0].copy()
        self.measured_qd_rad_s = step.state.qd_rad_s[0].copy()

    def _rest_at(self, q_rad: Array) -> None:
        self.gate.reset(q_rad[None])
        if self._proximity is not None:
            self._proximity.reset(q_rad.reshape(12))
        self.course, self.in_time = Course.hold(q_rad), False
        self._past.clear()
        self._past.append(Desired(0.0, 0.0, q_rad.copy()))

    # Changes of the course.

    def follow(self, course: Course) -> None:
        """Continue on another path. Until the arms show its motion, its time counts as that of its beginning."""
        begun_s = course.path_s(self.time_s)
        self.course = course
        for row, each in enumerate(self._past):
            self._past[row] = each._replace(path_s=begun_s)

    def joined(self, path: SmoothPath, begun_s: float, end_s: float, rate: float) -> Course | str:
        """Return the course from the current motion onto a path that began some time ago, or why there is none.

        Args:
            path: The path.
            begun_s: Time of the path now.
            end_s: Time of the path by which it must be met.
            rate: Rate of the path's time.
        """
        now = self.time_s
        motion = self.course(np.array([now]))
        leaving = JointMotion(motion.q_rad[0], motion.qd_rad_s[0] / rate, motion.qdd_rad_s2[0] / rate**2)
        first_s = max(path.start_s, begun_s + ROUNDING_S)
        refusal = None
        for later_s in _JOINS_S:
            meets_s = first_s + later_s
            if later_s and meets_s > end_s:
                break
            windows = math.ceil((meets_s - begun_s) / rate / self.law.period_s) + HISTORY
            if windows > _MOST_WINDOWS:
                most_s = (_MOST_WINDOWS - HISTORY) * self.law.period_s
                takes = f"it takes {(meets_s - begun_s) / rate:g} s at a scaling of {rate:g}, allowed are {most_s:g} s"
                return f"{_WAY_REFUSED}, {refusal or takes}. Let the first point come sooner, or raise the scaling"
            course = Course(path.joined(begun_s, leaving, meets_s), Rate.constant(now, begun_s, rate))
            refusal = rehearse(self.gate.rehearsal(), self.law, course, now, windows)
            if refusal is None:
                return course
        return f"{_WAY_REFUSED}, {refusal}. Give the first point more time"

    def shortest_s(self, change: float) -> float:
        """Return the shortest time in which the rate may change, by the speeds in the next second of the path."""
        ahead = self.course.path_s(self.time_s) + np.linspace(0.0, 1.0, 11)
        fastest = float(np.abs(self.course.path(ahead).qd_rad_s).max()) * abs(change)
        return max(
            _PEAK * fastest / (_OF_ACCELERATION * self.gate.limits.acceleration_rad_s2),
            math.sqrt(_SECOND_PEAK * fastest / (_OF_JERK * self.gate.limits.jerk_rad_s3)),
            _SHORTEST_S,
        )

    def change_rate(self, goal: float, *, least_s: float = 0.0, most_s: float = math.inf) -> None:
        """Change the rate, as fast as the gate releases it. Where it releases nothing, its own brake will follow."""
        now, course = self.time_s, self.course
        shortest_s = max(self.shortest_s(course.rate.at(now) - goal), least_s)
        for stretch in _STRETCHES:
            duration_s = min(stretch * shortest_s, most_s)
            self.course = course._replace(rate=course.rate.towards(goal, now, duration_s))
            windows = math.ceil(duration_s / self.law.period_s) + HISTORY
            if rehearse(self.gate.rehearsal(), self.law, self.course, now, windows) is None:
                return

    def stop(self, most_s: float = math.inf) -> None:
        """Stop both arms on the path."""
        if self.course.rate.goal and not self.course.is_over(self.time_s):
            self.change_rate(0.0, most_s=most_s)
