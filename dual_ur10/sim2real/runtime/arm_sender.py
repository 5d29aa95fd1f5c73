"""Servo loop of one arm: sends a target in every control period, and stops the arm on any fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from dual_ur10.errors import ClosedError, LinkError, distinguishable
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.tracking import Following
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import ARMS, HARD_ACCELERATION_RAD_S2, JOINT_RANGE_RAD
from ur_core.links.arm_status import ArmStatus, program_ended, stop_reason
from ur_core.links.controller_clock import ControllerClock, DriftCompensation
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.machine_load import StallWatch, too_busy
from ur_core.processes.system import LOCAL, System
from ur_core.servoj import ServojProfile
from ur_core.types import Array

ARRIVAL_PHASE: Final = 0.5
"""Phase of the control period at which targets arrive: farthest from the moment when the controller reads them."""

STALE_S: Final = 0.1
"""Longest stall of a controller's clock or of another process before it counts as lost. It equals MoveIt Servo's
command timeout."""

WAITING_S: Final = 0.5
"""The same limit before anything moves."""

START_GAP_RAD: Final = 0.002
"""Largest distance of the first target from the measured joint angles, 2.6 mm at a UR10's full reach.

Both are measured while the controller holds the arm, the first one some seconds to minutes ago. So gravity and the
offsets of sensors, which shift measured angles from the controller's target, do not count. Emulated arms differed by up
to 0.2 mrad under gravity, and a UR10's repeatability of 0.1 mm (data sheet) is 0.08 mrad at 1.3 m.
"""

TOGETHER_S: Final = 0.002
"""Largest offset between the control periods of two controllers without a shift of one arm's targets: more than the
scatter of their clock estimates."""

MOST_LATE_S: Final = 0.1
"""Largest delay of sending before the loop gives up: the controller's watchdog has the same limit."""

STOP_RAD_S2: Final = 4.0
STOP_RAD_S3: Final = 200.0
"""Deceleration and jerk of a stop: from 0.5 rad/s to rest in 0.15 s. The deceleration is that of `stopj` in Universal
Robots' own client library."""

_KICK_S: Final = 0.02
_RECENT: Final = 5  # targets of the other arm; the last ones may already slow it down
_SKIPPED_RAD: Final = 0.02  # largest motion in control periods that are left out
_ALONE_S: Final = 0.024  # without a target; then an arm has almost reached the last one: too late for a ramp
_ACCELERATION: Final = 3.0  # times the hard one: path, time scaling and interpolation together
_STOP_RAD_S2: Final = 10.0  # of servoStop; the arm is already at rest


