"""Sender of few points per second to both controllers, which interpolate them; see `stream_script`.

It needs no supervisor: each controller's program stops its arm by itself if this program, the link or the other arm's
stop ends the points. What is left to this program is to stop the other arm at once, and to latch the stop.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import CellFaulted, DualUR10Error, LinkError, StartError, TrajectoryError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm, prompt_for
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.config.cell_file_tables import ArmEntry
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.link_profiles import LinkProfile
from dual_ur10.sim2real.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus, stop_reason
from dual_ur10.sim2real.links.dashboard_link import DashboardLink
from dual_ur10.sim2real.links.link_socket import LinkSocket
from dual_ur10.sim2real.links.rtde_link import PORT, RtdeClient, RtdeLink
from dual_ur10.sim2real.processes.clock import Clock
from dual_ur10.sim2real.processes.system import LOCAL, System
from dual_ur10.sim2real.protocol.modes import RuntimeState
from dual_ur10.sim2real.protocol.rtde import Kind, frame
from dual_ur10.sim2real.runtime.latch import CellLock, Latch
from dual_ur10.sim2real.runtime.runner import check
from dual_ur10.sim2real.runtime.stream_script import (
    INPUTS,
    MOVE_PART,
    NUMBER,
    OUTPUTS,
    PATH_TIME,
    RATE_BAND,
    REASONS,
    STATE,
    TOKEN,
    Command,
    State,
    moves_script,
    points_script,
)
from dual_ur10.sim2real.trajectory.interpolation import Interpolation, Motion
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from dual_ur10.sim2real.trajectory.point_path import PointPath, check_targets
from dual_ur10.types import Array, Closing

DWELL_S: Final = 0.6
"""Least time for which both arms rest before they move, while their path times are brought together."""

_SCRIPT_PORT: Final = 30003
_CONNECT_S: Final = 6.0  # of each connection with its requests, on a slow link
_READY_S: Final = 5.0
_STALE_S: Final = 0.2  # oldest state of a controller, in addition to an interval
_STOP_S: Final = 2.0
_RATE: Final = 1.0 - RATE_BAND / 2  # of the path time: neither controller is ever faster than what was checked
_GAIN_1_S: Final = 0.5  # of the correction of the rate, per second of difference
_NEAR_RAD: Final = 1e-3  # from the first point to where the arms stand
_SEND_S: Final = 0.1
_POLL_S: Final = 0.01
_ROUND_TRIPS: Final = 5


class Progress(NamedTuple):
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


class _Arm(Closing):
    """Connections to one controller, and the program that runs on it."""

    def __init__(self, name: str, entry: ArmEntry, rate_hz: float, most_s: float, system: System) -> None:
        self.name, self._clock, self._system, self._host = name, system.clock, system, entry.host
        self.values: dict[str, float] = {"command": 0, "number": 0, "last": 0, "rate": _RATE, "shift": 0.0, "time": 0.0}
        self.point: Array = np.zeros(12)
        self.token = 0
        self.late_s: list[float] = []
        self._open: list[Closing] = []
        deadline_s = self._clock.now_s() + _CONNECT_S
        with self.closed_on_error():
            self.link = RtdeLink(
                entry.host,
                (*STATUS_VARIABLES, *OUTPUTS),
                rate_hz,
                timeout_s=_CONNECT_S,
                optional=OPTIONAL_VARIABLES,
                name=name,
                system=system,
            )
            self._open.append(self.link)
            inputs = RtdeClient(name, entry.host, PORT, deadline_s, system=system)
            self._inputs = inputs.socket
            self._open.append(self._inputs)
            trip_s = max(inputs.round_trips_s(_ROUND_TRIPS, deadline_s))
            if trip_s > most_s:
                raise StartError(
                    f"{name}: a round trip took {1e3 * trip_s:.0f} ms, allowed at this rate are {1e3 * most_s:.0f} ms: "
                    "lower the rate, or use a faster link"
                )
            self._recipe, types = inputs.set_up(Kind.SETUP_INPUTS, INPUTS, b"", deadline_s)
            if not self._recipe or {"IN_USE", "NOT_FOUND"}.intersection(types):
                raise self._inputs.error(
                    f"its registers from {INPUTS[0]} on are in use or do not exist",
                    "end the other program, disable the fieldbus, or update the controller's software",
                )
            self.dashboard = DashboardLink(entry.host, _CONNECT_S, name=name, system=system)
            self._open.append(self.dashboard)

    def upload(self, text: str, token: int) -> None:
        """Start a program."""
        self.token = token
        self.values.update(command=Command.WAIT, number=0, shift=0.0, rate=_RATE)
        self.late_s.clear()
        self.send()
        deadline_s = self._clock.now_s() + _CONNECT_S
        with LinkSocket(self.name, "script", self._host, _SCRIPT_PORT, deadline_s, system=self._system) as script:
            script.send(text.encode("ascii"), deadline_s)
            self.wait(lambda state, number: state == State.WAITING, "to start its program")

    def wait(self, reached: Callable[[int, int], bool], what: str) -> None:
        """Wait for a state of the program and its number of accepted points.

        Raises:
            StartError: It does not come in time.
        """
        end_s = self._clock.now_s() + _READY_S
        while True:
            self.poll()
            values: Any = None if self.link.latest is None else self.link.latest.values
            if values is not None and values[TOKEN] == self.token and reached(values[STATE], values[NUMBER]):
                return
            if self._clock.now_s() > end_s:
                raise StartError(f"{self.name}: its controller had {_READY_S:g} s {what}, and did not: see its log")
            self._clock.wait((self.link.fileno(), self._inputs.fileno()), end_s)

    def poll(self) -> None:
        """Read what has arrived.

        Raises:
            LinkError: A connection was lost.
        """
        self.link.poll()
        if self._inputs.receive_now() == b"":
            raise self._inputs.ended()

    def send(self) -> None:
        """Write all registers."""
        values = self.values
        whole = (int(values["command"]), int(values["number"]), int(values["last"]), self.token)
        payload = struct.pack(
            ">B4i15d", self._recipe, *whole, *self.point, values["time"], values["rate"], values["shift"]
        )
        self._inputs.send(frame(Kind.DATA_PACKAGE, payload), self._clock.now_s() + _SEND_S)

    def put(self, number: int, q_rad: Array, qd_rad_s: Array, time_s: float) -> None:
        """Send a point."""
        self.values.update(number=number, time=time_s)
        self.point = np.concatenate([q_rad, qd_rad_s])
        self.send()

    def close(self) -> None:
        """Close all connections. May be called twice."""
        for each in self._open:
            each.close()


class PointStream(Closing):
    """Both controllers of a cell, behind a slow link. Construction connects and checks, and moves nothing.

    Args:
        file: Cell file.
        profile: Rate and mode; see `dual_ur10.sim2real.control.link_profiles.profile_for`.
        limits: Limits of motion, in real time; None: the hard limits. Those of the cell file apply in any case.
        confirm: Called with a description before the arms move; None: real arms need a yes at the terminal, emulated
            ones none.
        system: Clock, network and state folder.

    Raises:
        CellFaulted: A latched stop was not cleared.
        CellBusyError: Another program moves one of the arms.
        StartError: A controller is not ready, the link is too slow for this rate, or the profile is one of direct
            `servoj` targets.
        LinkError: A controller cannot be reached.
    """

    def __init__(
        self,
        file: CellFile,
        profile: LinkProfile,
        *,
        limits: MotionLimits | None = None,
        confirm: Confirm | None = None,
        system: System = LOCAL,
    ) -> None:
        if profile.mode == "servoj":
            raise StartError(
                f"at {profile.rate_hz:g} Hz the runner sends targets itself: make an environment on the cell file, or "
                "use a lower rate"
            )
        self._file, self.profile, self._clock = file, profile, system.clock
        config = file.config()
        self._tick_s, self._confirm = config.servoj.tick_s, prompt_for(file, confirm)
        # The caps of a cell file are in real time, as these limits are.
        self.limits = replace(config, speed_factor=1.0).capped(MotionLimits() if limits is None else limits)
        self._clearance = Clearance(
            config.measured_scene, minimum_m=config.minimum_clearance_m, uncertainty=config.uncertainty
        )
        self._latch = Latch(file, system)
        self._latch.check()
        self._arms: list[_Arm] = []
        self._token = round(1e3 * system.clock.now_s()) % 2**30
        self._lock = CellLock(file, system)
        with self.closed_on_error():
            if self._lock.left_moving:
                self._latch.set("the program that moved the arms before ended without stopping them in order")
            self._latch.check()
            check(file, system, timeout_s=_CONNECT_S, streams=False)
            rate_hz = min(1.0 / self._tick_s, 5.0 * profile.rate_hz)
            for name, entry in zip(ARMS, file.arms, strict=True):
                self._arms.append(_Arm(name, entry, rate_hz, profile.interval_s / 2, system))

    @property
    def rate(self) -> float:
        """Rate of the path's time on the clock of this program."""
        return 1.0 if self.profile.mode == "movej" else _RATE

    def measured(self) -> Array:
        """Return the measured joint positions, (2, 6).

        Raises:
            StartError: An arm is not ready, or moves.
        """
        found = []
        for arm in self._arms:
            status = self._next_status(arm)
            reason = stop_reason(status, playing=False) or _slowed(status)
            if reason is None and not max(map(abs, status.qd_rad_s)) < REST_RAD_S:
                reason = "it moves: wait until it rests"
            if reason is not None:
                raise StartError(f"{arm.name} cannot begin: {reason}")
            found.append(status.q_rad)
        return np.array(found)

    def _next_status(self, arm: _Arm) -> ArmStatus:
        count, end_s = arm.link.count, self._clock.now_s() + _READY_S
        while arm.link.count <= count:
            if self._clock.now_s() > end_s:
                raise LinkError(f"{arm.name}: its controller sends no state: check the link")
            self._clock.wait((arm.link.fileno(),), end_s)
            arm.poll()
        sample = arm.link.latest
        if sample is None:
            raise LinkError(f"{arm.name}: its controller sends no state: check the link")
        return ArmStatus.from_sample(sample)

    def thin(self, targets_rad: Array) -> PointPath:
        """Return the points of a path of targets, at the stream's rate and the cell's speed factor.

        Args:
            targets_rad: (n, 2, 6) targets in task time, one per control period, as an adapter makes them; from rest to
                rest.

        Raises:
            TrajectoryError: They are no such targets.
        """
        return PointPath.of_targets(targets_rad, self._tick_s / self._file.speed_factor, self.profile.interval_s)

    def points_of(self, trajectory: JointTrajectory, here_rad: Array) -> PointPath:
        """Return the points of a trajectory, at the stream's rate and the cell's speed factor.

        Args:
            trajectory: Trajectory from rest to rest. A first point later than 0 is reached from where the arms are. An
                arm that is not in it stays.
            here_rad: (2, 6) measured positions.

        Raises:
            TrajectoryError: It does not begin or end at rest.
        """
        rows = [ARMS.index(arm) for arm in trajectory.arms]
        motion = Interpolation(trajectory, Motion.at_rest(np.asarray(here_rad)[rows]))
        # With a target at rest before the start and one after the end, as cubics begin and end with an acceleration.
        ticks = np.arange(-1, 2 + math.ceil(trajectory.duration_s / self._tick_s), dtype=np.float64)
        targets = np.tile(here_rad, (len(ticks), 1, 1))
        targets[:, rows] = motion(self._tick_s * ticks).q_rad
        return self.thin(targets)

    def check(self, path: PointPath) -> None:
        """Pass a whole path through the safety gate, as the controllers will interpolate it.

        Raises:
            TrajectoryError: The gate refuses it, or it has other intervals than this stream.
        """
        interval_s = self.profile.interval_s
        if path.interval_s != interval_s:
            raise TrajectoryError(
                f"the path has a point every {path.interval_s:g} s, and this stream sends one every {interval_s:g} s: "
                "take its points at this interval"
            )
        targets = path.stops(self._tick_s) if self.profile.mode == "movej" else path.targets(self._tick_s)
        check_targets(targets, self.limits, self._tick_s, max(1, round(interval_s / self._tick_s)), self._clearance)

    def run(
        self,
        path: PointPath,
        *,
        canceled: Callable[[], bool] | None = None,
        feedback: Callable[[Progress], None] | None = None,
    ) -> bool:
        """Follow a path with both arms, and return True at its end.

        Args:
            path: The path, from where the arms are.
            canceled: Called at each event; True stops both arms, and the method returns False.
            feedback: Called with each state of a moving arm.

        Raises:
            TrajectoryError: The gate refuses the path, or it begins elsewhere. Nothing has moved.
            StartError: An arm is not ready, or the motion was not confirmed. Nothing has moved.
            CellFaulted: Both arms were stopped, which is latched.
        """
        self._latch.check()
        self.check(path)
        here = self.measured()
        off = np.abs(here - path.q_rad[0])
        if off.max() > _NEAR_RAD:
            arm, joint = np.unravel_index(off.argmax(), off.shape)
            raise TrajectoryError(
                f"the path begins {off.max():.4f} rad from where joint {joint} of the {ARMS[arm]} arm is, allowed are "
                f"{_NEAR_RAD:g}: begin at the measured positions"
            )
        if not self._confirm(f"Both arms follow a path of {path.duration_s:.1f} s from where they are."):
            raise StartError("the motion was not confirmed: nothing has moved")
        motion = _Motion(self._arms, path, self.profile, self._clock, feedback)
        self._lock.note_moving()
        try:
            for arm in self._arms:
                self._token += 1
                arm.upload(self._script(self._token), self._token)
            return motion.run(canceled or (lambda: False))
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            stop_arms(self._arms, self._clock)
            if isinstance(error, StartError) and not motion.begun:
                raise
            reason = str(error) if isinstance(error, DualUR10Error) else f"the sending program ended: {error!r}"
            self._latch.set(reason)
            if not isinstance(error, DualUR10Error):
                raise
            raise CellFaulted(
                f"both arms were stopped: {reason}. Check both, correct the cause, then run "
                f"`python -m dual_ur10 cell clear {self._file.source}`"
            ) from error

    def _script(self, token: int) -> str:
        speed = max(self.limits.speed_rad_s)
        if self.profile.mode == "movej":
            return moves_script(token, self.profile.servoj, speed, self.profile.interval_s)
        return points_script(token, self.profile.servoj, speed)

    def close(self) -> None:
        """Release both controllers. May be called twice."""
        for arm in self._arms:
            arm.close()
        self._lock.release()


