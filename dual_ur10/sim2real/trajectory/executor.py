"""Executor of trajectory goals on any cell: simulated, virtual, emulated or real.

    goal -> path with continuous acceleration -> rate of its time -> inverse of the servoj law -> SafetyGate -> Cell

An environment's adapter knows only past actions. A trajectory is known ahead, so that its targets are exact.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import ClosedError, DualUR10Error, SettingsError, StartError, TrajectoryError
from dual_ur10.kinematics.forward import flange_pose
from dual_ur10.kinematics.ur10 import ARMS, JOINTS, NOMINAL_DH, DHParameters
from dual_ur10.sim2real.config.cell import Cell, CellStep, Start
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.sim2real.control.proximity import ProximityScaling
from dual_ur10.sim2real.processes.interrupts import interrupts_deferred
from dual_ur10.sim2real.trajectory.course import Course, Rate
from dual_ur10.sim2real.trajectory.goal import REST_RAD_S, Feedback, GoalState, TrajectoryGoal
from dual_ur10.sim2real.trajectory.handle import GoalHandle
from dual_ur10.sim2real.trajectory.interpolation import Interpolation, Motion
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from dual_ur10.sim2real.trajectory.path_check import PathCheck, TargetLaw, reason_of, rehearse
from dual_ur10.sim2real.trajectory.smooth_path import ROUNDING_S, SmoothPath
from dual_ur10.types import Array, Closing

START_RAD: Final = 0.01
"""Largest distance of a first point at time 0 from where the arms are commanded to be."""

MEASURED_RAD: Final = 0.02
"""Largest measured distance of resting arms from where they are commanded to be, as after an approach."""

LEAST_SCALING: Final = 0.01
"""Smallest scaling."""

_SCALING_S: Final = 0.5  # shortest time in which the scaling changes
_JOINS_S: Final = (0.0, 0.06, 0.16, 0.36, 0.76, 1.56, 3.16)  # after the first instant at which a path can be met
_STRETCHES: Final = (1.0, 1.3, 1.7, 2.2, 3.0, 4.5, 7.0)  # of the shortest time in which the rate may change
_RESERVE: Final = 1.7  # the one for which a stream must know enough points
_KEPT_S: Final = 1.0  # of the past of a stream
_WINDOWS_AT_ONCE: Final = 100  # checked per period while the arms move: a few milliseconds

# Largest first and second derivative of a quintic step, and the fractions of the limits that a change of the rate uses.
_PEAK, _SECOND_PEAK = 1.875, 5.78
_OF_ACCELERATION, _OF_JERK = 0.6, 0.5
_SHORTEST_S: Final = 0.04

_NOT_STARTED: Final = "the arms have not been brought to a start: call start() first"


class _Desired(NamedTuple):
    """Commanded motion at the end of a tick."""

    path_s: float
    rate: float
    q_rad: Array


class _Pending(NamedTuple):
    """Goal that has not begun, and the check of its path."""

    handle: GoalHandle
    check: PathCheck


class TrajectoryExecutor(Closing):
    """Follows trajectories with both arms of a cell. The caller's loop advances the cell, one period at a time.

    Args:
        cell: The cell, which is closed with the executor.
        gate: Safety gate, whose window is the period.
        law: Makes the targets.
        clearance: Checks where the arms are to start.
        latency_ticks: Ticks from a command to its effect.
        dh: Kinematics of both arms, for the flange errors.
        proximity: Slows the cell down near things; None: nothing does.
        on_close: Called after the cell was closed, such as to end a record of it.
    """

    def __init__(
        self,
        cell: Cell,
        gate: SafetyGate,
        law: TargetLaw,
        clearance: Clearance,
        *,
        latency_ticks: int = 0,
        dh: Sequence[DHParameters] = (NOMINAL_DH, NOMINAL_DH),
        proximity: ProximityScaling | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self.cell, self.gate, self.law = cell, gate, law
        self._clearance, self._proximity = clearance, proximity
        self._latency_ticks, self._dh = latency_ticks, tuple(dh)
        self._limits, self._on_close = gate.limits, on_close
        self._scaling = 1.0
        self._closed = False
        self._why_not = _NOT_STARTED  # reason why nothing may move
        self._braking = False  # along the gate's brake
        self._in_time = False  # the last command did not come after a pause
        self._finished = True
        self._periods = 0
        self._active: GoalHandle | None = None
        self._stream: PathCheck | None = None  # of the active goal
        self._pending: _Pending | None = None
        self._course = Course.hold(np.zeros((2, 6)))
        self._past: deque[_Desired] = deque(maxlen=latency_ticks + 1)
        self._measured: Array = np.zeros((2, 6))

    # State.

    @property
    def time_s(self) -> float:
        """Time since `start` at the end of the last period, in the trajectory's time at a scaling of 1."""
        return self._periods * self.law.period_s

    @property
    def desired_q_rad(self) -> Array:
        """(2, 6) positions commanded for the end of the last period."""
        desired: Array = self._course(np.array([self.time_s])).q_rad[0]
        return desired

    @property
    def measured_q_rad(self) -> Array:
        """(2, 6) positions measured last."""
        return self._measured.copy()

    def flanges_m(self, q_rad: Array) -> Array:
        """Return the flange positions, (2, 3), in each arm's own `base` frame at joint positions (2, 6)."""
        return np.stack([flange_pose(q, dh)[0] for q, dh in zip(q_rad, self._dh, strict=True)])

    @property
    def moves(self) -> bool:
        """True until the commanded motion has ended; False after a fault."""
        if self._why_not or self._braking:
            return self._braking
        return not self._course.is_over(self.time_s - self._latency_ticks * self.law.tick_s)

    @property
    def scaling(self) -> float:
        """Rate of a goal's time, `LEAST_SCALING` to 1; it changes smoothly when it is set.

        Raises:
            SettingsError: It is outside that range.
        """
        return self._scaling

    @scaling.setter
    def scaling(self, value: float) -> None:
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not (number and LEAST_SCALING <= value <= 1.0):
            raise SettingsError(
                f"the scaling is {value!r}: allowed are {LEAST_SCALING:g} to 1; cancel a goal to stop it"
            )
        self._scaling = float(value)
        if self._active is not None and self._active.state == GoalState.ACTIVE:
            self._change_rate(self._scaling, least_s=_SCALING_S)

    # Commands, between two periods.

    def start(self, q_rad: Array) -> None:
        """Bring the arms to a configuration, (2, 6), where goals can begin; on controllers by a confirmed approach.

        Raises:
            SettingsError: The configuration is not finite, or bodies are too close in it. Nothing changes.
            StartError: There is no path, it was not confirmed, or an arm does not arrive.
            CellFaulted: The arms were stopped.
        """
        self._check_open()
        start = np.array(q_rad, dtype=np.float64).reshape(2, 6)
        self._clearance.check_start(start[None])
        if self._active is not None:
            self._end_preempted(self._active, "cancelled", "the arms were brought to another start")
        self._drop_pending("the arms are brought to another start")
        self._why_not, self._braking = _NOT_STARTED, False
        step = self.cell.reset(Start(start[None]))
        self._rest_at(start if step.stopped_q_rad is None else step.stopped_q_rad[0])
        self._measured = step.state.q_rad[0].copy()
        for dh in self._dh:  # the first call computes constants, for which a period has no time
            flange_pose(start, dh)
        self._periods, self._why_not, self._finished = 0, "", True

    def execute(self, goal: TrajectoryGoal | JointTrajectory) -> GoalHandle:
        """Take a goal; it ends a running one when it begins.

        A goal that cannot be followed is rejected, now or when its path has been checked; the running one continues.
        """
        self._check_open()
        handle = GoalHandle(self, TrajectoryGoal(goal) if isinstance(goal, JointTrajectory) else goal)
        goal = handle.goal
        if self._why_not:
            return self._reject(handle, self._why_not)
        if goal.start_s is not None and goal.start_s < self.time_s - 1e-9:
            text = f"the goal starts at {goal.start_s:g} s, and now is {self.time_s:g} s: choose a later start, or none"
            return self._reject(handle, text, ResultCode.OLD_HEADER_TIMESTAMP)
        if self._active is not None and not set(self._active.goal.rows) <= set(goal.rows):
            text = "an arm that moves is not in the goal: include it, or cancel the running goal and wait"
            return self._reject(handle, text, ResultCode.INVALID_JOINTS)
        if self._active is None and self.moves:
            return self._reject(handle, "both arms stop after an aborted goal: wait until they rest")
        if self._pending is not None:
            self._end_preempted(self._pending.handle, "replaced", "another goal came before this one began")
        if self._active is None:
            self._in_time = False
        self._pending = _Pending(handle, PathCheck(self._path_of(goal), self.gate, self.law))
        if self._active is None:
            self._check_pending(None)
        return handle

    def cancel(self, handle: GoalHandle) -> None:
        """See `GoalHandle.cancel`."""
        if self._pending is not None and handle is self._pending.handle:
            self._end_preempted(handle, "cancelled", "cancelled before it began")
        elif handle is self._active and handle.state == GoalState.ACTIVE:
            self._preempt(handle, "cancelled", "cancelled: both arms stopped on the path")

    def append(self, handle: GoalHandle, points: JointTrajectory) -> None:
        """See `GoalHandle.append`."""
        self._extend(handle, self._stream_of(handle).extended(points))

    def complete(self, handle: GoalHandle) -> None:
        """See `GoalHandle.complete`."""
        self._extend(handle, self._stream_of(handle).completed())

    def close(self) -> None:
        """Close the cell; moving arms stop. May be called twice."""
        self._closed = True
        try:
            self.cell.close()
        finally:
            if self._on_close is not None:
                self._on_close()

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("this executor was closed: make a new one")

    # A period.

    def step(self) -> None:
        """Advance the cell by one period. Without a goal the arms hold their position.

        Raises:
            StartError: The arms were not brought to a start, or were stopped.
            ClosedError: The executor was closed.
        """
        self._check_open()
        if self._why_not and not self._braking:
            raise StartError(self._why_not)
        with interrupts_deferred():  # the gate's record and the cell's must not part
            self._step()

    def _step(self) -> None:
        if not self._braking:
            if self._pending is not None:
                self._check_pending(None if self._active is None else _WINDOWS_AT_ONCE)
            if self._pending is not None:
                self._begin_if_due(self._pending)
            if self._stream is not None:
                self._stop_before_underrun()
        now = self.time_s
        released = self.gate(self.law.windows(self._course, now, 1)[0])
        scaling = 1.0
        if released.verdicts and not self._braking:
            self._braking = True
            self._why_not = f"the safety gate refused a target, and both arms brake: {reason_of(released.verdicts[0])}"
            self._fail("refused", self._why_not)
        elif self._proximity is not None and not self._braking:
            scaling = self._proximity(released.targets_rad[0, -1].reshape(12), self.gate.spare_m[0])
        try:
            step = self.cell.advance(Command(released.targets_rad, scaling=scaling))
        except DualUR10Error as error:
            self._braking, self._why_not = False, str(error)
            self._fail("stopped", self._why_not)
            return
        times = now + self.law.tick_s * np.arange(1, self.law.ticks + 1, dtype=np.float64)
        path_s, rate, _ = self._course.rate(times)
        self._past.extend(map(_Desired, path_s.tolist(), rate.tolist(), self._course(times).q_rad))
        self._periods += 1
        self._measured = step.state.q_rad[0].copy()
        self._evaluate(step)

    def _evaluate(self, step: CellStep) -> None:
        """React to the state after a period."""
        if step.state.failed[0]:
            self._braking, self._why_not = False, "the simulation diverged: call start() again"
            self._fail("diverged", self._why_not)
            return
        if step.stopped_q_rad is not None:  # late; without a goal that ends a pause
            self._braking = False
            self._rest_at(step.stopped_q_rad[0])
            self._fail("late", "this program missed the deadline of a period, and both arms stopped: it was too busy")
            return
        self._in_time = True
        if self._braking:
            if self.gate.rests[0]:
                self._braking = False
                self._why_not = f"{self._why_not}; they rest: call start() again"
                self.cell.finish()
        elif self._active is not None:
            self._observe(self._active, step.state.qd_rad_s[0])
        if not (self._finished or self.moves or self._active or self._pending):
            self._finished = True
            self.cell.finish()

    def _observe(self, handle: GoalHandle, qd_rad_s: Array) -> None:
        """Compare the arms of a goal with its path, and end it where that is due."""
        goal, rows, desired = handle.goal, handle.goal.rows, self._past[0]
        wanted, found = desired.q_rad[rows], self._measured[rows]
        error = wanted - found
        flanges = [flange_pose(q, self._dh[arm])[0] for arm, q in zip(rows, np.stack([wanted, found], 1), strict=True)]
        away = np.array([math.dist(*each) for each in flanges])
        handle.note(Feedback(self.time_s, desired.path_s, desired.rate, wanted, found, error, away))
        if self.moves:
            if (np.abs(error) > goal.path_tolerance_rad).any():
                worst = _worst(goal, error, goal.path_tolerance_rad)
                self._fail("path tolerance", f"{worst} from its path at {desired.path_s:.3f} s: both arms stop on it")
            return
        if handle.over_s is None:
            handle.over_s = self.time_s
        rests = bool((np.abs(qd_rad_s[rows]) <= REST_RAD_S).all())
        waited = self.time_s - handle.over_s >= goal.goal_time_s
        if handle.state == GoalState.PREEMPTING:
            if not (rests or waited):
                return
            if handle.reason == "underrun":
                code = ResultCode.GOAL_TOLERANCE_VIOLATED
                self._end(handle, GoalState.ABORTED, code, handle.reason, handle.text)
            else:
                self._end_preempted(handle, handle.reason, handle.text)
        elif rests and (np.abs(error) <= goal.goal_tolerance_rad).all():
            self._end(handle, GoalState.SUCCEEDED, ResultCode.SUCCESSFUL, "reached", "the goal was reached")
        elif waited:
            worst = _worst(goal, error, goal.goal_tolerance_rad) if rests else "an arm still moves"
            text = f"{worst} from the last point, {goal.goal_time_s:g} s after it: check what holds it, or allow more"
            self._end(handle, GoalState.ABORTED, ResultCode.GOAL_TOLERANCE_VIOLATED, "goal tolerance", text)

    # Ends.

    def _end(self, handle: GoalHandle, state: GoalState, code: ResultCode, reason: str, text: str) -> None:
        if handle is self._active:
            self._active = self._stream = None
        elif self._pending is not None and handle is self._pending.handle:
            self._pending = None
        handle.end(state, code, reason, text, self.time_s)

    def _end_preempted(self, handle: GoalHandle, reason: str, text: str) -> None:
        self._end(handle, GoalState.PREEMPTED, ResultCode.SUCCESSFUL, reason, text)

    def _reject(self, handle: GoalHandle, text: str, code: ResultCode = ResultCode.INVALID_GOAL) -> GoalHandle:
        self._end(handle, GoalState.REJECTED, code, "rejected", text)
        return handle

    def _drop_pending(self, text: str) -> None:
        if self._pending is not None:
            self._reject(self._pending.handle, text)

    def _fail(self, reason: str, text: str) -> None:
        """Abort the running goal, whose path the arms do not follow. Both arms stop on it, unless they stop already."""
        if self._why_not:
            self._drop_pending(text)
        if self._active is not None:
            self._end(self._active, GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED, reason, text)
            if not self._why_not:
                self._drop_pending(f"the goal before it was aborted: {text}")
                self._stop()

    def _preempt(self, handle: GoalHandle, reason: str, text: str, most_s: float = math.inf) -> None:
        handle.state, handle.reason, handle.text = GoalState.PREEMPTING, reason, text
        self._stop(most_s)

    def _rest_at(self, q_rad: Array) -> None:
        self.gate.reset(q_rad[None])
        if self._proximity is not None:
            self._proximity.reset(q_rad.reshape(12))
        self._course, self._in_time = Course.hold(q_rad), False
        self._past.clear()
        self._past.append(_Desired(0.0, 0.0, q_rad.copy()))

    # Beginning of a goal.

    def _path_of(self, goal: TrajectoryGoal) -> SmoothPath:
        return SmoothPath.of(Interpolation(goal.trajectory), goal.rows, self.desired_q_rad, is_open=goal.stream)

    def _check_pending(self, most: int | None) -> None:
        """Check the path of the pending goal, at most some windows of it."""
        if self._pending is None:
            return
        handle, check = self._pending
        refusal = check.work(_end_of_check(handle.goal, check, self.law), most)
        if refusal is not None:
            self._reject(handle, refusal.between(handle.goal.trajectory))

    def _begin_if_due(self, pending: _Pending) -> None:
        """Let the pending goal begin where its path is checked and its time has come."""
        handle, check = pending
        goal, now = handle.goal, self.time_s
        start_s = now if goal.start_s is None else goal.start_s
        if not self._in_time or now < start_s - 1e-9 or check.checked_s < _end_of_check(goal, check, self.law) - 1e-9:
            return
        refused = self._misplaced(goal) if self._active is None else ""
        begun_s, known_s = now - start_s, _known_s(goal, check.path)
        if goal.stream and known_s < max(check.path.start_s, begun_s + ROUNDING_S):
            return  # it waits for more points
        course = None if refused else self._joined(check.path, begun_s, known_s)
        if not isinstance(course, Course):
            self._reject(handle, refused or f"{course}")
            return
        if self._active is not None:
            before = self._active
            self._end_preempted(before, before.reason or "replaced", before.text or "another goal has begun")
        self._pending = None
        self._active, self._course, self._finished = handle, course, False
        self._stream = check if goal.stream else None
        handle.state = GoalState.ACTIVE

    def _misplaced(self, goal: TrajectoryGoal) -> str:
        """Return which joint of resting arms is not where it should be at the beginning of a goal; "" if none."""
        now = self.desired_q_rad
        off = np.abs(self._measured - now)
        if (off > MEASURED_RAD).any():
            arm, joint = np.unravel_index(int(off.argmax()), off.shape)
            return (
                f"{ARMS[arm]}/{JOINTS[joint]} is measured at {self._measured[arm, joint]:.4f} rad and was commanded to "
                f"{now[arm, joint]:.4f} rad: allowed are {MEASURED_RAD:g} rad between them. Check what holds it"
            )
        first = goal.trajectory.q_rad[0]
        off = np.abs(now[goal.rows] - first)
        if goal.trajectory.time_s[0] == 0.0 and (off > START_RAD).any():
            arm, joint = np.unravel_index(int(off.argmax()), off.shape)
            return (
                f"point 0 of {goal.trajectory.arms[arm]}/{JOINTS[joint]} is at {first[arm, joint]:.4f} rad, and it is "
                f"at {now[goal.rows][arm, joint]:.4f} rad: allowed are {START_RAD:g} rad between them at time 0. Bring "
                "the arms there first, or give the point a later time"
            )
        return ""

    def _joined(self, path: SmoothPath, begun_s: float, end_s: float) -> Course | str:
        """Return the course from the current motion onto a path that began some time ago, or why there is none."""
        now, rate = self.time_s, self._scaling
        motion = self._course(np.array([now]))
        leaving = Motion(motion.q_rad[0], motion.qd_rad_s[0] / rate, motion.qdd_rad_s2[0] / rate**2)
        first_s = max(path.start_s, begun_s + ROUNDING_S)
        refusal = None
        for later_s in _JOINS_S:
            meets_s = first_s + later_s
            if later_s and meets_s > end_s:
                break
            course = Course(path.joined(begun_s, leaving, meets_s), Rate.constant(now, begun_s, rate))
            windows = math.ceil((meets_s - begun_s) / rate / self.law.period_s) + HISTORY
            refusal = rehearse(self.gate.rehearsal(), self.law, course, now, windows)
            if refusal is None:
                return course
        return f"the way from the current motion onto the path is refused, {refusal}. Give the first point more time"

    # Rate of the path's time.

    def _shortest_s(self, change: float) -> float:
        """Return the shortest time in which the rate may change, by the speeds in the next second of the path."""
        ahead = self._course.path_s(self.time_s) + np.linspace(0.0, 1.0, 11)
        fastest = float(np.abs(self._course.path(ahead).qd_rad_s).max()) * abs(change)
        return max(
            _PEAK * fastest / (_OF_ACCELERATION * self._limits.acceleration_rad_s2),
            math.sqrt(_SECOND_PEAK * fastest / (_OF_JERK * self._limits.jerk_rad_s3)),
            _SHORTEST_S,
        )

    def _change_rate(self, goal: float, *, least_s: float = 0.0, most_s: float = math.inf) -> None:
        """Change the rate, as fast as the gate releases it. Where it releases nothing, its own brake will follow."""
        now, course = self.time_s, self._course
        shortest_s = max(self._shortest_s(course.rate.at(now) - goal), least_s)
        for stretch in _STRETCHES:
            duration_s = min(stretch * shortest_s, most_s)
            self._course = course._replace(rate=course.rate.towards(goal, now, duration_s))
            windows = math.ceil(duration_s / self.law.period_s) + HISTORY
            if rehearse(self.gate.rehearsal(), self.law, self._course, now, windows) is None:
                return

    def _stop(self, most_s: float = math.inf) -> None:
        """Stop both arms on the path."""
        if self._course.rate.goal and not self._course.is_over(self.time_s):
            self._change_rate(0.0, most_s=most_s)

    # Streams.

    def _stream_of(self, handle: GoalHandle) -> TrajectoryGoal:
        if not handle.goal.stream or handle.state not in (GoalState.PENDING, GoalState.ACTIVE):
            kind = "stream" if handle.goal.stream else "goal that is no stream"
            raise TrajectoryError(f"this {kind} is {handle.state}: points can be appended to a running stream only")
        return handle.goal

    def _extend(self, handle: GoalHandle, goal: TrajectoryGoal) -> None:
        """Continue a stream with more points, or end it.

        Raises:
            TrajectoryError: The gate would refuse a target on the way. Nothing changes.
        """
        check = self._stream if self._pending is None or handle is not self._pending.handle else self._pending.check
        if check is None:
            raise TrajectoryError("this stream has ended: send another goal")
        known_s, from_s = _known_s(handle.goal, check.path), -math.inf
        if handle is self._active:
            from_s = self._course.path_s(self.time_s) - _KEPT_S
            goal = goal.since(from_s)
        following = self._path_of(goal)
        ahead = check.on(check.path.continued(following, known_s, from_s))
        refusal = ahead.work(_end_of_check(goal, ahead, self.law))
        if refusal is not None:
            raise TrajectoryError(refusal.between(goal.trajectory))
        handle.goal = goal
        if handle is self._active:
            self._course = self._course._replace(path=self._course.path.continued(following, known_s, from_s))
            self._stream = ahead if goal.stream else None
        else:
            self._pending = _Pending(handle, ahead)

    def _stop_before_underrun(self) -> None:
        """Stop both arms where a stream does not know enough points."""
        handle, check = self._active, self._stream
        if handle is None or check is None or handle.state != GoalState.ACTIVE:
            return
        rate = self._course.rate.at(self.time_s)
        left_s = min(_known_s(handle.goal, check.path), check.checked_s) - self._course.path_s(self.time_s)
        if left_s <= rate * (_RESERVE * self._shortest_s(rate) / 2 + 2 * self.law.period_s):
            text = (
                f"no point after {handle.goal.trajectory.duration_s:.3f} s came in time, and both arms stopped before "
                "it. Send points earlier, or complete the stream"
            )
            self._preempt(handle, "underrun", text, most_s=max(2.0 * left_s / rate, self.law.period_s))


def _known_s(goal: TrajectoryGoal, path: SmoothPath) -> float:
    """Return the time of the trajectory up to which further points change nothing; its end, if it is no stream."""
    return max(path.start_s, goal.trajectory.duration_s - ROUNDING_S) if goal.stream else path.end_s


def _end_of_check(goal: TrajectoryGoal, check: PathCheck, law: TargetLaw) -> float:
    """Return the time of the trajectory up to which its path must be checked."""
    return _known_s(goal, check.path) + (0.0 if goal.stream else HISTORY * law.tick_s)


def _worst(goal: TrajectoryGoal, error: Array, tolerance: Array) -> str:
    """Return the joint that exceeds its tolerance most."""
    arm, joint = np.unravel_index(int((np.abs(error) / tolerance).argmax()), error.shape)
    name = f"{goal.trajectory.arms[arm]}/{JOINTS[joint]}"
    return f"{name} is {abs(error[arm, joint]):.4f} rad, allowed are {tolerance[arm, joint]:g} rad,"