class Control(Protocol):
    """Used part of `ur_rtde`'s control interface."""

    def servoJ(  # noqa: N802  # ur_rtde's name
        self, q: Sequence[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float, /
    ) -> bool:
        """Send a target."""

    def isConnected(self) -> bool:  # noqa: N802
        """Return False if the controller is lost."""

    def servoStop(self, a: float, /) -> bool:  # noqa: N802
        """End servoing."""

    def kickWatchdog(self) -> bool:  # noqa: N802
        """Feed the watchdog."""

    def stopScript(self) -> None:  # noqa: N802
        """End the control script."""


_RANGE_RAD: Final = tuple(JOINT_RANGE_RAD.tolist())

_ASKED: Final = "a stop was requested"
_OTHER: Final = "the other arm stops"
_WHILE: Final = "and while stopping"
_REST_RAD_S: Final = 0.01
_REST_S: Final = 0.5  # longest recording of states after a stop, until the arm rests


def of_arm(name: str, text: str) -> str:
    """Return a text that begins with the name of the arm that it is about, once."""
    named = text.startswith(tuple(f"{each}: " for each in ARMS))
    return text if named else f"{name}: {text.removeprefix(f'{name} arm, ')}"


def root_cause(texts: Sequence[str]) -> str:
    """Return the root cause among stop reasons; skip those that only followed the other arm."""
    return next((each for each in texts if _ASKED not in each and _OTHER not in each), texts[0])


def was_requested(text: str) -> bool:
    """Return True for the reason of an arm that stopped on request without any other fault."""
    return _ASKED in text and _WHILE not in text


class StopError(Exception):
    """Reason for a stop; internal to this module."""


class TargetError(StopError):
    """Reason for a stop because of invalid targets, which must not be followed any further."""


class ArmSender:
    """Servo loop of one arm's process.

    Args:
        name: Arm.
        servoj: Settings of `servoj`.
        link: Source of the arm's states.
        control: Sink of its targets.
        memory: Source of its targets, and log of what was sent.
        cell: Start time, time scaling and fault of the cell.
        others: Memories of the other arms: if one of them stops, so does this one.
        parent: Process that writes the targets; None: not checked.
        supervised: Require a living supervisor.
        leader: Memory of the arm to synchronise with; None: the others synchronise with this one.
        round_trip_s: Shortest round trip to the controller.
        robot: Model of the arm.
        emulated: The controller is emulated: it runs on this machine.
        system: Clock and processes.
    """

    def __init__(
        self,
        name: str,
        servoj: ServojProfile,
        link: RtdeLink,
        control: Control,
        memory: ArmMemory,
        cell: CellMemory,
        others: Sequence[ArmMemory] = (),
        *,
        robot: str,
        parent: int | None = None,
        supervised: bool = True,
        leader: ArmMemory | None = None,
        round_trip_s: float = 0.0,
        emulated: bool = False,
        system: System = LOCAL,
    ) -> None:
        self._stalls = StallWatch(emulated)
        self._most_rad_s = robot_model(robot).hard_speed_rad_s.tolist()
        self._system, self._now_s, self._wait = system, system.clock.now_s, system.clock.wait
        self.name, self.servoj, self.link, self.control = name, servoj, link, control
        self.memory, self.cell, self.others = memory, cell, others
        self._parent, self._supervised = parent, supervised
        self._other_name = next(each for each in ARMS if each != name)
        self._other_process = f"the process of the {self._other_name} arm"
        self.clock = ControllerClock(servoj.tick_s, round_trip_s)
        self._leader = leader
        self._following = Following(servoj)
        self._sent: Array | None = None
        self._sent_s = 0.0
        self._kicked_s = 0.0
        self._first = 0  # control period
        self._period = 0  # of the target that was sent last
        self._index = 0.0  # its number
        self._advance = 0.0  # numbers per control period
        self._rate: Array = np.zeros(6)  # per control period, of what was sent
        self._measured_rad: Sequence[float] = (math.nan,) * 6
        self._alone = ""

    def run(self) -> None:
        """Wait for the start, send targets, and stop on a fault or request."""
        try:
            self._settle()
            self.memory.enter(Phase.READY)
            self._stream(*self._wait_for_start())
        except StopError as reason:
            self._stop(str(reason), on_path=not isinstance(reason, TargetError))
        except LinkError as error:
            # The state of the arm is unknown: send nothing more, and let the controller's watchdog end its program.
            self.memory.enter(Phase.FAULTED, of_arm(self.name, str(error)))

    def _settle(self) -> None:
        end = self._now_s() + 5.0
        while not self.clock.is_settled:
            if self._now_s() > end:
                raise LinkError("the controller sent too little in 5 s to know its clock by")
            self._kick()
            self._listen(self._now_s() + self.servoj.tick_s, playing=False)

    def _wait_for_start(self) -> tuple[int, float]:
        """Feed the watchdog until it is time to begin.

        Returns:
            First control period and its target number, which is fractional if the controllers' periods are offset.
        """
        first = None
        while True:
            now, begin_s = self._now_s(), self.cell.begin_s
            if begin_s and first is None:
                first, at_s = self.clock.next_period(begin_s, ARRIVAL_PHASE)
                self.memory.note_first(at_s)
            if first is not None and begin_s < now + _KICK_S:
                return first, self._ahead()
            self._kick()
            self._listen(now + self.servoj.tick_s)

    def _ahead(self) -> float:
        """Return the offset, in control periods, of this arm's periods from those of its leader."""
        if self._leader is None:
            return 0.0
        if not self._leader.first_s:
            raise StopError(too_busy("the other arm does not begin"))
        ahead = (self.memory.first_s - self._leader.first_s) / self.servoj.tick_s
        return round(ahead) if abs(ahead - round(ahead)) * self.servoj.tick_s < TOGETHER_S else ahead

    def _kick(self) -> None:
        """Feed the watchdog while no targets are sent."""
        now = self._now_s()
        if now - self._kicked_s >= _KICK_S:
            self._kicked_s = now
            if not self.control.kickWatchdog():
                raise self._script_ended("its control script no longer runs: it was stopped, or not fed in time")

    def _script_ended(self, text: str) -> StopError:
        """Return the reason of a stop after `ur_rtde` has reported that its script has ended, for which it may wait."""
        now = self._now_s()
        self._stalls.beat(now)
        return StopError(self._stalls.explained(text, now))

    def _stream(self, first: int, ahead: float) -> None:
        """Send in control period `first` + k the target of period k + `ahead`."""
        self.memory.enter(Phase.STREAMING)
        self._first = first
        drift = DriftCompensation(self.servoj.tick_s, self.clock.offset_s)
        period = 0
        while True:
            self._listen(self.clock.moment(first + period, ARRIVAL_PHASE))
            late = self._now_s() - self.clock.moment(first + period, ARRIVAL_PHASE)
            if late > MOST_LATE_S:
                raise StopError(too_busy(f"targets are sent {1e3 * late:.0f} ms late"))
            # Skip targets that would come in the next period: two targets in one period would be a jump.
            passed = int(late / self.servoj.tick_s + ARRIVAL_PHASE)
            if passed > 0:
                if passed * float(np.abs(self._rate).max()) > _SKIPPED_RAD:
                    raise StopError(too_busy(f"targets are sent {1e3 * late:.0f} ms late while the arm moves"))
                self.memory.note_skipped(passed)
                period += passed
            index = self.cell.time_scaling.at(period + ahead + drift(self.clock.offset_s, 1 + passed))
            target = self.memory.target(index)
            self._send(target, first + period, index)
            self.memory.note_sent(period, index, self._sent_s, late, target)
            period += 1

    def _send(self, target_rad: Array, period: int, index: float) -> None:
        self._advance = (index - self._index) / max(period - self._period, 1) if self._sent is not None else 0.0
        if not self._check_and_send(target_rad, period, index):
            raise self._script_ended("its control script no longer takes targets")
        self._following.sent(target_rad.tolist(), index)

    def _check_and_send(self, target_rad: Array, period: int, index: float) -> bool:
        """Check a target and send it; return False if it was not taken."""
        periods = 1 if self._sent is None else max(period - self._period, 1)
        self._check(target_rad, periods)
        self._rate = np.zeros(6) if self._sent is None else (target_rad - self._sent) / periods
        self._sent, self._period, self._index = target_rad, period, index
        if not self.control.isConnected():
            raise LinkError("ur_rtde has lost the controller; look at its network")
        self._sent_s = self._now_s()
        profile = self.servoj
        return self.control.servoJ(target_rad.tolist(), 0.0, 0.0, profile.tick_s, profile.lookahead_s, profile.gain)

    def _check(self, target_rad: Array, periods: int) -> None:
        """Refuse targets that the gate should not have released: `ur_rtde` does not check them.

        Raises:
            TargetError: The target is not finite, out of range, or too far from the one sent `periods` periods ago; or
                the first target is too far from the arm.
        """
        target = target_rad.tolist()  # plain numbers: arrays of six take several times as long
        if not all(map(math.isfinite, target)):
            raise TargetError(f"a target is not finite: {target}")
        if any(abs(each) > limit for each, limit in zip(target, _RANGE_RAD, strict=True)):
            raise TargetError(f"a target is beyond the joint range: {target}")
        if self._sent is None:
            found = [abs(each - here) for each, here in zip(target, self._measured_rad, strict=True)]
            self._demand(found, [START_GAP_RAD] * 6, "from where the arm is")
            return
        tick_s = self.servoj.tick_s
        steps = [each - last for each, last in zip(target, self._sent.tolist(), strict=True)]
        speed = tick_s * periods
        self._demand([*map(abs, steps)], [each * speed for each in self._most_rad_s], "from the one before")
        most = _ACCELERATION * HARD_ACCELERATION_RAD_S2 * tick_s**2 * (periods + 1)
        found = [abs(step / periods - rate) for step, rate in zip(steps, self._rate.tolist(), strict=True)]
        self._demand(found, [most] * 6, "per period off its previous motion")

    def _demand(self, found: list[float], allowed: list[float], what: str) -> None:
        for each, limit in zip(found, allowed, strict=True):
            if not each <= limit * (1 + 1e-9):
                joint = int(np.divide(found, allowed).argmax())
                most, least = distinguishable(found[joint], allowed[joint], 4)
                raise TargetError(f"a target is {most} rad {what} at joint {joint}: allowed are {least}")

    def _listen(self, until_s: float, *, playing: bool = True) -> None:
        """Process the controller's states until a time.

        Raises:
            StopError: The arm must stop.
            LinkError: The controller is lost.
        """
        while True:
            now = self._now_s()
            self.memory.beat(now)
            self._stalls.beat(now)
            self._check_others(now)
            if now >= until_s:
                return
            self._wait((self.link.fileno(),), until_s)
            self._stalls.note(self.link.age_s(now), now)
            for sample in self.link.poll():
                self.clock.note(sample.timestamp_s, sample.arrival_s)
                status = ArmStatus.from_sample(sample)
                self._measured_rad = status.q_rad
                self._stalls.packet(0, sample.timestamp_s, sample.arrival_s)
                reason = stop_reason(status, allow_reduced=self.cell.allow_reduced, playing=playing)
                if reason is not None and program_ended(status):
                    reason = self._stalls.explained(reason, now)
                reason = reason or self._following(status)
                if self._following.lost:
                    self.memory.note_deaf()
                if reason is not None:
                    # Before the state: the program must not act on it.
                    self.memory.enter(Phase.STOPPING, f"{self.name}: {reason}")
                self.memory.note_state(status)
                if reason is not None:
                    raise StopError(reason)
            now = self._now_s()
            age = self.link.age_s(now)
            if age > (WAITING_S if self._sent is None else STALE_S):
                other_s = now - max((each.arrival_s for each in self.others), default=-math.inf)
                raise LinkError(self._stalls.controller_silent(age, other_s, now))

    def _check_others(self, now: float) -> None:
        """Check the other processes.

        Raises:
            StopError: A process requests a stop, or no longer runs.
        """
        stop_requested = self.memory.stop_requested
        if self.cell.fault:  # the supervisor requests a stop before it sets one
            raise StopError(self.cell.fault)
        if stop_requested:
            raise StopError(_ASKED)
        sends = self._sent is not None
        for other in self.others:
            phase = other.phase
            if phase >= Phase.STOPPING:
                raise StopError(f"{_OTHER}: {other.text}")
            limit_s = STALE_S if sends or phase == Phase.STREAMING else WAITING_S
            if phase in (Phase.READY, Phase.STREAMING) and now - other.beat_s > limit_s:
                runs = self._system.is_running(other.process)
                raise StopError(self._stalls.process_silent(self._other_process, runs=runs))
            if sends and phase < Phase.STREAMING and now - self.cell.begin_s > STALE_S:
                raise StopError(too_busy(f"the {self._other_name} arm does not begin"))
        if self._parent is not None and self._system.is_orphan(self._parent):
            raise StopError("the program that sends targets has ended")
        if self._supervised and sends and now - self.cell.supervisor_beat_s > STALE_S:
            ended = not all(self._system.is_running(other.process) for other in self.others)
            if ended:  # that is the cause of more than a supervisor that does not respond
                raise StopError(self._stalls.process_silent(self._other_process, runs=False))
            runs = self._system.is_running(self.cell.supervisor)
            raise StopError(self._stalls.process_silent("the supervisor", runs=runs))

    def _stop(self, reason: str, *, on_path: bool) -> None:
        """Stop the arm and end its program.

        Args:
            reason: Reason of the stop.
            on_path: Stop along the path of its targets, as the other arm does, so that a held object is not torn;
                otherwise along the current direction.
        """
        text = of_arm(self.name, reason)
        self.memory.enter(Phase.STOPPING, text)
        if self._sent is not None and self._now_s() - self._sent_s > MOST_LATE_S:
            # The watchdog has ended the program by now: nothing may be sent any more.
            self.memory.enter(Phase.FAULTED, text)
            return
        try:
            taken = self._stop_by_any_path(on_path=on_path)
            self.control.servoStop(_STOP_RAD_S2)
            self.control.stopScript()
        except (LinkError, RuntimeError) as error:
            self.memory.enter(Phase.FAULTED, f"{text}; {_WHILE}: {error}")
            return
        more = self._alone if taken else f"; {_WHILE}: its control script no longer took targets"
        self.memory.enter(Phase.STOPPED, f"{text}{more}")
        self._record_until_rest()

    def _stop_by_any_path(self, *, on_path: bool) -> bool:
        """Stop along the path of the targets; if they are invalid, along the current direction; otherwise at once.

        Returns:
            False if the controller refused a target.
        """
        for along in (True, False) if on_path else (False,):
            try:
                return self._ramp_down(on_path=along)
            except TargetError:
                continue
        return True

    def _record(self, until_s: float) -> bool:
        """Record the controller's states until a time without judging them: the arm is stopping.

        Returns:
            False if the link is lost.
        """
        while self._now_s() < until_s:
            try:
                self._wait((self.link.fileno(),), until_s)
                for sample in self.link.poll():
                    self.memory.note_state(ArmStatus.from_sample(sample))
            except (LinkError, ClosedError):  # the ramp continues all the same
                self._wait((), until_s)
                return False
        return True

    def _record_until_rest(self) -> None:
        end = self._now_s() + _REST_S
        while self._now_s() < end and self._record(self._now_s() + 2 * self.servoj.tick_s):
            status = self.memory.status
            if status is not None and max(map(abs, status.qd_rad_s)) < _REST_RAD_S:
                return

    def _ramp_down(self, *, on_path: bool) -> bool:
        """Send the targets of the stop ramp.

        Returns:
            False if the controller refused one.

        Raises:
            TargetError: A target is invalid.
        """
        tick_s = self.servoj.tick_s
        most = round(_ALONE_S / tick_s)
        if self._sent is None:
            return True
        missed = self.clock.next_period(self._now_s(), ARRIVAL_PHASE)[0] - self._period
        if missed > most:
            self._alone = f"; sent nothing for {1e3 * missed * tick_s:.0f} ms, it stopped at its last target"
            return True
        last, rate, begin, advance = self._sent, self._rate, self._index, self._advance
        # Both arms slow down together, as the faster one requires.
        speed = max([np.abs(rate).max() / tick_s, *(_speed(other, tick_s) for other in self.others)])
        on_path = on_path and advance > 0.0
        ramp = StopRamp(np.array([[-speed * tick_s], [0.0]]), tick_s)
        gone = 0.0
        while not ramp.at_rest:
            number, due = self.clock.next_period(self._now_s(), ARRIVAL_PHASE)
            if number <= self._period:  # a late target arrived in it
                number = self._period + 1
                # A clock that was set back must not delay a stop.
                due = min(self.clock.moment(number, ARRIVAL_PHASE), self._now_s() + 2 * tick_s)
            self._record(due)
            number += int(max(0.0, self._now_s() - due) / tick_s + ARRIVAL_PHASE)  # the period in which it arrives
            missed = number - self._period
            if missed > most:
                self._alone = f"; sent nothing for {1e3 * missed * tick_s:.0f} ms, it stopped by itself"
                return True
            # The ramp advances in missed periods, too.
            for _ in range(missed):
                gone = float(ramp()[0]) / (speed * tick_s)  # in control periods at the speed before
            index = begin + gone * advance if on_path else begin
            target = self.memory.target(index) if on_path else last + gone * rate
            if not self._check_and_send(target, number, index):
                return False  # the controller stopped it
            self.memory.note_sent(number - self._first, index, self._sent_s, self._sent_s - due, target)
        return True


def _speed(memory: ArmMemory, tick_s: float) -> float:
    """Return the largest joint speed of an arm's last targets, before it slowed down itself, rad/s."""
    sent, _ = memory.sent(max(0, memory.sent_count - _RECENT))
    if len(sent.period) < 2:
        return 0.0
    periods = np.maximum(np.diff(sent.period), 1.0)
    return float((np.abs(np.diff(sent.target_rad, axis=0)).max(axis=1) / periods).max() / tick_s)


class StopRamp:
    """Jerk-limited ramp to rest along the current direction of motion, all joints together.

    Args:
        last_rad: (2, 6) last two targets sent.
        tick_s: Time between two targets.
    """

    def __init__(self, last_rad: Array, tick_s: float) -> None:
        self._q: Array = last_rad[-1].copy()
        self._direction: Array = (last_rad[-1] - last_rad[-2]) / tick_s
        self._tick_s = tick_s
        self._speed = float(np.abs(self._direction).max())
        if self._speed > 0.0:
            self._direction /= self._speed
        self._deceleration = 0.0

    @property
    def at_rest(self) -> bool:
        """True once the last returned target is at rest."""
        return self._speed <= 0.0

    def __call__(self) -> Array:
        """Return the next target, (6,)."""
        if not self.at_rest:
            step = STOP_RAD_S3 * self._tick_s
            # Towards the end the deceleration fades, so that the arm stops smoothly.
            fading = (2.0 * STOP_RAD_S3 * self._speed) ** 0.5
            self._deceleration = min(self._deceleration + step, STOP_RAD_S2, max(fading, step))
            before = self._speed
            self._speed = max(0.0, before - self._deceleration * self._tick_s)
            self._q = self._q + self._direction * (self._speed * self._tick_s)
        return self._q.copy()
