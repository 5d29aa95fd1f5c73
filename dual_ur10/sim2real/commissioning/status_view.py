"""Looks at one arm from a thread: state, program and gripper. It reads only, and does not connect again by itself."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from dual_ur10.errors import DualUR10Error
from dual_ur10.sim2real.config.cell_file_entries import ArmEntry, RobotiqSocket
from dual_ur10.sim2real.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from dual_ur10.sim2real.links.dashboard_link import DashboardLink
from dual_ur10.sim2real.links.rtde_link import RtdeLink
from dual_ur10.sim2real.peripherals.gripper_link import GripperReading, RobotiqLink

log = logging.getLogger(__name__)

ANALOG_OUTPUTS: Final = ("standard_analog_output0", "standard_analog_output1")

STALE_S: Final = 0.5
"""An arm whose time stands still for so long is dead."""

_RATE_HZ: Final = 25.0
_POLL_S: Final = 0.05
_SLOW_S: Final = 0.5  # between questions to the dashboard
_GRIPPER_S: Final = 0.1


class StatusView:
    """What is known of an arm. Attributes are replaced by threads, each as a whole.

    Args:
        name: "left" or "right".
        arm: Of the cell file.

    Attributes:
        values: What was read of its state last, by RTDE's names.
        status: The same, or None.
        version: Of the controller's software, or "".
        dead: Why nothing new is known of its state, or "".
        program: State and name of the program, as the dashboard says.
        program_fault: Why it does not, or "".
        gripper: What the gripper tells, or None.
        gripper_fault: Why it tells nothing, or "".
    """

    def __init__(self, name: str, arm: ArmEntry) -> None:
        self.name, self.arm = name, arm
        self.values: Mapping[str, Any] = {}
        self.status: ArmStatus | None = None
        self.version = self.dead = self.program = self.program_fault = self.gripper_fault = ""
        self.gripper: GripperReading | None = None
        self._ended = threading.Event()
        self._parts = [
            _Part(self._state, "dead", threading.Event()),
            _Part(self._program, "program_fault", threading.Event()),
        ]
        if isinstance(arm.gripper, RobotiqSocket):
            self._parts.append(_Part(self._gripper, "gripper_fault", threading.Event()))
        self._threads = [threading.Thread(target=self._run, args=(each,), daemon=True) for each in self._parts]
        for each in self._threads:
            each.start()

    def _run(self, part: _Part) -> None:
        """One part, until it is lost: the others go on."""
        try:
            part.run(part.told)
        except DualUR10Error as error:
            setattr(self, part.fault, str(error))
        except Exception as error:  # whatever it is, it is to be seen
            log.exception("%s: a part of what is shown has ended", self.name)
            setattr(self, part.fault, f"{type(error).__name__}: {error}")
        part.told.set()

    def _state(self, told: threading.Event) -> None:
        optional = (*OPTIONAL_VARIABLES, *ANALOG_OUTPUTS)
        with RtdeLink(self.arm.host, STATUS_VARIABLES, _RATE_HZ, optional=optional, name=self.name) as link:
            self.version = ".".join(map(str, link.version))
            while not self._ended.wait(_POLL_S):
                if samples := link.poll():
                    self.values = samples[-1].values
                    self.status = ArmStatus.from_sample(samples[-1])
                    told.set()
                age_s = link.age_s(time.monotonic())
                if age_s > STALE_S:  # the connection stands, so it may go on
                    self.dead = f"{link.where}: its time stands still; check controller and network"
                    told.set()
                else:
                    self.dead = ""

    def _program(self, told: threading.Event) -> None:
        with DashboardLink(self.arm.host, name=self.name) as link:
            while True:
                self.program = link.program_state()
                told.set()
                if self._ended.wait(_SLOW_S):
                    return

    def _gripper(self, told: threading.Event) -> None:
        port = self.arm.gripper.port if isinstance(self.arm.gripper, RobotiqSocket) else 0
        link = RobotiqLink(self.arm.host, port, name=self.name)
        try:
            while True:
                self.gripper = link.read()
                told.set()
                if self._ended.wait(_GRIPPER_S):
                    return
        finally:
            link.close()

    def wait(self, within_s: float) -> None:
        """Wait until each part has told something, or why it cannot."""
        end_s = time.monotonic() + within_s
        for part in self._parts:
            part.told.wait(max(0.0, end_s - time.monotonic()))

    def close(self) -> None:
        """End all connections. May be called twice."""
        self._ended.set()
        for each in self._threads:
            each.join()


class _Part(NamedTuple):
    """What one thread looks at."""

    run: Callable[[threading.Event], None]
    fault: str  # attribute of why it does not tell
    told: threading.Event
