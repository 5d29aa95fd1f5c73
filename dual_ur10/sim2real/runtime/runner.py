"""The processes of a cell of two controllers, and what the program that has the policy says to them."""

from __future__ import annotations

import logging
import math
import os
import time
from typing import Final

import numpy as np

from dual_ur10.errors import CellFaulted, ClosedError, StartError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.commissioning.doctor import check_cell
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S, any_fails, expected_of
from dual_ur10.sim2real.config.cell import CellConfig
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.links.arm_status import ArmStatus, stop_reason
from dual_ur10.sim2real.processes.interrupts import interrupts_deferred
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_process import ArmConnection, ArmProcess
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, root_cause, was_asked_for
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.latch import CellLock, Latch
from dual_ur10.sim2real.runtime.safety_monitor import MonitorSettings
from dual_ur10.sim2real.runtime.supervisor import SupervisorProcess
from dual_ur10.types import Array

log = logging.getLogger(__name__)

MARGIN_S: Final = 0.012
"""How far ahead of the arms a target must be written: nearer ones may be on their way already."""

_READY_S: Final = 15.0
_BEGIN_S: Final = 0.1  # from the decision to begin to the first target
_STOP_S: Final = 1.5  # within which both arms stand
_END_S: Final = 3.0
_LOOK_S: Final = 0.01
_WATCHED_S: Final = 1.0
_AFTER: Final = 2  # states after a target was sent, until one shows what it did
_STATE_S: Final = 0.05


