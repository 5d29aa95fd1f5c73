"""Runner: the program's handle of the child processes of a cell of two controllers."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from dual_ur10.errors import CellFaulted, ClosedError, LinkError, SettingsError, StartError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.doctor import check_file
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S, Finding
from dual_ur10.sim2real.control.limits import HISTORY, Envelope, MotionLimits
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.runtime.arm_memory import RING, ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_process import ArmConnection, ArmProcess
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, START_GAP_RAD, root_cause, was_requested
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.latch import Claim
from dual_ur10.sim2real.runtime.safety_monitor import MonitorSettings
from dual_ur10.sim2real.runtime.supervisor import SupervisorProcess
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.links.arm_status import ArmStatus, stop_reason
from ur_core.links.link_socket import NO_ANSWER
from ur_core.processes.interrupts import interrupts_deferred
from ur_core.processes.machine_load import StallWatch, is_too_busy, too_busy
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array

log = logging.getLogger(__name__)

MARGIN_S: Final = 0.012
"""Lead time with which a target must be written: those due sooner may already be in transit."""

SHOWN_STATES: Final = 2
"""States after sending a target until one shows its effect."""

_READY_S: Final = 15.0
_BEGIN_S: Final = 0.3  # from the decision to begin to the first target: as long as processes may stall unnoticed
_FRESH_S: Final = 1.0  # longest wait for states of the processes, before the decision to begin
_CHECKS: Final = 3  # of emulated controllers, while the machine delays what they send
_STOP_S: Final = 1.5  # until both arms have stopped
_END_S: Final = 3.0
_POLL_S: Final = 0.01
_SUPERVISOR_S: Final = 1.0
_VERDICT_S: Final = 0.1
_STATE_S: Final = 0.05
_OF_STREAMS: Final = ("RTDE rate", "RTDE jitter", "round trip")  # checks of the network


class Runner:
    """Two arms that take targets in real time. Construction connects and checks, and moves nothing.

    Args:
        file: Cell file.
        config: Its configuration, with a task's equipment.
        system: Clock, network and processes.

    Attributes:
        stopped: True after `close` if the processes of both arms reported that their arm is at rest.

    Raises:
        CellFaulted: A latched stop was not cleared.
        CellBusyError: Another program moves one of them.
        StartError: A controller is not ready.
        LinkError: A controller cannot be reached.
    """

    def __init__(self, file: CellFile, config: CellConfig, *, system: System = LOCAL) -> None:
        self.clock = system.clock
        self.file, self.tick_s = file, config.servoj.tick_s
        self._claim = Claim(file, system)
        self.latch = self._claim.latch
        self.margin_ticks = margin_ticks(self.tick_s)
        self._stalls = StallWatch(file.kind == "emulated")
        self._fault = ""
        self._closed = False
        self.stopped = False
        self._pid = os.getpid()
        self.arms: list[ArmMemory] = []
        self.processes: list[ArmProcess] = []
        self.supervisor: SupervisorProcess | None = None
        try:
            check(file, system)
            self.cell = CellMemory()
            if file.allow_reduced_mode:
                self.cell.permit_reduced_mode()
            self.arms = [ArmMemory(), ArmMemory()]
            emulated = file.kind == "emulated"
            settings = MonitorSettings((config.left, config.right), self.tick_s, emulated)
            with interrupts_deferred():  # no process without its being known here
                for arm, (name, entry) in enumerate(zip(ARMS, file.arms, strict=True)):
                    connection = ArmConnection(name, entry.host, entry.profile, entry.robot, file.rt_priority, emulated)
                    others = (self.arms[1 - arm],)
                    self.processes.append(ArmProcess(connection, self.arms[arm], self.cell, others, system=system))
                self.supervisor = SupervisorProcess(file, settings, self.arms, self.cell, system=system)
            self._wait_until_ready()
            self.supervisor.wait_until_ready(_READY_S)
            self.check()
        except BaseException:
            self.close()
            raise

    def _wait_until_ready(self) -> None:
        """Wait until both arms' processes are ready.

        Raises:
            LinkError: One is not ready in time, or stopped.
        """
        for process in self.processes:
            try:
                process.wait_until_ready(_READY_S)
            except LinkError as error:
                texts = [str(error), *(memory.text for memory in self.arms if memory.phase >= Phase.STOPPING)]
                raise LinkError(root_cause(texts)) from error

    # Time.

    @property
    def begun(self) -> bool:
        """True once targets are sent."""
        return self.cell.begin_s > 0.0

    @property
    def moves_on(self) -> bool:
        """True while no stop is requested: only then may a gripper execute earlier commands. Never blocks."""
        if self._closed or self.cell.ending or self.cell.fault:
            return False
        return all(memory.phase < Phase.STOPPING for memory in self.arms)

    @property
    def now(self) -> float:
        """Number of the current target; the arms are at it or at the one before."""
        return self.cell.time_scaling.at((self.clock.now_s() - self.cell.begin_s) / self.tick_s)

    @property
    def next(self) -> int:
        """Number of the first target that can still be written."""
        return math.ceil(self.now) + self.margin_ticks

    @property
    def end(self) -> int:
        """Number after that of the last target."""
        return self.arms[0].end

    def time_of(self, index: float) -> float:
        """Return the due time of a target on the monotonic clock under the current time scaling."""
        return self.cell.begin_s + self.cell.time_scaling.period_of(index) * self.tick_s

    def wait_for(self, index: float) -> None:
        """Wait until a target is due.

        Raises:
            CellFaulted: Both arms are stopped.
        """
        while True:
            self.check()
            if self.now >= index:
                return
            left_s = self.time_of(index) - self.clock.now_s()
            self.clock.sleep(min(max(left_s, 1e-4), _POLL_S))

    # Targets.

    def begin(self, q_rad: Array) -> None:
        """Start to send targets, beginning with the arms' current configuration.

        Args:
            q_rad: (2, 6) measured joint angles from which the motion was planned.

        Raises:
            StartError: An arm is not ready, moves, or has moved since.
        """
        end = self.clock.now_s() + _FRESH_S
        while self.clock.now_s() < end and any(self._age_s(each) > STALE_S for each in self.statuses()):
            self.check()
            self.clock.sleep(_POLL_S)  # nothing moves yet: a stall of this machine may pass
        for name, status, planned in zip(ARMS, self.statuses(), q_rad, strict=True):
            reason = stop_reason(status, allow_reduced=self.cell.allow_reduced, playing=True)
            fastest = max(map(abs, status.qd_rad_s))
            age_s = self._age_s(status)
            if reason is None and not age_s < STALE_S:
                runs = self.processes[ARMS.index(name)].process.is_alive
                more = f": its newest state is {1e3 * age_s:.0f} ms old"
                reason = self._stalls.process_silent("its process", runs=runs, more=more)
            if reason is None and not fastest < REST_RAD_S:
                reason = f"it moves at {fastest:.3f} rad/s, allowed are {REST_RAD_S:g}: wait until it rests"
            off = np.abs(np.subtract(status.q_rad, planned))
            if reason is None and not off.max() <= START_GAP_RAD:
                joint = int(off.argmax())
                reason = (
                    f"{JOINTS[joint]} is {off[joint]:.4f} rad from where it was when the motion was planned, allowed "
                    f"are {START_GAP_RAD:g}: keep hands off, and reset again"
                )
            if reason is not None:
                raise StartError(f"{name} cannot begin: {reason}")
        self._claim.note_moving()
        self._put(0, np.asarray(q_rad)[None])
        factor = self.file.speed_factor
        self.cell.set_time_scaling(TimeScaling(0.0, 0.0, factor, factor))
        self.cell.begin(self.clock.now_s() + _BEGIN_S)
        self.wait_for(self.margin_ticks)

    def _age_s(self, status: ArmStatus) -> float:
        return self.clock.now_s() - status.arrival_s

    def write(self, first: int, targets_rad: Array) -> bool:
        """Write targets `first`, `first` + 1, ..., (k, 2, 6), for both arms, unless they miss their deadline.

        Returns:
            False if they miss it: both arms then follow the brake after the previous targets.
        """
        if first < self.next:
            return False
        self._put(first, targets_rad)
        if math.ceil(self.now) + 1 > first:
            self.stop(too_busy("this program stalled while it wrote targets, which may have missed their deadline"))
        return True

    def _put(self, first: int, targets_rad: Array) -> None:
        with interrupts_deferred():  # never one arm without the other
            for arm, memory in enumerate(self.arms):
                memory.put(first, targets_rad[:, arm])

    def last(self) -> Array:
        """Return the last target, (2, 6)."""
        return np.array([memory.target(memory.end - 1) for memory in self.arms])

    # States.

    def statuses(self) -> list[ArmStatus]:
        """Return the newest states of both arms.

        Raises:
            StartError: A controller has sent none yet.
        """
        found = [memory.status for memory in self.arms]
        if any(each is None for each in found):
            raise StartError("a controller has not sent its state yet: make the environment again")
        return [each for each in found if each is not None]

    def statuses_after(self, index: float) -> list[ArmStatus]:
        """Return the first states that show the effect of the targets before `index`, or else the newest ones.

        Raises:
            CellFaulted: Both arms are stopped, for example because a state is not finite.
        """
        end = self.clock.now_s() + _STATE_S
        found: list[ArmStatus | None] = [None for _ in self.arms]
        counts = [(-1, -1) for _ in self.arms]
        while True:
            for arm, memory in enumerate(self.arms):
                if found[arm] is None and counts[arm] != (now := (memory.sent_count, memory.state_count)):
                    counts[arm], found[arm] = now, self._status_after(memory, index)
            known = [each for each in found if each is not None]
            late = self.clock.now_s() > end
            if late and len(known) < len(found):
                known = self.statuses()
            self.check()  # an arm's process notes a stop before the state that is its reason
            if late or len(known) == len(found):
                return known
            self.clock.sleep(5e-4)

    def _status_after(self, memory: ArmMemory, index: float) -> ArmStatus | None:
        sent_s = memory.sent_s(index - 1.0 - 1e-9)
        return None if sent_s is None else memory.status_after(sent_s, SHOWN_STATES)

    # Stops.

    def check(self) -> None:
        """Check for faults.

        Raises:
            CellFaulted: Both arms are stopped.
            StartError: This machine stalled before anything moved.
            ClosedError: The cell was closed, or this process is a fork that does not own the arms.
        """
        if self._closed or self.cell.ending or os.getpid() != self._pid:
            raise ClosedError("this cell was closed, or belongs to another process: make a new one")
        if self.begun and not self._fault and self.clock.now_s() - self.cell.supervisor_beat_s > _SUPERVISOR_S:
            self.cell.enter_fault(self._stalls.process_silent("the supervisor", runs=self._is_supervised()))
        if not self._fault and (self.cell.fault or any(memory.phase >= Phase.STOPPING for memory in self.arms)):
            self._fail()
        if self._fault and self._is_unmoved:
            raise StartError(f"{self._fault}. Nothing has moved: make the environment again")
        if self._fault:
            raise CellFaulted(
                f"both arms were stopped: {self._fault}. Check both, correct the cause, then {self.file.clearing}"
            )

    def stop(self, reason: str) -> None:
        """Make a latched stop of both arms and wait until they are at rest."""
        if not (self._fault or self._closed or self.cell.ending or os.getpid() != self._pid):
            self.cell.enter_fault(reason)
            self._fail()

    @property
    def _is_unmoved(self) -> bool:
        """True after a stall of this machine before the first target: there is nothing that a person should check."""
        return not self.begun and is_too_busy(self._fault)

    def _is_supervised(self) -> bool:
        return self.supervisor is not None and self.supervisor.process.is_alive

    def _request_end(self) -> None:
        self.cell.end()
        for memory in self.arms:
            memory.stop()

    def _is_stopping(self) -> bool:
        return self.begun and any(memory.phase >= Phase.STOPPING for memory in self.arms)

    def _stop_failure(self) -> str:
        """Return why an arm did not stop on request, or stopped for another reason; "" if it stopped as requested."""
        if not (self.arms and self.begun):
            return ""
        texts = []
        for name, memory in zip(ARMS, self.arms, strict=True):
            if memory.phase < Phase.STOPPED:
                texts.append(f"{name}: its process did not stop and was killed")
            elif memory.phase == Phase.FAULTED or not was_requested(memory.text):
                texts.append(memory.text)
        return root_cause(texts) if texts else ""

    def _fail(self) -> None:
        for memory in self.arms:
            memory.stop()
        self._wait_for_end(_STOP_S)
        end = self.clock.now_s() + _VERDICT_S  # an arm's process reports what it sees, the supervisor why that is so
        while not self.cell.fault and self._is_supervised() and self.clock.now_s() < end:
            self.clock.sleep(_POLL_S / 10)
        texts = [memory.text for memory in self.arms if memory.phase >= Phase.STOPPING]
        self._fault = self.cell.fault or root_cause(texts or ["an arm's process has ended"])
        self._note()

    def _note(self) -> None:
        """Latch the fault, unless nothing has moved."""
        if not self._is_unmoved:
            self._claim.latch_stop(self._fault)

    def _wait_for_end(self, within_s: float) -> None:
        end = self.clock.now_s() + within_s
        while self.clock.now_s() < end:
            if all(memory.phase >= Phase.STOPPED for memory in self.arms):
                return
            if not any(each.process.is_alive for each in self.processes):
                return
            self.clock.sleep(_POLL_S)

    def close(self) -> None:
        """Stop both arms, end their programs and all processes. May be called twice.

        After an interrupt it can be called again and continues.
        """
        if self._closed or os.getpid() != self._pid:
            return
        try:
            if self.arms:
                if not (self._fault or self.cell.ending) and self._is_stopping():
                    self._fail()  # a stop since the last check
                self._request_end()
                self._wait_for_end(_END_S)
        finally:  # a second Ctrl-C shortens the waits and leaves nothing running; a third one has to wait
            with interrupts_deferred():
                if self.arms:
                    self._request_end()
                for each in self.processes:
                    if not each.process.wait(_STOP_S):
                        each.process.kill()
                if self.supervisor is not None and not self.supervisor.process.wait(_END_S):
                    self.supervisor.process.kill()
                self.stopped = all(memory.phase == Phase.STOPPED for memory in self.arms)
                try:
                    if not self._fault and (why := self._stop_failure()):
                        self._fault = self.cell.fault or why
                        self._note()
                    elif not self._fault or self._is_unmoved:
                        self._claim.note_stopped()
                finally:
                    self._claim.release()
                    self._closed = True
                    if self.arms:
                        self.cell.close()
                        for memory in self.arms:
                            memory.close()


class TargetWriter:
    """Writes the targets of both arms, followed by the brake that the safety gate has checked.

    Args:
        limits: Limits of the gate, from which its brake follows.
        tick_s: Control period.
        most_ticks: Largest number of targets written at once or ahead.

    Raises:
        SettingsError: Under these limits the brake is longer than the memory holds.
    """

    def __init__(self, limits: MotionLimits, tick_s: float, most_ticks: int) -> None:
        self._brake: Array = Envelope(limits, tick_s, 1).whole_brake()
        count, most = len(self._brake), RING // 2 - most_ticks
        if count > most:
            raise SettingsError(
                f"the limits of this cell need a brake of {count * tick_s:.1f} s, {most * tick_s:.1f} s is "
                "the most that is kept ready: allow more acceleration or jerk, or less speed"
            )
        self._past: Array = np.zeros((HISTORY, 2, 6))  # last targets, without those of the brake

    def rest_at(self, q_rad: Array) -> None:
        """Continue from both arms at rest at (2, 6)."""
        self._past = np.tile(q_rad, (HISTORY, 1, 1))

    def write(self, runner: Runner, first: int, targets_rad: Array) -> bool:
        """Write targets, (k, 2, 6), from number `first` on; return False if it is too late for that."""
        last = np.concatenate([self._past, targets_rad])[-HISTORY:]
        past = last.reshape(HISTORY, 12)
        brake = past[-1] + self._brake @ (past - past[-1])
        whole = np.concatenate([targets_rad, brake.reshape(-1, 2, 6)])
        if not runner.write(first, whole):
            return False
        self._past = last
        return True


def margin_ticks(tick_s: float) -> int:
    """Return the number of ticks by which targets must be written ahead."""
    return max(2, math.ceil(MARGIN_S / tick_s - 1e-9))


def least_latency_ticks(tick_s: float) -> int:
    """Return the smallest latency at which no action is late that is written as soon as its state is known.

    It is one tick more than state and margin take. During and after a time scaling, targets fall due anywhere between
    two control periods, and each is sent at the next one.
    """
    return margin_ticks(tick_s) + SHOWN_STATES + 1


def _are_delays(failed: Sequence[Finding]) -> bool:
    """Return True if emulated controllers only answered too late, of which both are in one process of this machine."""
    silent = [each for each in failed if each.name not in _OF_STREAMS]
    return all(NO_ANSWER in each.found for each in silent) and len({each.arm for each in silent}) in (0, len(ARMS))


def check(file: CellFile, system: System = LOCAL, *, timeout_s: float = 1.5, streams: bool = True) -> None:
    """Check both controllers as `doctor` does.

    Args:
        file: Cell file.
        system: Clock and network.
        timeout_s: Time limit of each connection.
        streams: A target is sent in each control period, so that delay, rate and jitter of the network count.

    Raises:
        StartError: A check failed.
    """
    emulated = file.kind == "emulated"
    for left in reversed(range(_CHECKS if emulated else 1)):
        findings = check_file(file, system, timeout_s=timeout_s)
        findings = [each for each in findings if streams or each.name not in _OF_STREAMS]
        failed = [each for each in findings if each.level == "fail"]
        delayed = emulated and _are_delays(failed)
        if not failed:
            break
        if not (delayed and left):
            text = ". ".join(replace(each, remedy="").message if delayed else each.message for each in failed)
            raise StartError(too_busy(text) if delayed else text)
    for finding in findings:
        if finding.level == "warn":
            log.info("%s", finding.message)