class _Motion:
    """One path on its way to both controllers."""

    def __init__(
        self,
        arms: Sequence[_Arm],
        path: PointPath,
        profile: LinkProfile,
        clock: Clock,
        feedback: Callable[[Progress], None] | None,
    ) -> None:
        self._arms, self._clock, self._feedback = arms, clock, feedback
        self._moves = profile.mode == "movej"
        self._interval_s = path.interval_s
        dwell_s = math.ceil(DWELL_S / path.interval_s) * path.interval_s
        self._time_s = np.concatenate([[0.0], dwell_s + path.interval_s * np.arange(len(path.q_rad))])
        self._q = np.concatenate([path.q_rad[:1], path.q_rad])
        self._qd = np.concatenate([path.qd_rad_s[:1], path.qd_rad_s])
        self._begin_s = math.inf
        self._count = [arm.link.count for arm in arms]

    @property
    def begun(self) -> bool:
        """True once the arms were told to move."""
        return self._begin_s < math.inf

    def run(self, canceled: Callable[[], bool]) -> bool:
        """Send all points; see `PointStream.run`."""
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
            arm.values["command"] = Command.RUN
            arm.send()
        while True:
            if canceled():
                stop_arms(self._arms, self._clock)
                return False
            if self._poll():
                return True
            now_s = self._clock.now_s()
            due_s = self._due_s(number + 1)
            if now_s >= due_s:
                number += 1
                self._steer()
                self._put(number)
                continue
            self._clock.wait([arm.link.fileno() for arm in self._arms], min(due_s, now_s + self._interval_s))

    def _due_s(self, number: int) -> float:
        """Return the time at which a point is sent: in the middle of the interval before the one that ends with it."""
        if number > len(self._q):
            return math.inf
        if self._moves:
            return self._begin_s + self._interval_s * (number - 1)
        before = self._time_s[number - 2] if number > 2 else 0.0
        return float(self._begin_s + (before - self._interval_s / 2) / _RATE)

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
            resting = (self._clock.now_s() - self._begin_s) * _RATE < self._time_s[1]
            if resting:
                arm.values["shift"] += late_s
            arm.values["rate"] = _RATE + min(max(_GAIN_1_S * late_s, -RATE_BAND / 2), RATE_BAND / 2)

    def _poll(self) -> bool:
        """Read the states of both arms; return True once both have finished.

        Raises:
            LinkError: An arm does not go on, or a connection was lost.
        """
        ended = []
        for number, arm in enumerate(self._arms):
            arm.poll()
            sample, now_s = arm.link.latest, self._clock.now_s()
            if sample is None or arm.link.age_s(now_s) > self._interval_s + _STALE_S:
                raise LinkError(f"{arm.name}: its controller has fallen silent: check the link")
            values: Any = sample.values
            state = values[STATE]
            status = ArmStatus.from_sample(sample)
            reason = stop_reason(status, playing=state < State.FINISHED) or REASONS.get(state) or _slowed(status)
            if values[TOKEN] != arm.token:
                reason = "another program runs on its controller"
            if reason is not None:
                raise LinkError(f"{arm.name}: {reason}")
            path_s = float(values[PATH_TIME])
            if arm.link.count > self._count[number] and state == State.MOVING and path_s < self._time_s[-1]:
                self._count[number] = arm.link.count
                late_s = math.nan if self._moves else (sample.arrival_s - self._begin_s) * _RATE - path_s
                arm.late_s.append(late_s)
                if self._feedback is not None:
                    self._feedback(Progress(number, path_s, late_s, status))
            ended.append(state == State.FINISHED and status.runtime_state == RuntimeState.STOPPED)
        return all(ended)


