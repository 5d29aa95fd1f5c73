"""Sends one arm its targets, one in every control period of its controller, and stops it when anything is wrong."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from dual_ur10.errors import ClosedError, LinkError
from dual_ur10.kinematics.ur10 import ARMS, HARD_ACCELERATION_RAD_S2, HARD_SPEED_RAD_S, JOINT_RANGE_RAD
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.links.arm_status import ArmStatus, stop_reason
from dual_ur10.sim2real.links.controller_clock import ControllerClock, DriftCompensation
from dual_ur10.sim2real.links.rtde_link import RtdeLink
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.stop_ramp import StopRamp
from dual_ur10.sim2real.runtime.tracking import Following
from dual_ur10.types import Array

SHARE: Final = 0.5
"""Where in a control period a target is to arrive: as far as can be from where the controller looks for one."""

STALE_S: Final = 0.1
"""How long a controller's time, or another process, may stand still before it counts as lost: that of MoveIt Servo's
command timeout."""

WAITING_S: Final = 0.5
"""The same for another process while nothing moves yet."""

START_GAP_RAD: Final = 0.02
"""How far the first target may be from where the arm is."""

TOGETHER_S: Final = 0.002
"""How far apart the control periods of two controllers may begin without that one arm's targets are shifted: more than
estimates of their clocks scatter by."""

MOST_LATE_S: Final = 0.1
"""How far the sending may fall behind before it is given up: the watchdog in the controller waits as long."""

_KICK_S: Final = 0.02
_LOOKED_AT: Final = 5  # targets of the other arm, of which the last ones may slow it down already
_ALONE_S: Final = 0.024  # without a target, behind which an arm is at the last one, or all but: no ramp begins there
_TURN: Final = 3.0  # times the hard acceleration: path, scaling and what lies between two targets together
_STOP_RAD_S2: Final = 10.0  # of servoStop, at rest already


class Control(Protocol):
    """What is used of `ur_rtde`'s control interface."""

    def servoJ(  # noqa: N802  # ur_rtde's name
        self, q: Sequence[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float, /
    ) -> bool:
        """Send a target."""

    def isConnected(self) -> bool:  # noqa: N802
        """Whether it has not lost the controller."""

    def servoStop(self, a: float, /) -> bool:  # noqa: N802
        """End servoing."""

    def kickWatchdog(self) -> bool:  # noqa: N802
        """Show the controller that somebody is there."""

    def stopScript(self) -> None:  # noqa: N802
        """End the control script."""


_ASKED: Final = "a stop was asked for"
_OTHER: Final = "the other arm stops"
_WHILE: Final = "and while stopping"
_REST_RAD_S: Final = 0.01
_REST_S: Final = 0.5  # for which states are told behind a stop, until the arm rests


def root_cause(texts: Sequence[str]) -> str:
    """Of what arms that stopped say, at least one text: what says why, and not that others wanted it."""
    return next((each for each in texts if _ASKED not in each and _OTHER not in each), texts[0])


def was_asked_for(text: str) -> bool:
    """Whether an arm says that it stopped because it was asked to, and that nothing else was wrong."""
    return _ASKED in text and _WHILE not in text


class StopError(Exception):
    """Why the arm is to stop now. It does not leave this module."""


class TargetError(StopError):
    """The same, because of the targets: they are not to be gone by any more."""


class ArmSender:
    """The loop of one arm's process.

    Args:
        name: Of the arm.
        servoj: Settings of `servoj`.
        link: Tells the arm's state.
        control: Takes targets.
        memory: Where targets come from, and what is told of them.
        cell: When to begin, how time passes, and whether there is a fault.
        others: Memories of the other arms: if one of them stops, so does this one.
        parent: Process that the targets come from; None: nobody looks.
        watched: Whether there is a supervisor that must live.
        leader: Memory of the arm that this one keeps step with; None: the others keep step with this one.
        round_trip_s: How long an answer of the controller takes.
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
        parent: int | None = None,
        watched: bool = True,
        leader: ArmMemory | None = None,
        round_trip_s: float = 0.0,
    ) -> None:
        self.name, self.servoj, self.link, self.control = name, servoj, link, control
        self.memory, self.cell, self.others = memory, cell, others
        self._parent, self._watched = parent, watched
        self.clock = ControllerClock(servoj.tick_s, round_trip_s)
        self._leader = leader
        self._following = Following(servoj)
        self._sent: list[Array] = []
        self._sent_s = 0.0
        self._kicked_s = 0.0
        self._first = 0  # control period
        self._period = 0  # of the target that was sent last
        self._index = 0.0  # its number
        self._advance = 0.0  # numbers per control period
        self._rate: Array = np.zeros(6)  # per control period, of what was sent
        self._measured_rad: Array = np.full(6, np.nan)
        self._alone = ""

    def run(self) -> None:
        """Wait for the beginning, send targets, and come to rest when anything is wrong or a stop is asked for."""
        try:
            self._settle()
            self.memory.enter(Phase.READY)
            self._stream(*self._wait_for_beginning())
        except StopError as reason:
            self._stop(str(reason), on_path=not isinstance(reason, TargetError))
        except LinkError as error:
            # Nobody knows what the arm does: nothing more is sent, and the watchdog in the controller ends its program.
            self.memory.enter(Phase.FAULTED, f"{self.name}: {error}")

    def _settle(self) -> None:
        end = time.monotonic() + 5.0
        while not self.clock.is_settled:
            if time.monotonic() > end:
                raise LinkError(f"{self.name}: the controller sent too little in 5 s to know its clock by")
            self._kick()
            self._listen(time.monotonic() + self.servoj.tick_s, playing=False)

    def _wait_for_beginning(self) -> tuple[int, float]:
        """Keep the watchdog quiet until it is time to begin.

        Returns:
            The first control period, and which target belongs there: a fraction of one, where the controllers' periods
            do not begin together.
        """
        first = None
        while True:
            now, begin_s = time.monotonic(), self.cell.begin_s
            if begin_s and first is None:
                first, at_s = self.clock.next_period(begin_s, SHARE)
                self.memory.note_first(at_s)
            if first is not None and begin_s < now + _KICK_S:
                return first, self._ahead()
            self._kick()
            self._listen(now + self.servoj.tick_s)

    def _ahead(self) -> float:
        """By how many control periods this arm's periods are behind those of the arm that it keeps step with."""
        if self._leader is None:
            return 0.0
        if not self._leader.first_s:
            raise StopError("the other arm does not begin: this machine is too busy")
        ahead = (self.memory.first_s - self._leader.first_s) / self.servoj.tick_s
        return round(ahead) if abs(ahead - round(ahead)) * self.servoj.tick_s < TOGETHER_S else ahead

    def _kick(self) -> None:
        """Feed the watchdog while there are no targets, which feed it, too."""
        now = time.monotonic()
        if now - self._kicked_s >= _KICK_S:
            self._kicked_s = now
            if not self.control.kickWatchdog():
                raise StopError(
                    "its control script does not run any more: it was stopped, or this machine is too busy to feed its "
                    "watchdog"
                )

    def _stream(self, first: int, ahead: float) -> None:
        """Send in control period `first` + k the target that belongs to period k + `ahead`."""
        self.memory.enter(Phase.STREAMING)
        self._first = first
        drift = DriftCompensation(self.servoj.tick_s, self.clock.offset_s)
        period = 0
        while True:
            self._listen(self.clock.moment(first + period, SHARE))
            late = time.monotonic() - self.clock.moment(first + period, SHARE)
            if late > MOST_LATE_S:
                raise StopError(f"targets are sent {1e3 * late:.0f} ms late: this machine is too busy")
            # What would come in the next period is left out: two targets in one period would be a jump.
            passed = int(late / self.servoj.tick_s + SHARE)
            if passed > 0:
                if passed * float(np.abs(self._rate).max()) > START_GAP_RAD:
                    raise StopError(
                        f"targets are sent {1e3 * late:.0f} ms late while the arm moves: this machine is too busy"
                    )
                self.memory.note_skipped(passed)
                period += passed
            index = self.cell.time_scaling.at(period + ahead + drift(self.clock.offset_s, 1 + passed))
            target = self.memory.target(index)
            self._send(target, first + period, index)
            self.memory.note_sent(period, index, self._sent_s, late, target)
            period += 1

    def _send(self, target_rad: Array, period: int, index: float) -> None:
        self._advance = (index - self._index) / max(period - self._period, 1) if self._sent else 0.0
        if not self._pass_on(target_rad, period, index):
            raise StopError("its control script takes no targets any more")
        self._following.sent(target_rad, np.abs(self._rate) / self.servoj.tick_s)

    def _pass_on(self, target_rad: Array, period: int, index: float) -> bool:
        """Check a target and send it. Returns whether it was taken."""
        periods = max(period - self._period, 1) if self._sent else 1
        self._check(target_rad, periods)
        self._rate = (target_rad - self._sent[-1]) / periods if self._sent else np.zeros(6)
        self._sent, self._period, self._index = [target_rad], period, index
        if not self.control.isConnected():
            raise LinkError(f"{self.name}: ur_rtde has lost the controller; look at its network")
        self._sent_s = time.monotonic()
        profile = self.servoj
        return self.control.servoJ(target_rad.tolist(), 0.0, 0.0, profile.tick_s, profile.lookahead_s, profile.gain)

    def _check(self, target_rad: Array, periods: int) -> None:
        """Let nothing out that no gate would: `ur_rtde` sends whatever it is given.

        Raises:
            TargetError: A number is not finite, out of the joint range, or too far from what was sent last, `periods`
                control periods ago; or the first target is not where the arm is.
        """
        if not np.isfinite(target_rad).all():
            raise TargetError(f"a target is no finite numbers: {target_rad.tolist()}")
        if (np.abs(target_rad) > JOINT_RANGE_RAD).any():
            raise TargetError(f"a target is beyond the joint range: {target_rad.tolist()}")
        tick_s = self.servoj.tick_s
        if not self._sent:
            self._demand(np.abs(target_rad - self._measured_rad), np.full(6, START_GAP_RAD), "from where the arm is")
            return
        step = target_rad - self._sent[-1]
        self._demand(np.abs(step), HARD_SPEED_RAD_S * tick_s * periods, "from the one before")
        turn = _TURN * HARD_ACCELERATION_RAD_S2 * tick_s**2 * (periods + 1)
        self._demand(np.abs(step / periods - self._rate), np.full(6, turn), "a period off the way that the arm was on")

    def _demand(self, found: Array, allowed: Array, what: str) -> None:
        if not (found <= allowed * (1 + 1e-9)).all():
            joint = int((found / allowed).argmax())
            raise TargetError(
                f"a target is {found[joint]:.4f} rad {what} at joint {joint}: allowed are {allowed[joint]:.4f}"
            )

    def _listen(self, until_s: float, *, playing: bool = True) -> None:
        """Take what the controller tells until a time.

        Raises:
            StopError: The arm must stop.
            LinkError: The controller is lost.
        """
        while True:
            now = time.monotonic()
            self.memory.beat(now)
            self._look_around(now)
            left = until_s - now
            if left <= 0.0:
                return
            select.select([self.link.fileno()], [], [], left)
            for sample in self.link.poll():
                self.clock.note(sample.timestamp_s, sample.arrival_s)
                status = ArmStatus.from_sample(sample)
                self._measured_rad = np.array(status.q_rad)
                self.memory.note_state(status)
                reason = stop_reason(status, allow_reduced=self.cell.allow_reduced, playing=playing)
                reason = reason or self._following(status)
                if reason is not None:
                    raise StopError(reason)
            age = self.link.age_s(time.monotonic())
            if age > STALE_S:
                raise LinkError(f"the controller's time has stood still for {1e3 * age:.0f} ms; look at its network")

    def _look_around(self, now: float) -> None:
        """See whether anybody else wants a stop, or is not there any more.

        Raises:
            StopError: So it is.
        """
        stop_asked = self.memory.stop_asked
        if self.cell.fault:  # which comes before a stop is asked for
            raise StopError(self.cell.fault)
        if stop_asked:
            raise StopError(_ASKED)
        for other in self.others:
            phase = other.phase
            if phase >= Phase.STOPPING:
                raise StopError(f"{_OTHER}: {other.text}")
            limit_s = STALE_S if self._sent or phase == Phase.STREAMING else WAITING_S
            other_name = next(each for each in ARMS if each != self.name)
            if phase in (Phase.READY, Phase.STREAMING) and now - other.beat_s > limit_s:
                raise StopError(f"the process of the {other_name} arm does nothing any more")
            if self._sent and phase < Phase.STREAMING and now - self.cell.begin_s > STALE_S:
                raise StopError(f"the {other_name} arm does not begin: this machine is too busy")
        if self._parent is not None and os.getppid() != self._parent:
            raise StopError("the program that gives targets has ended")
        if self._watched and self._sent and now - self.cell.supervisor_beat_s > STALE_S:
            raise StopError("the supervisor does nothing any more")

    def _stop(self, reason: str, *, on_path: bool) -> None:
        """Bring the arm to rest, and end its program.

        Args:
            reason: Why.
            on_path: Whether it comes to rest on the way that its targets go on, as the other arm does, so that what
                both hold is not torn; else straight on.
        """
        self.memory.enter(Phase.STOPPING, f"{self.name}: {reason}")
        if self._sent and time.monotonic() - self._sent_s > MOST_LATE_S:
            # Its watchdog has ended the program by now: whatever is sent would come as a surprise.
            self.memory.enter(Phase.FAULTED, f"{self.name}: {reason}")
            return
        try:
            taken = self._stop_by_any_path(on_path=on_path)
            self.control.servoStop(_STOP_RAD_S2)
            self.control.stopScript()
        except (LinkError, RuntimeError) as error:
            self.memory.enter(Phase.FAULTED, f"{self.name}: {reason}; {_WHILE}: {error}")
            return
        more = self._alone if taken else f"; {_WHILE}: its control script took no targets any more"
        self.memory.enter(Phase.STOPPED, f"{self.name}: {reason}{more}")
        self._record_until_rest()

    def _stop_by_any_path(self, *, on_path: bool) -> bool:
        """Come to rest on the way of the targets, or where that cannot be gone, straight on, or else at once.

        Returns:
            Whether the controller took all that was sent.
        """
        for way in (True, False) if on_path else (False,):
            try:
                return self._ramp_down(on_path=way)
            except TargetError:
                continue
        return True

    def _hear(self, until_s: float) -> bool:
        """Note what the controller tells until a time, whatever it is: the arm stops already.

        Returns:
            Whether it still tells something.
        """
        while (left := until_s - time.monotonic()) > 0.0:
            try:
                select.select([self.link.fileno()], [], [], left)
                for sample in self.link.poll():
                    self.memory.note_state(ArmStatus.from_sample(sample))
            except (LinkError, ClosedError):  # the way to rest is gone on with all the same
                time.sleep(max(0.0, until_s - time.monotonic()))
                return False
        return True

    def _record_until_rest(self) -> None:
        """Let the record see the arm come to rest."""
        end = time.monotonic() + _REST_S
        while time.monotonic() < end and self._hear(time.monotonic() + 2 * self.servoj.tick_s):
            status = self.memory.status
            if status is not None and max(map(abs, status.qd_rad_s)) < _REST_RAD_S:
                return

    def _ramp_down(self, *, on_path: bool) -> bool:
        """Send targets that slow down.

        Returns:
            Whether the controller took them.

        Raises:
            TargetError: They are none that may be sent.
        """
        tick_s = self.servoj.tick_s
        most = round(_ALONE_S / tick_s)
        missed = self.clock.next_period(time.monotonic(), SHARE)[0] - self._period
        if not self._sent:
            return True
        if missed > most:
            self._alone = f"; sent nothing for {1e3 * missed * tick_s:.0f} ms, it came to rest at its last target"
            return True
        last, rate, begin, advance = self._sent[-1], self._rate, self._index, self._advance
        # Both arms slow down alike, as the faster one must.
        speed = max([np.abs(rate).max() / tick_s, *(_speed(other, tick_s) for other in self.others)])
        on_path = on_path and advance > 0.0
        ramp = StopRamp(np.array([[-speed * tick_s], [0.0]]), tick_s)
        gone = 0.0
        while not ramp.at_rest:
            number, due = self.clock.next_period(time.monotonic(), SHARE)
            self._hear(due)
            missed = max(1, number - self._period)
            if missed > most:
                self._alone = f"; sent nothing for {1e3 * missed * tick_s:.0f} ms, it came to rest by itself"
                return True
            # Time passes for the ramp, too, where a period has gone by without a target.
            for _ in range(missed):
                gone = float(ramp()[0]) / (speed * tick_s)  # in control periods at the speed before
            index = begin + gone * advance if on_path else begin
            way = self.memory.target(index) if on_path else last + gone * rate
            if not self._pass_on(way, number, index):
                return False  # the controller stopped it
            self.memory.note_sent(number - self._first, index, self._sent_s, self._sent_s - due, way)
        return True


def _speed(memory: ArmMemory, tick_s: float) -> float:
    """Greatest joint speed of what an arm was sent in the last periods, before it slowed down itself, rad/s."""
    sent, _ = memory.sent(max(0, memory.sent_count - _LOOKED_AT))
    if len(sent.period) < 2:
        return 0.0
    periods = np.maximum(np.diff(sent.period), 1.0)
    return float((np.abs(np.diff(sent.target_rad, axis=0)).max(axis=1) / periods).max() / tick_s)
