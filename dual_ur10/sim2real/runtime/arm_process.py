"""Process of one arm, the only owner of the connections to its controller.

`ur_rtde` may block for seconds and holds Python's global lock in its constructors. None of that must affect the other
arm. Nor may it reconnect to a lost controller: it would restart its script there.
"""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from dual_ur10.errors import DualUR10Error, LinkError, MissingExtraError, SettingsError
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import ArmSender
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES
from ur_core.links.rtde_link import PORT, RtdeClient, RtdeLink
from ur_core.processes.child_process import patient_threads
from ur_core.processes.system import LOCAL, Process, System
from ur_core.servoj import ServojProfile

log = logging.getLogger(__name__)

WATCHDOG_HZ: Final = 10.0
"""Smallest rate of packets before the controller ends the program. Armed before anything moves."""

CONNECT_S: Final = 10.0

_RECEIVES_S: Final = 0.001
"""Longest delay of `ur_rtde`'s thread that receives states. It asks for them every 0.1 ms: with 4,500 wake-ups a second
the threads of two arms took a fifth of a core. A command learns from them only that the script has begun or ended."""

_MOST_PRIORITY: Final = 90
_ROUND_TRIPS: Final = 20

_KEPT: Final[list[Any]] = []
"""Interfaces of ur_rtde. They are never destroyed: that would wait for a controller, for ever if it is lost."""


@dataclass(frozen=True)
class ArmConnection:
    """Address and servoj settings of an arm.

    Attributes:
        name: "left" or "right".
        host: Address of its controller.
        servoj: Settings of `servoj`.
        robot: Model of the arm.
        rt_priority: Real-time priority of its process; 0: none.
        emulated: The controller is emulated: it runs on this machine.
    """

    name: str
    host: str
    servoj: ServojProfile
    robot: str
    rt_priority: int = 0
    emulated: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.rt_priority <= _MOST_PRIORITY:
            raise SettingsError(f"rt_priority is {self.rt_priority!r}: allowed are 0 to {_MOST_PRIORITY}")


class ArmProcess:
    """Process of an arm. Once it is killed, the watchdog in the controller stops the arm.

    Args:
        connection: Address and settings of the arm.
        memory: Memory shared with it.
        cell: Memory shared by all processes of the cell.
        others: Memories of the other arms.
        supervised: Require a living supervisor.
        system: Clock and processes.

    Attributes:
        process: The process.
    """

    def __init__(
        self,
        connection: ArmConnection,
        memory: ArmMemory,
        cell: CellMemory,
        others: tuple[ArmMemory, ...] = (),
        *,
        supervised: bool = True,
        system: System = LOCAL,
    ) -> None:
        self.connection, self.memory, self._clock = connection, memory, system.clock
        names = (memory.name, cell.name, *(other.name for other in others))
        name = connection.name
        self.process: Process = system.spawn(
            main, connection, names, system.pid, supervised, name=name, output=UrRtdeOutput(name)
        )

    def wait_until_ready(self, within_s: float = CONNECT_S) -> None:
        """Wait until the arm is ready for targets.

        Raises:
            LinkError: It is not ready in time. Its process was ended.
        """
        end = self._clock.now_s() + within_s
        while self._clock.now_s() < end and self.process.is_alive:
            if self.memory.phase >= Phase.READY:
                break
            self._clock.sleep(0.005)
        if self.memory.phase == Phase.READY:
            return
        found = f"no connection to {self.connection.host} within {within_s:g} s"
        if not self.process.is_alive:
            found = f"its process has ended with code {self.process.code} before it was ready"
        text = self.memory.text or f"{self.connection.name}: {found}"
        self.process.kill()
        raise LinkError(text)


