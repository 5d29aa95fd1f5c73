"""The process that watches both arms by connections of its own, and stops both for good when anything is wrong.

It commands nothing but a stop. It does not need the processes of the arms, which may hang, nor `ur_rtde`: it reads the
state of both controllers itself, and where an arm's process does not end its program, it ends that process and asks the
dashboard to.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import select
import time
from collections.abc import Sequence
from typing import Final

from dual_ur10.errors import LinkError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.control.time_scaling import scaling_from_slider
from dual_ur10.sim2real.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from dual_ur10.sim2real.links.rtde_link import RtdeLink
from dual_ur10.sim2real.processes.child_process import Child, hasten
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, root_cause
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.latch import Latch
from dual_ur10.sim2real.runtime.safety_monitor import MonitorSettings, SafetyMonitor
from dual_ur10.sim2real.runtime.stop_enforcer import StopEnforcer

log = logging.getLogger(__name__)

_AHEAD_S: Final = 0.024  # from which on a new scaling holds


class Supervisor:
    """The loop of the supervisor's process.

    Args:
        file: The cell.
        settings: What is watched.
        arms: Memories of both arms' processes.
        cell: Memory of all.
        parent: Process that the policy runs in.
    """

    def __init__(
        self, file: CellFile, settings: MonitorSettings, arms: Sequence[ArmMemory], cell: CellMemory, parent: int
    ) -> None:
        self._file, self._settings, self._arms, self._cell, self._parent = file, settings, arms, cell, parent
        self._monitor = SafetyMonitor(settings, arms, cell)
        self._links: list[RtdeLink] = []
        self._made = False

    def run(self) -> None:
        """Watch until the program ends or both arms have been stopped."""
        for name, arm in zip(ARMS, self._file.arms, strict=True):
            self._links.append(RtdeLink(arm.host, STATUS_VARIABLES, optional=OPTIONAL_VARIABLES, name=name))
        self._second = StopEnforcer(self._arms, [arm.host for arm in self._file.arms])
        self._cell.enter_ready()
        reason = None
        while reason is None:
            now = time.monotonic()
            self._cell.note_supervisor(now)
            if self._cell.ending:
                return self._end()
            self._made = self._made or all(each.phase in (Phase.READY, Phase.STREAMING) for each in self._arms)
            if os.getppid() != self._parent:
                if not self._monitor.moving:
                    return None  # nothing has moved
                reason = "the program that gives targets has ended"
            reason = reason or self._cell.fault or self._look(now) or self._monitor.processes(now)
            if reason and self._cell.ending:
                return self._end()
        return self._stop(reason)

    def _look(self, now: float) -> str | None:
        """Take in what both controllers tell, for at most a control period."""
        links = [each.fileno() for each in self._links]
        ready, _, _ = select.select([*links, *self._second.files], [], [], self._settings.tick_s)
        try:
            self._second.check()
        except LinkError as error:
            return f"the second way to stop is lost: {error}"
        for arm, link in enumerate(self._links):
            if link.fileno() not in ready and link.age_s(now) < STALE_S:
                continue
            try:
                for sample in link.poll():
                    reason = self._monitor.state(arm, ArmStatus.from_sample(sample))
                    if reason is not None:
                        return reason
            except LinkError as error:
                return f"{ARMS[arm]}: {error}"
            age = link.age_s(time.monotonic())
            if age > STALE_S:
                return f"{ARMS[arm]}: the controller's time has stood still for {1e3 * age:.0f} ms"
        return self._monitor.together() or self._follow_speed_sliders()

    def _follow_speed_sliders(self) -> str | None:
        """Slow both arms down alike, as the slower one's speed slider says. Returns why that was not possible."""
        cell = self._cell
        if not cell.begin_s or time.monotonic() < cell.begin_s:
            return None
        goal = scaling_from_slider(self._monitor.slowest) * self._file.speed_factor
        scaling = cell.time_scaling
        if goal == scaling.goal:
            return None
        tick_s = self._settings.tick_s
        at_s = time.monotonic() - cell.begin_s + _AHEAD_S
        period = max(float(int(at_s / tick_s)), scaling.period)
        cell.set_time_scaling(scaling.towards(goal, period, tick_s, self._file.speed_factor))
        if (time.monotonic() - cell.begin_s) / tick_s > period:  # an arm may have been sent what now is another time's
            return "the supervisor stood still while it changed the scaling of both arms: this machine is too busy"
        log.warning("both arms go on at %.0f %% of their speed", 100 * goal)
        return None

    def _end(self) -> None:
        """Both arms are asked to stop because the program ends: see that they do."""
        if not self._cell.begin_s:
            return  # nothing has moved
        self._second.begin()
        self._see_it_done()
        failed = [memory.text for memory in self._arms if memory.phase == Phase.FAULTED] + self._second.unended
        if failed:
            Latch(self._file).set(self._cell.fault or root_cause(failed))
        self._second.close()

    def _stop(self, reason: str) -> None:
        """Stop both arms, and note why where it stays."""
        self._cell.enter_fault(reason)
        reason = self._cell.fault  # somebody else may have been first, and this what came of it
        for memory in self._arms:
            memory.stop()
        self._second.begin()
        self._see_it_done(STALE_S)  # a disk may be slow, and what hangs must be ended all the same
        try:
            if self._made or self._cell.begin_s:  # else it is a start that failed, which whoever started it is told
                Latch(self._file).set(reason)
        finally:
            self._see_it_done()
            self._second.close()
            log.error("both arms were stopped: %s", reason)

    def _see_it_done(self, within_s: float = math.inf) -> None:
        """Wait for both programs to end, and end what does not."""
        while self._second.look(self._monitor.ended) <= within_s and self._second.waits:
            self._cell.note_supervisor(time.monotonic())
            time.sleep(self._settings.tick_s / 4)
            for arm, link in enumerate(self._links):
                with contextlib.suppress(LinkError):  # what is not told counts as running
                    for sample in link.poll():
                        self._monitor.note(arm, ArmStatus.from_sample(sample))


