"""Live view of one arm from threads: state, program and gripper. It only reads, and does not reconnect."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.cell_file.tables import ArmEntry, RobotiqSocket
from dual_ur10.sim2real.peripherals.gripper_link import GripperReading, RobotiqLink
from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from ur_core.links.dashboard_link import DashboardLink
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.system import LOCAL, Event, System
from ur_core.tools.tool import tool_named
from ur_core.types import Closing

log = logging.getLogger(__name__)

ANALOG_OUTPUTS: Final = ("standard_analog_output0", "standard_analog_output1")

STALE_S: Final = 0.5
"""Longest time for which an arm's time may stall."""

_RATE_HZ: Final = 25.0
_POLL_S: Final = 0.05
_PROGRAM_S: Final = 0.5  # between questions to the dashboard
_GRIPPER_S: Final = 0.1


class StatusView(Closing):
    """Newest readings of an arm. Threads replace each attribute as a whole.

    Args:
        name: "left" or "right".
        arm: Entry of the cell file.
        system: Clock, network and threads.

    Attributes:
        values: Newest state by RTDE's names.
        status: The same as an `ArmStatus`, or None.
        version: Version of the controller's software, or "".
        dead: Reason why the state is not current, or "".
        program: State and name of the program, as the dashboard reports them.
        program_fault: Reason why they are unknown, or "".
        gripper: Newest reading of the gripper, or None.
        gripper_fault: Reason why there is none, or "".
    """

    def __init__(self, name: str, arm: ArmEntry, *, system: System = LOCAL) -> None:
        self.name, self.arm, self._system = name, arm, system
        self.values: Mapping[str, Any] = {}
        self.status: ArmStatus | None = None
        self.version = self.dead = self.program = self.program_fault = self.gripper_fault = ""
        self.gripper: GripperReading | None = None
        self._ended = system.event()
        parts = [_Part(self._watch_state, "dead"), _Part(self._watch_program, "program_fault")]
        if isinstance(arm.gripper, RobotiqSocket):
            gripper = arm.gripper
            parts.append(_Part(lambda ready: self._watch_gripper(gripper, ready), "gripper_fault"))
        self._ready = [system.event() for _ in parts]
        self._threads = [
            system.thread(functools.partial(self._run, part, ready), f"{name} {part.fault}")
            for part, ready in zip(parts, self._ready, strict=True)
        ]

    def _run(self, part: _Part, ready: Event) -> None:
        """Run one part until it fails; the others go on."""
        try:
            part.run(ready)
        except DualUR10Error as error:
            setattr(self, part.fault, str(error))
        except Exception as error:  # of any kind: the operator must see it
            log.exception("%s: a part of the status view has ended", self.name)
            setattr(self, part.fault, f"{type(error).__name__}: {error}")
        ready.set()

    def _watch_state(self, ready: Event) -> None:
        optional = (*OPTIONAL_VARIABLES, *ANALOG_OUTPUTS)
        with RtdeLink(
            self.arm.host, STATUS_VARIABLES, _RATE_HZ, optional=optional, name=self.name, system=self._system
        ) as link:
            self.version = ".".join(map(str, link.version))
            while not self._ended.wait(_POLL_S):
                if samples := link.poll():
                    self.values = samples[-1].values
                    self.status = ArmStatus.from_sample(samples[-1])
                    ready.set()
                if (
                    link.age_s(self._system.clock.now_s()) > STALE_S
                ):  # the connection stands, so the state may come back
                    self.dead = f"{link.where}: its time stalls; check controller and network"
                    ready.set()
                else:
                    self.dead = ""

    def _watch_program(self, ready: Event) -> None:
        with DashboardLink(self.arm.host, name=self.name, system=self._system) as link:
            while True:
                self.program = link.program_state()
                ready.set()
                if self._ended.wait(_PROGRAM_S):
                    return

    def _watch_gripper(self, gripper: RobotiqSocket, ready: Event) -> None:
        tool = tool_named(gripper.tool)
        with RobotiqLink(self.arm.host, gripper.port, name=self.name, system=self._system, tool=tool) as link:
            while True:
                self.gripper = link.read()
                ready.set()
                if self._ended.wait(_GRIPPER_S):
                    return

    def wait(self, within_s: float) -> None:
        """Wait until each part has a first reading or a fault."""
        end_s = self._system.clock.now_s() + within_s
        for ready in self._ready:
            ready.wait(max(0.0, end_s - self._system.clock.now_s()))

    def close(self) -> None:
        """End all connections. May be called twice."""
        self._ended.set()
        for thread in self._threads:
            thread.join()


class _Part(NamedTuple):
    """Loop of one thread, and the attribute for its fault."""

    run: Callable[[Event], None]
    fault: str
