"""Executor of trajectory goals on any cell: simulated, virtual, emulated or real.

    goal -> path with continuous acceleration -> rate of its time -> inverse of the servoj law -> SafetyGate -> Cell

An environment's adapter knows only past actions. A trajectory is known ahead, so that its targets are exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.errors import ClosedError, SettingsError, StartError, TrajectoryError
from dual_ur10.sim2real.cell.cell import Cell
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import HISTORY
from dual_ur10.sim2real.control.proximity import ProximityScaling
from dual_ur10.sim2real.trajectory.course import Course
from dual_ur10.sim2real.trajectory.course_stepper import CourseStepper, Departure
from dual_ur10.sim2real.trajectory.goal import (
    REST_RAD_S,
    GoalState,
    TrajectoryGoal,
    feedback_of,
    misplaced,
    off_goal,
    off_path,
)
from dual_ur10.sim2real.trajectory.handle import GoalHandle
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode, too_long
from dual_ur10.sim2real.trajectory.path_check import PathCheck, TargetLaw
from dual_ur10.sim2real.trajectory.smooth_path import ROUNDING_S, SmoothPath
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.processes.interrupts import interrupts_deferred
from ur_core.types import Array, Closing

LEAST_SCALING: Final = 0.01
"""Smallest scaling."""

_SCALING_S: Final = 0.5  # shortest time in which the scaling changes
_RESERVE: Final = 1.7  # times the shortest stop: what a stream must know ahead
_KEPT_S: Final = 1.0  # of the past of a stream
_WINDOWS_AT_ONCE: Final = 100  # checked per period while the arms move: a few milliseconds


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
        only: Index of the only arm that moves; None: both may.
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
        dh: Sequence[DHParameters],
        proximity: ProximityScaling | None = None,
        only: int | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self.cell, self.gate, self.law = cell, gate, law
        self.stepper = CourseStepper(cell, gate, law, latency_ticks, proximity)
        self._clearance, self._dh, self._only, self._on_close = clearance, tuple(dh), only, on_close
        self._scaling = 1.0
        self._closed = False
        self._finished = True
        self._active: GoalHandle | None = None
        self._stream: PathCheck | None = None  # of the active goal
        self._pending: _Pending | None = None

    def __repr__(self) -> str:
        state = "closed" if self._closed else "moving" if self.moves else "at rest"
        return f"{type(self).__name__}({type(self.cell).__name__}, {state})"

    # State.

    @property
    def time_s(self) -> float:
        """Time since `start` at the end of the last period, in the trajectory's time at a scaling of 1."""
        return self.stepper.time_s

    @property
    def desired_q_rad(self) -> Array:
        """(2, 6) positions commanded for the end of the last period."""
        return self.stepper.desired_q_rad

    @property
    def measured_q_rad(self) -> Array:
        """(2, 6) positions measured last."""
        return self.stepper.measured_q_rad.copy()

    def flanges_m(self, q_rad: Array) -> Array:
        """Return the flange positions, (2, 3), in each arm's own `base` frame at joint positions (2, 6)."""
        return np.stack([flange_pose(q, dh)[0] for q, dh in zip(q_rad, self._dh, strict=True)])

    @property
    def moves(self) -> bool:
        """True until the commanded motion has ended; False after a fault."""
        return self.stepper.moves

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
            self.stepper.change_rate(self._scaling, least_s=_SCALING_S)

    # Commands, between two periods.

    def start(self, q_rad: Array) -> None:
        """Bring the arms to a configuration, (2, 6), where goals can begin; on controllers by a confirmed approach.

        Raises:
            SettingsError: The configuration is not finite or not within the joint range, or bodies are too close in it.
                Nothing changes.
            StartError: There is no path, it was not confirmed, or an arm does not arrive.
            CellFaulted: The arms were stopped.
        """
        self._check_open()
        start = np.array(q_rad, dtype=np.float64).reshape(2, 6)
        self.gate.limits.check_range(start)  # distances far outside the range mean nothing
        self._clearance.check_start(start[None])
        if self._active is not None:
            self._end_preempted(self._active, "cancelled", "the arms were brought to another start")
        self._drop_pending("the arms are brought to another start")
        self.stepper.start(start)
        for dh in self._dh:  # the first call computes constants, for which a period has no time
            flange_pose(start, dh)
        self._finished = True

    def execute(self, goal: TrajectoryGoal | JointTrajectory) -> GoalHandle:
        """Take a goal; it ends a running one when it begins.

        A goal that cannot be followed is rejected, now or when its path has been checked; the running one continues.
        """
        self._check_open()
        handle = GoalHandle(self, TrajectoryGoal(goal) if isinstance(goal, JointTrajectory) else goal)
        goal = handle.goal
        if self.stepper.why_not:
            return self._reject(handle, self.stepper.why_not)
        if text := too_long(goal.trajectory.duration_s):
            return self._reject(handle, text)
        if self._only is not None and (others := {*goal.rows} - {self._only}):
            text = f"the {ARMS[others.pop()]} arm is held: leave it out of the goal, or make the executor of both arms"
            return self._reject(handle, text, ResultCode.INVALID_JOINTS)
        if goal.start_s is not None and goal.start_s < self.time_s - 1e-9:
            text = f"the goal starts at {goal.start_s:g} s, and now is {self.time_s:g} s: choose a later start, or none"
            return self._reject(handle, text, ResultCode.OLD_HEADER_TIMESTAMP)
        if self._active is not None and not set(self._active.goal.rows) <= set(goal.rows):
            text = "an arm that moves is not in the goal: include it, or cancel the running goal and wait"
            return self._reject(handle, text, ResultCode.INVALID_JOINTS)
        if self._active is None and self.moves:
            return self._reject(handle, "both arms stop after an aborted goal: wait until they rest")
        try:
            path = self._path_of(goal)
        except TrajectoryError as error:
            return self._reject(handle, str(error))
        if self._pending is not None:
            self._end_preempted(self._pending.handle, "replaced", "another goal came before this one began")
        if self._active is None:
            self.stepper.in_time = False
        self._pending = _Pending(handle, PathCheck(path, self.gate, self.law))
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
        if self.stepper.why_not and not self.stepper.brakes:
            raise StartError(self.stepper.why_not)
        with interrupts_deferred():  # the gate's record and the cell's must not part
            self._step()

    def _step(self) -> None:
        stepper = self.stepper
        if not stepper.brakes:
            if self._pending is not None:
                self._check_pending(None if self._active is None else _WINDOWS_AT_ONCE)
            if self._pending is not None:
                self._begin_if_due(self._pending)
            if self._stream is not None:
                self._stop_before_underrun()
        command, refused = stepper.release()
        if refused is not None:
            self._fail(refused)
        departure = stepper.advance(command)
        if departure is not None:
            self._fail(departure)
            return
        if self._active is not None:
            self._observe(self._active)
        if not (self._finished or self.moves or self._active or self._pending):
            self._finished = True
            self.cell.finish()

    def _observe(self, handle: GoalHandle) -> None:
        """Compare the arms of a goal with its path, and end it where that is due."""
        goal, stepper = handle.goal, self.stepper
        feedback = feedback_of(goal, stepper.effective, stepper.measured_q_rad, self._dh, self.time_s)
        handle.note(feedback)
        if self.moves:
            off = off_path(goal, feedback)
            if off:
                self._fail(Departure("path tolerance", off))
            return
        if handle.over_s is None:
            handle.over_s = self.time_s
        rests = bool((np.abs(stepper.measured_qd_rad_s[goal.rows]) <= REST_RAD_S).all())
        waited = self.time_s - handle.over_s >= goal.goal_time_s
        if handle.state == GoalState.PREEMPTING:
            if not (rests or waited):
                return
            if handle.reason == "underrun":
                code = ResultCode.GOAL_TOLERANCE_VIOLATED
                self._end(handle, GoalState.ABORTED, code, handle.reason, handle.text)
            else:
                self._end_preempted(handle, handle.reason, handle.text)
            return
        off = off_goal(goal, feedback, rests)
        if not off:
            self._end(handle, GoalState.SUCCEEDED, ResultCode.SUCCESSFUL, "reached", "the goal was reached")
        elif waited:
            self._end(handle, GoalState.ABORTED, ResultCode.GOAL_TOLERANCE_VIOLATED, "goal tolerance", off)

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

    def _fail(self, departure: Departure) -> None:
        """Abort the running goal, whose path the arms do not follow. Both arms stop on it, unless they stop already."""
        if self.stepper.why_not:
            self._drop_pending(departure.text)
        if self._active is not None:
            self._end(self._active, GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED, *departure)
            if not self.stepper.why_not:
                self._drop_pending(f"the goal before it was aborted: {departure.text}")
                self.stepper.stop()

    def _preempt(self, handle: GoalHandle, reason: str, text: str, most_s: float = math.inf) -> None:
        handle.state, handle.reason, handle.text = GoalState.PREEMPTING, reason, text
        self.stepper.stop(most_s)

    # Beginning of a goal.

    def _path_of(self, goal: TrajectoryGoal) -> SmoothPath:
        with np.errstate(all="ignore"):  # what is not finite is refused
            motion = Interpolation(goal.trajectory)
            return SmoothPath.of(motion, goal.rows, self.desired_q_rad, is_open=goal.stream)

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
        checked = check.checked_s >= _end_of_check(goal, check, self.law) - 1e-9
        if not (self.stepper.in_time and checked) or now < start_s - 1e-9:
            return
        refused = misplaced(goal, self.desired_q_rad, self.measured_q_rad) if self._active is None else ""
        begun_s, known_s = now - start_s, _known_s(goal, check.path)
        if goal.stream and known_s < max(check.path.start_s, begun_s + ROUNDING_S):
            return  # it waits for more points
        course = None if refused else self.stepper.joined(check.path, begun_s, known_s, self._scaling)
        if not isinstance(course, Course):
            self._reject(handle, refused or f"{course}")
            return
        if self._active is not None:
            before = self._active
            self._end_preempted(before, before.reason or "replaced", before.text or "another goal has begun")
        self._pending = None
        self._active, self._finished = handle, False
        self.stepper.follow(course)
        self._stream = check if goal.stream else None
        handle.state = GoalState.ACTIVE

    # Streams.

    def _stream_of(self, handle: GoalHandle) -> TrajectoryGoal:
        if not handle.goal.stream or handle.state not in (GoalState.PENDING, GoalState.ACTIVE):
            kind = "stream" if handle.goal.stream else "goal that is no stream"
            raise TrajectoryError(f"this {kind} is {handle.state}: points can be appended to a running stream only")
        return handle.goal

    def _extend(self, handle: GoalHandle, goal: TrajectoryGoal) -> None:
        """Continue a stream with more points, or end it.

        Raises:
            TrajectoryError: The last point is too far ahead, the path cannot be computed, or the gate would refuse a
                target on the way. Nothing changes.
        """
        check = self._stream if self._pending is None or handle is not self._pending.handle else self._pending.check
        if check is None:
            raise TrajectoryError("this stream has ended: send another goal")
        known_s, now_s, from_s = _known_s(handle.goal, check.path), 0.0, -math.inf
        if handle is self._active:
            now_s = self.stepper.course.path_s(self.time_s)
            from_s = now_s - _KEPT_S
            goal = goal.since(from_s)
        if text := too_long(goal.trajectory.duration_s - now_s):
            raise TrajectoryError(text)
        following = self._path_of(goal)
        ahead = check.on(check.path.continued(following, known_s, from_s))
        refusal = ahead.work(_end_of_check(goal, ahead, self.law))
        if refusal is not None:
            raise TrajectoryError(refusal.between(goal.trajectory))
        handle.goal = goal
        if handle is self._active:
            self.stepper.course = self.stepper.course._replace(
                path=self.stepper.course.path.continued(following, known_s, from_s)
            )
            self._stream = ahead if goal.stream else None
        else:
            self._pending = _Pending(handle, ahead)

    def _stop_before_underrun(self) -> None:
        """Stop both arms where a stream does not know enough points."""
        handle, check = self._active, self._stream
        if handle is None or check is None or handle.state != GoalState.ACTIVE:
            return
        rate = self.stepper.course.rate.at(self.time_s)
        left_s = min(_known_s(handle.goal, check.path), check.checked_s) - self.stepper.course.path_s(self.time_s)
        if left_s <= rate * (_RESERVE * self.stepper.shortest_s(rate) / 2 + 2 * self.law.period_s):
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