class SupervisorProcess:
    """Starts the supervisor, and ends it.

    Args:
        file: The cell.
        settings: What is watched.
        arms: Memories of both arms' processes.
        cell: Memory of all.
    """

    def __init__(self, file: CellFile, settings: MonitorSettings, arms: Sequence[ArmMemory], cell: CellMemory) -> None:
        self._cell = cell
        names = (cell.name, *(memory.name for memory in arms))
        self.process = Child(main, file, settings, names, os.getpid(), name="supervisor")

    def wait_until_ready(self, within_s: float) -> None:
        """Wait until it sees both arms.

        Raises:
            LinkError: It does not, within the time. Its process has ended.
        """
        end = time.monotonic() + within_s
        while not self._cell.ready:
            if not self.process.is_alive or time.monotonic() > end:
                self.kill()
                raise LinkError(self._cell.fault or f"the supervisor does not see both arms within {within_s:g} s")
            time.sleep(0.005)

    def wait(self, within_s: float) -> bool:
        """Wait for the end of the process. Returns whether it has come."""
        return self.process.wait(within_s)

    def kill(self) -> None:
        """End the process at once."""
        self.process.kill()


def main(file: CellFile, settings: MonitorSettings, names: tuple[str, ...], parent: int) -> None:
    """Run in the process of the supervisor."""
    cell, arms = CellMemory(names[0]), [ArmMemory(name) for name in names[1:]]
    try:
        # What stands now stays: the collector need not look at it again.
        gc.collect()
        gc.freeze()
        hasten(file.rt_priority)
        Supervisor(file, settings, arms, cell, parent).run()
    except Exception as error:  # whatever it is: without a supervisor nothing moves
        cell.enter_fault(f"the supervisor failed: {type(error).__name__}: {error}")
        if cell.begin_s:
            Latch(file).set(cell.fault)
