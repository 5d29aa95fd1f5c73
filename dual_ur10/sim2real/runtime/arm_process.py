"""The process of one arm: it owns the connections to its controller, and nothing else does.

Constructors of `ur_rtde` hold Python's global lock while they wait, and it may block for seconds. None of that must
reach the other arm. Nor may it connect again when it has lost the controller: it would start its script there anew.
"""

from __future__ import annotations

import gc
import os
import resource
import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from dual_ur10.errors import DualUR10Error, LinkError, MissingExtraError, SettingsError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.control.servoj import ServojProfile
from dual_ur10.sim2real.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES
from dual_ur10.sim2real.links.rtde_link import PORT, RtdeClient, RtdeLink
from dual_ur10.sim2real.processes.child_process import Child, hasten
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import ArmSender
from dual_ur10.sim2real.runtime.cell_memory import CellMemory

WATCHDOG_HZ: Final = 10.0
"""How often the controller must hear of us, or it ends the program. Armed before anything moves."""

CONNECT_S: Final = 10.0

_MOST_PRIORITY: Final = 90
_ROUND_TRIPS: Final = 20
_STANDARD: Final = 3  # files that every process has

_KEPT: Final[list[Any]] = []
"""Interfaces of ur_rtde, which are never destroyed: that waits for a controller, for ever if it is lost."""


@dataclass(frozen=True)
class ArmConnection:
    """How to reach an arm, and how to move it.

    Attributes:
        name: "left" or "right".
        host: Address of its controller.
        servoj: Settings of `servoj`.
        rt_priority: Of its process among those that run in real time; 0: it does not.
    """

    name: str
    host: str
    servoj: ServojProfile
    rt_priority: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.rt_priority <= _MOST_PRIORITY:
            raise SettingsError(f"rt_priority is {self.rt_priority!r}: allowed are 0 to {_MOST_PRIORITY}")


class ArmProcess:
    """Starts the process of an arm, and ends it.

    Args:
        connection: The arm.
        memory: Shared with it.
        cell: Shared by all processes of the cell.
        others: Memories of the other arms.
        watched: Whether there is a supervisor that must live.
    """

    def __init__(
        self,
        connection: ArmConnection,
        memory: ArmMemory,
        cell: CellMemory,
        others: tuple[ArmMemory, ...] = (),
        *,
        watched: bool = True,
    ) -> None:
        self.connection, self.memory = connection, memory
        names = (memory.name, cell.name, *(other.name for other in others))
        self.process = Child(main, connection, names, os.getpid(), watched, name=connection.name)

    def wait_until_ready(self, within_s: float = CONNECT_S) -> None:
        """Wait until the arm would take targets.

        Raises:
            LinkError: It does not, within the time. Its process has ended.
        """
        end = time.monotonic() + within_s
        while time.monotonic() < end and self.process.is_alive:
            if self.memory.phase >= Phase.READY:
                break
            time.sleep(0.005)
        if self.memory.phase == Phase.READY:
            return
        text = (
            self.memory.text or f"{self.connection.name}: no connection to {self.connection.host} within {within_s:g} s"
        )
        self.kill()
        raise LinkError(text)

    def wait(self, within_s: float) -> bool:
        """Wait for the end of the process. Returns whether it has come."""
        return self.process.wait(within_s)

    def kill(self) -> None:
        """End the process at once. The arm is stopped by the watchdog in its controller."""
        self.process.kill()


def main(connection: ArmConnection, names: tuple[str, ...], parent: int, watched: bool) -> None:
    """Run in the process of an arm."""
    memory, cell, others = ArmMemory(names[0]), CellMemory(names[1]), [ArmMemory(name) for name in names[2:]]
    memory.note_process(os.getpid())
    try:
        round_trip_s = _round_trip_s(connection)
        link = RtdeLink(connection.host, STATUS_VARIABLES, optional=OPTIONAL_VARIABLES, name=connection.name)
        _settle()
        hasten(connection.rt_priority)
        control = _control(connection)  # from here on the watchdog wants to be fed
        _KEPT.append(control)
        bar_connections()
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
            watched=watched,
            leader=others[0] if others and name != ARMS[0] else None,
            round_trip_s=round_trip_s,
        ).run()
    except DualUR10Error as error:
        memory.enter(Phase.FAULTED, f"{connection.name}: {error}")
    except Exception as error:  # whatever it is, the other arm and the program must hear of it
        memory.enter(Phase.FAULTED, f"{connection.name}: {type(error).__name__}: {error}")
    # At once: what ur_rtde has lost, it tries to reach again, and starts its script there anew.
    os._exit(0)


def _round_trip_s(connection: ArmConnection) -> float:
    """How long the quickest answers of the controller take: its clock is known by the quickest packets, too."""
    deadline_s = time.monotonic() + CONNECT_S
    client = RtdeClient(connection.name, connection.host, PORT, deadline_s)
    try:
        return min(client.round_trips_s(_ROUND_TRIPS, deadline_s))
    finally:
        client.socket.close_and_wait(deadline_s)


def _control(connection: ArmConnection) -> Any:
    """`ur_rtde`'s control interface, with its watchdog armed.

    Raises:
        LinkError: The controller does not let it in.
    """
    try:
        from rtde_control import RTDEControlInterface
    except ImportError:
        raise MissingExtraError("ur_rtde", "real", "moving UR arms") from None
    try:
        control = RTDEControlInterface(connection.host)
    except RuntimeError as error:
        raise LinkError(f"{connection.host} takes no control script: {error}") from error
    if not control.setWatchdog(WATCHDOG_HZ):
        control.stopScript()
        raise LinkError(f"{connection.host} did not take the watchdog: nothing is moved without")
    return control


def bar_connections() -> None:
    """From here on this process opens no file and no connection.

    `ur_rtde` reconnects by itself when it loses a controller, at any time and in a thread of its own, starts its script
    there anew and sends the last command again, without a watchdog. No setting keeps it from that, but the operating
    system does: the numbers of standard input, output and errors are taken, and no higher ones are given.
    """
    number = 0
    while number < _STANDARD:  # some programs are started without them
        number = os.open(os.devnull, os.O_RDWR)
    os.close(number)
    resource.setrlimit(resource.RLIMIT_NOFILE, (_STANDARD, _STANDARD))


def _settle() -> None:
    """What stands now stays: no collector is to look at it, and no arithmetic to warn of it, between two targets."""
    gc.collect()
    gc.freeze()
    gc.disable()
    np.seterr(all="ignore")