def main(
    connection: ArmConnection, names: tuple[str, ...], parent: int, supervised: bool, *, system: System = LOCAL
) -> None:
    """Run the process of an arm."""
    memory, cell, others = ArmMemory(names[0]), CellMemory(names[1]), [ArmMemory(name) for name in names[2:]]
    memory.note_process(system.pid)
    try:
        round_trip_s = _round_trip_s(connection, system)
        link = RtdeLink(
            connection.host, STATUS_VARIABLES, optional=OPTIONAL_VARIABLES, name=connection.name, system=system
        )
        system.dedicate(connection.rt_priority, collect=False, sends=True)
        control = _control(connection, system.control or _ur_rtde)  # from here on the watchdog must be fed
        # ur_rtde reconnects when it loses a controller, at any time and in a thread of its own, restarts its script
        # there and sends the last command again, without a watchdog. No setting of its own prevents that.
        system.bar_connections()
        name, servoj = connection.name, connection.servoj
        ArmSender(
            name,
            servoj,
            link,
            control,
            memory,
            cell,
            others,
            parent=parent,
            supervised=supervised,
            leader=others[0] if others and name != ARMS[0] else None,
            round_trip_s=round_trip_s,
            robot=connection.robot,
            emulated=connection.emulated,
            system=system,
        ).run()
    except DualUR10Error as error:
        memory.enter(Phase.FAULTED, f"{connection.name}: {error}")
    except Exception as error:  # of any kind: the other arm and the program must learn of it
        memory.enter(Phase.FAULTED, f"{connection.name}: {type(error).__name__}: {error}")
    # At once: ur_rtde reconnects to a lost controller and restarts its script there.
    system.end()


def _round_trip_s(connection: ArmConnection, system: System) -> float:
    """Return the shortest round trip to the controller, whose clock is also estimated by the quickest packets."""
    deadline_s = system.clock.now_s() + CONNECT_S
    client = RtdeClient(connection.name, connection.host, PORT, deadline_s, system=system)
    try:
        return min(client.round_trips_s(_ROUND_TRIPS, deadline_s))
    finally:
        client.socket.close_and_wait(deadline_s)


def _control(connection: ArmConnection, interface: Callable[[str], Any]) -> Any:
    """Return the control interface of a controller with its watchdog armed.

    Raises:
        LinkError: The controller refuses it.
    """
    try:
        control = interface(connection.host)
    except RuntimeError as error:
        raise LinkError(f"{connection.host} takes no control script: {error}") from error
    if not control.setWatchdog(WATCHDOG_HZ):
        control.stopScript()
        raise LinkError(f"{connection.host} did not take the watchdog: nothing is moved without")
    return control


def _ur_rtde(host: str) -> Any:
    """Return `ur_rtde`'s control interface.

    Raises:
        MissingExtraError: `ur_rtde` is not installed.
        RuntimeError: The controller refuses it.
    """
    try:
        from rtde_control import RTDEControlInterface
    except ImportError:
        raise MissingExtraError("ur_rtde", "real", "moving UR arms") from None
    with patient_threads(_RECEIVES_S):
        control = RTDEControlInterface(host)
    _KEPT.append(control)
    return control


_RECONNECTS: Final = "it wanted to connect again, which it must not: its script would restart without a watchdog"

# Prints of rtde_control_interface.cpp, version 1.6.5.
_KNOWN: Final = {
    "RTDEControlInterface: RTDE control script is not running!": "its control script no longer runs",
    "RTDEControlInterface: Robot closed the connection!": "the controller closed its connection",
    "RTDEControlInterface: Could not receive data from robot...": "it receives no data",
    "RTDEControlInterface: Lost connection to robot...": "it has lost the controller",
    "RTDEControlInterface: Robot is disconnected, reconnecting...": _RECONNECTS,
    "Reconnecting...": _RECONNECTS,
}
_DETAIL: Final = "RTDEControlInterface Exception: "
_BARRED: Final = "Too many open files"
_BEFORE_DETAIL: Final = "RTDEControlInterface: Lost connection to robot..."  # the next line is its exception


class UrRtdeOutput:
    """Receiver of the lines that the process of an arm prints. Lines that are not known to be `ur_rtde`'s pass on.

    What `ur_rtde` prints follows from a stop or a lost connection, which the process reports with its reason. So each
    fact is logged once, at level INFO.

    Args:
        arm: Name of the arm.
    """

    def __init__(self, arm: str) -> None:
        self._arm = arm
        self._reported: set[str] = set()
        self._detail_follows = False

    def __call__(self, line: str) -> None:
        """Process a line without its end."""
        detail_follows, self._detail_follows = self._detail_follows, line == _BEFORE_DETAIL
        if line in _KNOWN:
            self._report(_KNOWN[line])
        elif line.startswith(_DETAIL) or detail_follows:
            text = line.removeprefix(_DETAIL)
            self._report(_RECONNECTS if _BARRED in text else text)
        else:
            # There may be no standard error, or nobody who reads it.
            with contextlib.suppress(OSError, ValueError, AttributeError):
                sys.stderr.write(f"{line}\n")
                sys.stderr.flush()

    def _report(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            log.info("%s, ur_rtde: %s", self._arm, text)
