"""Sends one arm its targets, one in every control period of its controller, and stops it when anything is wrong."""

from __future__ import annotations

import logging
import select
import time
from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import LinkError
from dual_ur10.sim2real.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.arm_status import ArmStatus, stop_reason
from dual_ur10.sim2real.controller_clock import ControllerClock
from dual_ur10.sim2real.ramp import Ramp
from dual_ur10.sim2real.rtde_link import RtdeLink
from dual_ur10.sim2real.servoj import ServojProfile
from dual_ur10.ur10 import HARD_SPEED_RAD_S, JOINT_RANGE_RAD

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SHARE: Final = 0.5
"""Where in a control period a target is to arrive: as far as can be from where the controller looks for one."""

STALE_S: Final = 0.1
"""How long a controller's time may stand still before it counts as lost: that of MoveIt Servo's command timeout."""

START_GAP_RAD: Final = 0.02
"""How far the first target may be from where the arm is."""

MOST_LATE_S: Final = 0.1
"""How far the sending may fall behind before it is given up."""

_KICK_S: Final = 0.02
_MOST_PERIODS: Final = 12  # that a ramp may have missed
_STOP_RAD_S2: Final = 10.0  # of servoStop, at rest already


class Control(Protocol):
    """What is used of `ur_rtde`'s control interface."""

    def servoJ(  # noqa: N802  # ur_rtde's name
        self, q: Sequence[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float, /
    ) -> bool:
        """Send a target."""

    def servoStop(self, a: float, /) -> bool:  # noqa: N802
        """End servoing."""

    def kickWatchdog(self) -> bool:  # noqa: N802
        """Show the controller that somebody is there."""

    def stopScript(self) -> None:  # noqa: N802
        """End the control script."""


class StopError(Exception):
    """Why the arm is to stop now. It does not leave this module."""


class ArmSender:
    """The loop of one arm's process.

    Args:
        name: Of the arm.
        servoj: Settings of `servoj`.
        link: Tells the arm's state.
        control: Takes targets.
        memory: Where targets come from, and what is told of them.
        others: Memories of the other arms: if one of them stops, so does this one.
        status: Told of every state of the arm.
    """

    def __init__(
        self,
        name: str,
        servoj: ServojProfile,
        link: RtdeLink,
        control: Control,
        memory: ArmMemory,
        others: Sequence[ArmMemory] = (),
        status: Callable[[ArmStatus], None] | None = None,
    ) -> None:
        self.name, self.servoj, self.link, self.control = name, servoj, link, control
        self.memory, self.others, self._told = memory, others, status
        self.clock = ControllerClock(servoj.tick_s)
        self._sent: list[Array] = []
        self._kicked_s = 0.0
        self._period = 0  # of the target that was sent last
        self._rate: Array = np.zeros(6)  # per control period, of what was sent
        self._measured_rad: Array = np.full(6, np.nan)

    def run(self) -> None:
        """Wait for the beginning, send targets, and come to rest when they end or anything is wrong."""
        try:
            self._settle()
            self.memory.enter(Phase.READY)
            first = self._wait_for_beginning()
            self._stream(first)
        except StopError as reason:
            self._stop(str(reason))
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

    def _wait_for_beginning(self) -> int:
        """Keep the watchdog quiet until it is known when to begin. Returns the first control period."""
        while True:
            now = time.monotonic()
            begin_s = self.memory.begin_s
            if begin_s is not None and begin_s < now + _KICK_S:
                return self.clock.next_period(max(now, begin_s), SHARE)[0]
            self._kick()
            self._listen(now + self.servoj.tick_s)

    def _kick(self) -> None:
        """Feed the watchdog while there are no targets, which feed it, too."""
        now = time.monotonic()
        if now - self._kicked_s >= _KICK_S:
            self._kicked_s = now
            if not self.control.kickWatchdog():
                raise StopError("its control script does not run any more")

    def _stream(self, first: int) -> None:
        """Send target k in control period `first` + k."""
        self.memory.enter(Phase.STREAMING)
        tick = 0
        while True:
            due = self.clock.moment(first + tick, SHARE)
            self._listen(due)
            late = time.monotonic() - self.clock.moment(first + tick, SHARE)
            if late > MOST_LATE_S:
                raise StopError(f"targets are sent {1e3 * late:.0f} ms late: this machine is too busy")
            # What is too late for its period is left out: two targets in one period would be a jump.
            passed = int(late / self.servoj.tick_s)
            if passed > 0:
                self.memory.note_skipped(passed)
                tick += passed
            if tick >= self.memory.written:
                raise StopError("there are no more targets")
            self._send(self.memory.target(tick), first + tick)
            self.memory.note_sent(tick, time.monotonic(), late)
            tick += 1

    def _send(self, target_rad: Array, period: int) -> None:
        periods = period - self._period if self._sent else 1
        self._check(target_rad, periods)
        self._rate = (target_rad - self._sent[-1]) / periods if self._sent else np.zeros(6)
        self._sent, self._period = [target_rad], period
        profile = self.servoj
        if not self.control.servoJ(target_rad.tolist(), 0.0, 0.0, profile.tick_s, profile.lookahead_s, profile.gain):
            raise StopError("its control script takes no targets any more")

    def _check(self, target_rad: Array, periods: int) -> None:
        """Let nothing out that no gate would: `ur_rtde` sends whatever it is given.

        Raises:
            StopError: A number is not finite, out of the joint range, or too far from what was sent last, `periods`
                control periods ago; or the first target is not where the arm is.
        """
        if not np.isfinite(target_rad).all():
            raise StopError(f"a target is no finite numbers: {target_rad.tolist()}")
        if (np.abs(target_rad) > JOINT_RANGE_RAD).any():
            raise StopError(f"a target is beyond the joint range: {target_rad.tolist()}")
        if self._sent:
            away, most = np.abs(target_rad - self._sent[-1]), HARD_SPEED_RAD_S * self.servoj.tick_s * periods
        else:
            away, most = np.abs(target_rad - self._measured_rad), np.full(6, START_GAP_RAD)
        if not (away <= most * (1 + 1e-9)).all():
            joint = int((away / most).argmax())
            what = "the one before" if self._sent else "where the arm is"
            raise StopError(
                f"a target is {away[joint]:.4f} rad from {what} at joint {joint}: allowed are {most[joint]:.4f}"
            )

    def _listen(self, until_s: float, *, playing: bool = True) -> None:
        """Take what the controller tells until a time.

        Raises:
            StopError: The arm must stop.
            LinkError: The controller is lost.
        """
        while True:
            if self.memory.stop_asked:
                raise StopError("a stop was asked for")
            for other in self.others:
                if other.phase >= Phase.STOPPING:
                    raise StopError(f"the other arm stops: {other.text}")
            left = until_s - time.monotonic()
            if left <= 0.0:
                return
            select.select([self.link.fileno()], [], [], left)
            for sample in self.link.poll():
                self.clock.note(sample.timestamp_s, sample.arrival_s)
                status = ArmStatus.from_sample(sample)
                self._measured_rad = np.array(status.q_rad)
                if self._told is not None:
                    self._told(status)
                reason = stop_reason(status, playing=playing)
                if reason is not None:
                    raise StopError(reason)
            age = self.link.age_s(time.monotonic())
            if age > STALE_S:
                raise LinkError(f"the controller's time has stood still for {1e3 * age:.0f} ms; look at its network")

    def _stop(self, reason: str) -> None:
        """Bring the arm to rest, and end its program."""
        self.memory.enter(Phase.STOPPING, f"{self.name}: {reason}")
        try:
            self._come_to_rest()
            self.control.servoStop(_STOP_RAD_S2)
            self.control.stopScript()
        except (LinkError, RuntimeError) as error:
            self.memory.enter(Phase.FAULTED, f"{self.name}: {reason}; and while stopping: {error}")
            return
        self.memory.enter(Phase.STOPPED, f"{self.name}: {reason}")

    def _come_to_rest(self) -> None:
        if not self._sent:
            return
        last = self._sent[-1]
        ramp, profile = Ramp(np.array([last - self._rate, last]), self.servoj.tick_s), self.servoj
        period = self._period
        while not ramp.at_rest:
            number, due = self.clock.next_period(time.monotonic(), SHARE)
            time.sleep(max(0.0, due - time.monotonic()))
            # Time passes for the ramp, too, where a period has gone by without a target.
            for _ in range(min(max(1, number - period), _MOST_PERIODS)):
                target = ramp().tolist()
            period = number
            if not self.control.servoJ(target, 0.0, 0.0, profile.tick_s, profile.lookahead_s, profile.gain):
                return  # the controller stopped it