class Runner:
    """Two arms that take targets in real time. To make one connects and checks, and moves nothing.

    Args:
        file: The cell.
        config: The same, with a task's equipment.
        coupled: Whether both arms hold one object.

    Attributes:
        came_to_rest: Once it is closed: whether the processes of both arms said that their arm is at rest.

    Raises:
        CellFaulted: The arms were stopped, and nobody has cleared that.
        CellBusyError: Another program moves one of them.
        StartError: A controller is not ready.
        LinkError: A controller cannot be reached.
    """

    def __init__(self, file: CellFile, config: CellConfig, *, coupled: bool) -> None:
        self.file, self.tick_s = file, config.servoj.tick_s
        self.latch = Latch(file)
        self.latch.check()
        self._lock = CellLock(file)
        try:
            if self._lock.left_moving:
                self.latch.set("the program that moved the arms before ended without stopping them in order")
            self.latch.check()  # once more: the program that had the lock may have stopped them meanwhile
        except BaseException:
            self._lock.release(in_order=False)
            raise
        self.margin_ticks = margin_ticks(self.tick_s)
        self._fault = ""
        self._noted = True  # whether a fault is kept where the next start finds it
        self._closed = False
        self.came_to_rest = False
        self._pid = os.getpid()
        self.arms: list[ArmMemory] = []
        self.processes: list[ArmProcess] = []
        self.supervisor: SupervisorProcess | None = None
        try:
            check(file)
            self.cell = CellMemory()
            if file.allow_reduced_mode:
                self.cell.permit_reduced_mode()
            self.arms = [ArmMemory(), ArmMemory()]
            settings = MonitorSettings((config.left, config.right), self.tick_s, coupled)
            with interrupts_deferred():  # no process without its being known here
                for arm, (name, entry) in enumerate(zip(ARMS, file.arms, strict=True)):
                    connection = ArmConnection(name, entry.host, entry.profile, file.rt_priority)
                    others = (self.arms[1 - arm],)
                    self.processes.append(ArmProcess(connection, self.arms[arm], self.cell, others))
                self.supervisor = SupervisorProcess(file, settings, self.arms, self.cell)
            for process in self.processes:
                process.wait_until_ready(_READY_S)
            self.supervisor.wait_until_ready(_READY_S)
            self.check()
        except BaseException:
            self.close()
            raise

    # Time.

    @property
    def begun(self) -> bool:
        """Whether targets are sent."""
        return self.cell.begin_s > 0.0

    @property
    def moves_on(self) -> bool:
        """Whether nobody has stopped the arms: only then may a gripper do what it was told before. It never waits."""
        if self._closed or self.cell.ending or self.cell.fault:
            return False
        return all(memory.phase < Phase.STOPPING for memory in self.arms)

    @property
    def now(self) -> float:
        """Number of the target whose time it is; the arms are at it or at the one before."""
        return self.cell.time_scaling.at((time.monotonic() - self.cell.begin_s) / self.tick_s)

    @property
    def next(self) -> int:
        """Number of the first target that can still be written."""
        return math.ceil(self.now) + self.margin_ticks

    @property
    def end(self) -> int:
        """Number behind the last target."""
        return self.arms[0].end

    def time_of(self, index: float) -> float:
        """When a target's turn comes, by the monotonic clock, as far as is known now."""
        return self.cell.begin_s + self.cell.time_scaling.period_of(index) * self.tick_s

    def wait_for(self, index: float) -> None:
        """Wait until a target's time has come.

        Raises:
            CellFaulted: Both arms are stopped.
        """
        while True:
            self.check()
            if self.now >= index:
                return
            left_s = self.time_of(index) - time.monotonic()
            time.sleep(min(max(left_s, 1e-4), _LOOK_S))

    # Targets.

    def begin(self, q_rad: Array) -> None:
        """Send targets from now on: at first where the arms are, (2, 6).

        Raises:
            StartError: An arm is not ready, or moves.
        """
        for name, status in zip(ARMS, self.statuses(), strict=True):
            reason = stop_reason(status, allow_reduced=self.cell.allow_reduced, playing=True)
            fastest = max(map(abs, status.qd_rad_s))
            age_s = time.monotonic() - status.arrival_s
            if reason is None and not age_s < STALE_S:
                reason = f"its process does nothing any more: its newest state is {1e3 * age_s:.0f} ms old"
            if reason is None and not fastest < REST_RAD_S:
                reason = f"it moves at {fastest:.3f} rad/s, allowed are {REST_RAD_S:g}: wait until it stands"
            if reason is not None:
                raise StartError(f"{name} cannot begin: {reason}")
        self._lock.note_moving()
        self._put(0, np.asarray(q_rad)[None])
        factor = self.file.speed_factor
        self.cell.set_time_scaling(TimeScaling(0.0, 0.0, factor, factor))
        self.cell.begin(time.monotonic() + _BEGIN_S)
        self.wait_for(self.margin_ticks)

    def write(self, first: int, targets_rad: Array) -> bool:
        """Write targets `first`, `first` + 1, ..., (k, 2, 6), for both arms, if it is not too late for that.

        Returns:
            Whether they were written: else both arms are in the brake behind those before.
        """
        if first < self.next:
            return False
        self._put(first, targets_rad)
        if math.ceil(self.now) + 1 > first:
            self.stop(
                "this program stood still while it wrote targets, which may have come too late: too busy a machine"
            )
        return True

    def _put(self, first: int, targets_rad: Array) -> None:
        with interrupts_deferred():  # never one arm without the other
            for arm, memory in enumerate(self.arms):
                memory.put(first, targets_rad[:, arm])

    def last(self) -> Array:
        """The last target, (2, 6)."""
        return np.array([memory.target(memory.end - 1) for memory in self.arms])

    # States.

    def statuses(self) -> list[ArmStatus]:
        """The newest states of both arms.

        Raises:
            StartError: There is none yet.
        """
        found = [memory.status for memory in self.arms]
        if any(each is None for each in found):
            raise StartError("a controller has not told its state yet: make the cell again")
        return [each for each in found if each is not None]

    def statuses_after(self, index: float) -> list[ArmStatus]:
        """The first states that show what the targets before `index` have done; the newest, if they do not come."""
        end = time.monotonic() + _STATE_S
        while True:
            found = [self._status_after(memory, index) for memory in self.arms]
            known = [each for each in found if each is not None]
            if len(known) == len(found):
                return known
            if time.monotonic() > end:
                return self.statuses()
            self.check()
            time.sleep(5e-4)

    def _status_after(self, memory: ArmMemory, index: float) -> ArmStatus | None:
        sent, _ = memory.sent(memory.sent_count - 32)
        after = np.flatnonzero(sent.index >= index - 1.0 - 1e-9)
        if not after.size:
            return None
        rows, _ = memory.states(memory.state_count - 32)
        shown = rows[rows[:, 0] > sent.sent_s[after[0]]]
        return ArmStatus.from_row(shown[_AFTER - 1]) if len(shown) >= _AFTER else None

    # Stops.

    def check(self) -> None:
        """Refuse to go on after a fault.

        Raises:
            CellFaulted: Both arms are stopped.
            ClosedError: It was closed; or this is a copy of the program, whose arms they are not.
        """
        if self._closed or self.cell.ending or os.getpid() != self._pid:
            raise ClosedError("this cell was closed, or belongs to another process: make a new one")
        if self.begun and not self._fault and time.monotonic() - self.cell.supervisor_beat_s > _WATCHED_S:
            self.cell.enter_fault("the supervisor does nothing any more")
        if not self._fault and (self.cell.fault or any(memory.phase >= Phase.STOPPING for memory in self.arms)):
            self._fail()
        if self._fault:
            raise CellFaulted(
                f"both arms were stopped: {self._fault}. Look at both, put right what is wrong, then say "
                f"`python -m dual_ur10 cell clear {self.file.source}`"
            )

    def stop(self, reason: str) -> None:
        """Stop both arms for good, and wait until they stand."""
        if not (self._fault or self._closed or self.cell.ending or os.getpid() != self._pid):
            self.cell.enter_fault(reason)
            self._fail()

    def _ask_to_end(self) -> None:
        self.cell.end()
        for memory in self.arms:
            memory.stop()

    def _is_stopping(self) -> bool:
        """Whether an arm stops that had begun."""
        return self.begun and any(memory.phase >= Phase.STOPPING for memory in self.arms)

    def _not_as_asked(self) -> str:
        """Why an arm that had begun and was asked to stop did not, or not because of that; "": all is well."""
        if not (self.arms and self.begun):
            return ""
        texts = []
        for name, memory in zip(ARMS, self.arms, strict=True):
            if memory.phase < Phase.STOPPED:
                texts.append(f"{name}: its process did not stop by itself, and was ended")
            elif memory.phase == Phase.FAULTED or not was_asked_for(memory.text):
                texts.append(memory.text)
        return root_cause(texts) if texts else ""

    def _fail(self) -> None:
        for memory in self.arms:
            memory.stop()
        self._wait_for_end(_STOP_S)
        texts = [memory.text for memory in self.arms if memory.phase >= Phase.STOPPING]
        self._fault = self.cell.fault or root_cause(texts or ["an arm's process has ended"])
        self._note()

    def _note(self) -> None:
        """Keep the fault where the next start finds it. If that fails, the lock goes on saying that arms move."""
        try:
            self.latch.set(self._fault)
        except OSError as error:
            self._noted = False
            log.error("both arms were stopped (%s), and that cannot be kept: %s", self._fault, error)

    def _wait_for_end(self, within_s: float) -> None:
        end = time.monotonic() + within_s
        while time.monotonic() < end:
            if all(memory.phase >= Phase.STOPPED for memory in self.arms):
                return
            if not any(process.process.is_alive for process in self.processes):
                return
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Bring both arms to rest and end their programs, and all processes. May be called twice.

        Whatever interrupts it, it can be called again and goes on from there.
        """
        if self._closed or os.getpid() != self._pid:
            return
        try:
            if self.arms:
                if not (self._fault or self.cell.ending) and self._is_stopping():
                    self._fail()  # nobody has looked since then
                self._ask_to_end()
                self._wait_for_end(_END_S)
        finally:  # a second Ctrl-C shortens the waits, and leaves nothing running; one more has to wait for that
            with interrupts_deferred():
                if self.arms:
                    self._ask_to_end()
                for process in self.processes:
                    if not process.wait(_STOP_S):
                        process.kill()
                if self.supervisor is not None and not self.supervisor.wait(_END_S):
                    self.supervisor.kill()
                self.came_to_rest = all(memory.phase == Phase.STOPPED for memory in self.arms)
                try:
                    if not self._fault and (why := self._not_as_asked()):
                        self._fault = self.cell.fault or why
                        self._note()
                finally:
                    self._lock.release(in_order=self._noted)
                    self._closed = True
                    if self.arms:
                        self.cell.close()
                        for memory in self.arms:
                            memory.close()


def margin_ticks(tick_s: float) -> int:
    """How many ticks ahead of the arms a target must be written."""
    return max(2, math.ceil(MARGIN_S / tick_s - 1e-9))


def check(file: CellFile) -> None:
    """Look at both controllers as `doctor` does.

    Raises:
        StartError: One is not as it should be.
    """
    findings = check_cell(*(expected_of(each) for each in file.arms))
    if any_fails(findings):
        failures = [each.message for each in findings if each.level == "fail"]
        more = f" ({len(failures) - 1} more: `python -m dual_ur10 doctor {file.source}` shows all)"
        raise StartError(failures[0] + (more if len(failures) > 1 else ""))
    for finding in findings:
        if finding.level == "warn":
            log.info("%s", finding.message)