def stop_arms(arms: Sequence[_Arm], clock: Clock) -> None:
    """Stop both arms: by a register, and by the dashboard where a program does not end soon."""
    pending = []
    for arm in arms:
        try:
            arm.values["command"] = Command.STOP
            arm.send()
            pending.append(arm)
        except DualUR10Error:
            _halt(arm)
    end_s = clock.now_s() + _STOP_S
    while pending:
        for arm in list(pending):
            try:
                arm.poll()
                sample = arm.link.latest
                values: Any = {} if sample is None else sample.values
                status = None if sample is None else ArmStatus.from_sample(sample)
                final = values.get(TOKEN) != arm.token or values.get(STATE, 0) >= State.FINISHED
                if status is not None and final and status.runtime_state == RuntimeState.STOPPED:
                    pending.remove(arm)
                elif clock.now_s() > end_s:
                    raise LinkError("its program does not end")
            except DualUR10Error:
                pending.remove(arm)
                _halt(arm)
        clock.sleep(_POLL_S)


def _halt(arm: _Arm) -> None:
    """Have the dashboard stop the program. If that fails, the program stops the arm, as no more points come."""
    with contextlib.suppress(DualUR10Error):
        arm.dashboard.stop()


def _slowed(status: ArmStatus) -> str | None:
    """Return the reason why an arm cannot keep the path's time; None: it can."""
    scaling = min(status.slider, status.speed_scaling)
    if scaling < 1.0 - 1e-6:
        return f"its speed is scaled to {100 * scaling:.0f} %: points have fixed times, so set the slider to 100 %"
    return None
