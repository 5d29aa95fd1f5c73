"""Supervisor: process that monitors both arms by its own connections, and makes a latched stop on any fault.

Its only command is a stop. It depends neither on the arms' processes, which may hang, nor on `ur_rtde`: it reads the
states of both controllers itself. If an arm's process does not end its program, the supervisor kills that process and
asks the dashboard to stop the program.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence
from typing import Final

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.control.time_scaling import scaling_from_slider
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, WAITING_S, of_arm, root_cause
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.latch import Latch
from dual_ur10.sim2real.runtime.safety_monitor import PERIOD_S, MonitorSettings, SafetyMonitor
from dual_ur10.sim2real.runtime.stop_enforcer import StopEnforcer
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.machine_load import is_too_busy, too_busy
from ur_core.processes.system import LOCAL, Process, System

log = logging.getLogger(__name__)

_AHEAD_S: Final = 0.024  # lead time of a new time scaling
_GONE_S: Final = 0.004  # from the end of a controller's first connection to that of its last one


class Supervisor:
    """Loop of the supervisor's process.

    Args:
        file: Cell file.
        settings: Settings of the safety monitor.
        arms: Memories of both arms' processes.
        cell: Memory of the cell.
        parent: Process of the policy.
        system: Clock, network and processes.
    """

    def __init__(
        self,
        file: CellFile,
        settings: MonitorSettings,
        arms: Sequence[ArmMemory],
        cell: CellMemory,
        parent: int,
        *,
        system: System = LOCAL,
    ) -> None:
        self._system, self._clock = system, system.clock
        self._file, self._settings, self._arms, self._cell, self._parent = file, settings, arms, cell, parent
        self._monitor = SafetyMonitor(settings, arms, cell, system=system)
        self._links: list[RtdeLink] = []
        self._ready = False
        self._allowed = file.speed_factor  # time scaling that the speed sliders allow

    def run(self) -> None:
        """Monitor until the program ends or both arms are stopped."""
        for name, arm in zip(ARMS, self._file.arms, strict=True):
            link = RtdeLink(arm.host, STATUS_VARIABLES, optional=OPTIONAL_VARIABLES, name=name, system=self._system)
            self._links.append(link)
        self._enforcer = StopEnforcer(self._arms, [arm.host for arm in self._file.arms], system=self._system)
        self._cell.enter_ready(self._system.pid)
        reason = None
        while reason is None:
            now = self._clock.now_s()
            self._cell.note_supervisor(now)
            self._monitor.stalls.beat(now)
            if self._cell.ending:
                return self._end()
            self._ready = self._ready or all(each.phase in (Phase.READY, Phase.STREAMING) for each in self._arms)
            if self._system.is_orphan(self._parent):
                if not self._monitor.moving:
                    return None  # nothing has moved
                reason = "the program that sends targets has ended"
            reason = reason or self._cell.fault or self._check_links(now) or self._monitor.processes(now)
            if reason and self._cell.ending:
                return self._end()
        return self._stop(reason)

    def _check_links(self, now: float) -> str | None:
        """Process the states of both controllers for at most a control period; return the reason for a stop.

        Those of fast controllers are taken several at a time: a wake-up costs more than a state.
        """
        if self._settings.tick_s < PERIOD_S:
            self._clock.wait(self._enforcer.files, now + PERIOD_S)
        until_s = self._clock.now_s() + self._settings.tick_s
        links = [each.fileno() for each in self._links]
        ready, _ = self._clock.wait([*links, *self._enforcer.files], until_s)
        try:
            self._enforcer.check()
        except LinkError as error:
            return f"the backup stop is lost: {error}"
        for arm, link in enumerate(self._links):
            self._monitor.stalls.note(link.age_s(now), now)
            if links[arm] not in ready and link.age_s(now) < STALE_S:
                continue
            try:
                for sample in link.poll():
                    reason = self._monitor.state(arm, ArmStatus.from_sample(sample))
                    if reason is not None:
                        return reason
            except LinkError as error:
                return of_arm(ARMS[arm], str(error))
            heard = self._clock.now_s()
            age, other_s = link.age_s(heard), self._links[1 - arm].age_s(heard)
            if age > (STALE_S if self._monitor.moving else WAITING_S):
                return f"{ARMS[arm]}: {self._monitor.stalls.controller_silent(age, other_s, heard)}"
        return self._monitor.relative_pose() or self._scale_time()

    def _gone(self) -> str | None:
        """Return that controllers have closed all their connections, if so: it causes all other reasons for a stop.

        They end one after the other. Once one of an arm has ended, the others get a moment; both arms have been told to
        stop by then.
        """
        end_s = self._clock.now_s() + _GONE_S
        while True:
            lost = [(self._is_lost(link), self._enforcer.is_lost(arm)) for arm, link in enumerate(self._links)]
            first = any(map(any, lost)) or any(memory.phase == Phase.FAULTED for memory in self._arms)
            if not first or all(map(all, lost)) or self._clock.now_s() >= end_s:
                break
            self._clock.sleep(_GONE_S / 8)
        gone = [arm for arm, each in enumerate(lost) if all(each)]
        if not gone:
            return None
        where = " and ".join(f"{ARMS[arm]} at {self._file.arms[arm].host}" for arm in gone)
        what = f"both controllers are gone: {where}" if len(gone) == len(ARMS) else f"the controller is gone: {where}"
        emulator = self._file.emulator
        if emulator is not None and emulator.pid is not None and not self._system.is_running(emulator.pid):
            return f"{what}: the emulator (process {emulator.pid}) has ended; start it again"
        return f"{what}: all connections were closed; check whether it was shut down or restarted"

    @staticmethod
    def _is_lost(link: RtdeLink) -> bool:
        try:
            link.poll()
        except LinkError:
            return True
        return False

    def _scale_time(self) -> str | None:
        """Set the time scaling of both arms: the least of what sliders and distances allow.

        Returns:
            The reason if that failed.
        """
        cell = self._cell
        if not cell.begin_s or self._clock.now_s() < cell.begin_s:
            return None
        allowed = scaling_from_slider(self._monitor.slowest) * self._file.speed_factor
        goal = min(allowed, cell.largest_scaling)
        scaling = cell.time_scaling
        if goal == scaling.goal:
            return None
        tick_s = self._settings.tick_s
        now = (self._clock.now_s() - cell.begin_s) / tick_s
        period = max(float(int(now + _AHEAD_S / tick_s)), scaling.period)
        if not scaling.may_change(now - 1.0, period):
            return None
        cell.set_time_scaling(scaling.towards(goal, period, tick_s, self._file.speed_factor))
        if (self._clock.now_s() - cell.begin_s) / tick_s > period:  # an arm may have sent a target of the old scaling
            return too_busy("the supervisor stalled while it changed the time scaling of both arms")
        if allowed != self._allowed:
            self._allowed = allowed
            log.warning("both arms continue at %.0f %% of their speed", 100 * allowed)
        return None

    def _end(self) -> None:
        started = any(memory.phase == Phase.FAULTED for memory in self._arms)  # a failed start may have left a program
        if not (self._cell.begin_s or started):
            return
        self._enforcer.begin()
        self._wait_for_stop()
        failed = [memory.text for memory in self._arms if memory.phase == Phase.FAULTED] + self._enforcer.unended
        if failed and self._cell.begin_s:
            self._latch(self._cell.fault or root_cause(failed))
        self._enforcer.close()

    def _stop(self, reason: str) -> None:
        for memory in self._arms:
            memory.stop()
        self._enforcer.begin()
        self._cell.enter_fault(self._gone() or reason)
        reason = self._cell.fault  # another process may have been first
        latching = None
        # Else a start failed, which its caller reports.
        if self._cell.begin_s or (self._ready and not is_too_busy(reason)):
            # In a thread: a slow disk must not delay the end of a process that hangs.
            latching = self._system.thread(lambda: self._latch(reason), "latch")
        self._wait_for_stop()
        self._enforcer.close()
        if latching is not None:
            latching.join()
        log.error("both arms were stopped: %s", reason)

    def _latch(self, reason: str) -> None:
        latch(self._file, reason, self._system)

    def _wait_for_stop(self) -> None:
        """Wait for the end of both programs, and enforce it."""
        while True:
            self._enforcer.poll(self._monitor.ended)
            if not self._enforcer.waits:
                return
            self._cell.note_supervisor(self._clock.now_s())
            self._clock.sleep(self._settings.tick_s / 4)
            for arm, link in enumerate(self._links):
                with contextlib.suppress(LinkError):  # without a state the program counts as running
                    for sample in link.poll():
                        self._monitor.note(arm, ArmStatus.from_sample(sample))


class SupervisorProcess:
    """Process of the supervisor.

    Args:
        file: Cell file.
        settings: Settings of the safety monitor.
        arms: Memories of both arms' processes.
        cell: Memory of the cell.
        system: Clock and processes.

    Attributes:
        process: The process.
    """

    def __init__(
        self,
        file: CellFile,
        settings: MonitorSettings,
        arms: Sequence[ArmMemory],
        cell: CellMemory,
        *,
        system: System = LOCAL,
    ) -> None:
        self._cell, self._clock = cell, system.clock
        names = (cell.name, *(memory.name for memory in arms))
        self.process: Process = system.spawn(main, file, settings, names, system.pid, name="supervisor")

    def wait_until_ready(self, within_s: float) -> None:
        """Wait until it receives the states of both arms.

        Raises:
            LinkError: It received none in time. Its process was ended.
        """
        end = self._clock.now_s() + within_s
        while not self._cell.ready:
            if not self.process.is_alive or self._clock.now_s() > end:
                self.process.kill()
                raise LinkError(
                    self._cell.fault or f"the supervisor received no state of both arms within {within_s:g} s"
                )
            self._clock.sleep(0.005)


def latch(file: CellFile, reason: str, system: System) -> None:
    """Latch a stop, or log that it cannot be: the lock keeps its note of moving arms then."""
    try:
        Latch(file, system).set(reason)
    except (OSError, SettingsError) as error:
        log.error("the stop of both arms cannot be latched: %s", error)


def main(
    file: CellFile, settings: MonitorSettings, names: tuple[str, ...], parent: int, *, system: System = LOCAL
) -> None:
    """Run the process of the supervisor."""
    cell, arms = CellMemory(names[0]), [ArmMemory(name) for name in names[1:]]
    try:
        system.dedicate(file.rt_priority)
        Supervisor(file, settings, arms, cell, parent, system=system).run()
    except Exception as error:  # of any kind: nothing moves without a supervisor
        cell.enter_fault(f"the supervisor failed: {type(error).__name__}: {error}")
        if cell.begin_s:
            latch(file, cell.fault, system)
