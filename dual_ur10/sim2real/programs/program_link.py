"""Connections to a controller that runs a program of `stream_script`, and the stop of such programs.

A program needs no supervisor: it stops its arm by itself if this program or the link falls silent. What is left to this
program is to stop the other arm.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import numpy as np

from dual_ur10.errors import CellFaulted, DualUR10Error, LinkError, StartError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import ArmEntry
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm, prompt_for
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.programs.stream_script import (
    INPUTS,
    NOMINAL_RATE,
    NUMBER,
    OUTPUTS,
    STATE,
    TOKEN,
    ProgramCommand,
    State,
)
from dual_ur10.sim2real.runtime.latch import Claim
from dual_ur10.sim2real.runtime.runner import check
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus, stop_reason
from ur_core.links.dashboard_link import DashboardLink
from ur_core.links.link_socket import LinkSocket
from ur_core.links.rtde_link import PORT, RtdeClient, RtdeLink
from ur_core.processes.clock import Clock
from ur_core.processes.system import System
from ur_core.protocol.modes import RuntimeState
from ur_core.protocol.rtde import Kind, frame
from ur_core.types import Array, Closing

CONNECT_S: Final = 6.0
"""Time limit of each connection with its requests, on a slow link."""

_SCRIPT_PORT: Final = 30003
_READY_S: Final = 5.0
_STOP_S: Final = 2.0
_SEND_S: Final = 0.1
_POLL_S: Final = 0.01
_ROUND_TRIPS: Final = 5


class MotionObserver(Protocol):
    """Keeper of what arms did, such as a black box. Its methods do not wait while the arms move."""

    def state(self, arm: int, status: ArmStatus) -> None:
        """Take a state of an arm."""

    def sent(self, arm: int, number: int, q_rad: Array) -> None:
        """Take a point, (6,), that is sent to an arm now."""

    def stopped(self, reason: str) -> None:
        """Take the reason of a latched stop, once the arms rest or stop by themselves."""


class ProgramLink(Closing):
    """Connections to one controller, and the program that runs on it.

    Args:
        name: Name of the arm.
        entry: The arm in the cell file.
        rate_hz: Rate of its states.
        most_s: Longest round trip.
        observer: Keeper of states and points; None: nobody keeps them.
        system: Clock and network.

    Attributes:
        link: RTDE link with its states and the output registers of the program.
        dashboard: Its dashboard.
        values: Input registers by meaning, but those of a point.
        point: (12,) positions and speeds of a point.
        token: Number of the program.
        late_s: Times by which it was late, kept by the sender of points.

    Raises:
        StartError: The link is too slow.
        LinkError: It cannot be reached, or another program holds the registers.
    """

    def __init__(
        self, name: str, entry: ArmEntry, rate_hz: float, most_s: float, observer: MotionObserver | None, system: System
    ) -> None:
        self.name, self._clock, self._system, self._host = name, system.clock, system, entry.host
        self._number, self._observer = ARMS.index(name), observer
        self.values: dict[str, float] = {
            "command": 0,
            "number": 0,
            "last": 0,
            "rate": NOMINAL_RATE,
            "shift": 0.0,
            "time": 0.0,
        }
        self.point: Array = np.zeros(12)
        self.token = 0
        self.late_s: list[float] = []
        self._open: list[Closing] = []
        deadline_s = self._clock.now_s() + CONNECT_S
        with self.closed_on_error():
            self.link = RtdeLink(
                entry.host,
                (*STATUS_VARIABLES, *OUTPUTS),
                rate_hz,
                timeout_s=CONNECT_S,
                optional=OPTIONAL_VARIABLES,
                name=name,
                system=system,
            )
            self._open.append(self.link)
            inputs = RtdeClient(name, entry.host, PORT, deadline_s, system=system)
            self._inputs = inputs.socket
            self._open.append(self._inputs)
            trip_s = max(inputs.round_trips_s(_ROUND_TRIPS, deadline_s))
            if trip_s > most_s:
                raise StartError(
                    f"{name}: a round trip took {1e3 * trip_s:.0f} ms, allowed at this rate are {1e3 * most_s:.0f} ms: "
                    "lower the rate, or use a faster link"
                )
            self._recipe, types = inputs.set_up(Kind.SETUP_INPUTS, INPUTS, b"", deadline_s)
            if not self._recipe or {"IN_USE", "NOT_FOUND"}.intersection(types):
                raise self._inputs.error(
                    f"its registers from {INPUTS[0]} on are in use or do not exist",
                    "end the other program, disable the fieldbus, or update the controller's software",
                )
            self.dashboard = DashboardLink(entry.host, CONNECT_S, name=name, system=system)
            self._open.append(self.dashboard)

    def upload(self, text: str, token: int) -> None:
        """Start a program."""
        self.token = token
        self.values.update(command=ProgramCommand.WAIT, number=0, shift=0.0, rate=NOMINAL_RATE)
        self.late_s.clear()
        self.send()
        deadline_s = self._clock.now_s() + CONNECT_S
        with LinkSocket(self.name, "script", self._host, _SCRIPT_PORT, deadline_s, system=self._system) as script:
            script.send(text.encode("ascii"), deadline_s)
            self.wait(lambda state, number: state == State.WAITING, "to start its program")

    def wait(self, reached: Callable[[int, int], bool], what: str) -> None:
        """Wait for a state of the program and its number of accepted points.

        Raises:
            StartError: It does not come in time.
        """
        end_s = self._clock.now_s() + _READY_S
        while True:
            self.poll()
            values: Any = None if self.link.latest is None else self.link.latest.values
            if values is not None and values[TOKEN] == self.token and reached(values[STATE], values[NUMBER]):
                return
            if self._clock.now_s() > end_s:
                raise StartError(f"{self.name}: its controller had {_READY_S:g} s {what}, and did not: see its log")
            self._clock.wait((self.link.fileno(), self._inputs.fileno()), end_s)

    def poll(self) -> None:
        """Read what has arrived.

        Raises:
            LinkError: A connection was lost.
        """
        for sample in self.link.poll():
            if self._observer is not None:
                self._observer.state(self._number, ArmStatus.from_sample(sample))
        if self._inputs.receive_now() == b"":
            raise self._inputs.ended()

    def next_status(self) -> ArmStatus:
        """Return the next status that arrives.

        Raises:
            LinkError: None comes in time, or a connection was lost.
        """
        count, end_s = self.link.count, self._clock.now_s() + _READY_S
        while self.link.count <= count or self.link.latest is None:
            if self._clock.now_s() > end_s:
                raise LinkError(f"{self.name}: its controller sends no state: check the link")
            self._clock.wait((self.link.fileno(),), end_s)
            self.poll()
        return ArmStatus.from_sample(self.link.latest)

    def send(self) -> None:
        """Write all registers."""
        values = self.values
        whole = (int(values["command"]), int(values["number"]), int(values["last"]), self.token)
        payload = struct.pack(
            ">B4i15d", self._recipe, *whole, *self.point, values["time"], values["rate"], values["shift"]
        )
        self._inputs.send(frame(Kind.DATA_PACKAGE, payload), self._clock.now_s() + _SEND_S)

    def put(self, number: int, q_rad: Array, qd_rad_s: Array, time_s: float) -> None:
        """Send a point."""
        if self._observer is not None:
            self._observer.sent(self._number, number, q_rad)
        self.values.update(number=number, time=time_s)
        self.point = np.concatenate([q_rad, qd_rad_s])
        self.send()

    def close(self) -> None:
        """Close all connections. May be called twice."""
        for each in self._open:
            each.close()


class ProgrammedArms(Closing):
    """Both arms of a cell, for programs of ours on their controllers. Construction moves nothing.

    Args:
        file: Cell file.
        rate_hz: Rate of the states of both.
        most_s: Longest round trip.
        confirm: Called with a description before the arms move; None: real arms need a yes at the terminal, emulated
            ones none.
        observer: Keeper of states and points, such as `dual_ur10.sim2real.programs.program_box.ProgramBox`.
        system: Clock, network and state folder.

    Raises:
        CellFaulted: A latched stop was not cleared.
        CellBusyError: Another program moves one of the arms.
        StartError: A controller is not ready, or a link is too slow.
        LinkError: A controller cannot be reached.
    """

    def __init__(
        self,
        file: CellFile,
        rate_hz: float,
        most_s: float,
        *,
        confirm: Confirm | None,
        observer: MotionObserver | None,
        system: System,
    ) -> None:
        self._file, self._clock, self._confirm = file, system.clock, prompt_for(file, confirm)
        self._observer = observer
        config = file.config()
        self._clearance = Clearance(
            config.measured_scene, minimum_m=config.minimum_clearance_m, uncertainty=config.uncertainty
        )
        self._arms: list[ProgramLink] = []
        self._claim = Claim(file, system)
        with self.closed_on_error():
            check(file, system, timeout_s=CONNECT_S, streams=False)
            for name, entry in zip(ARMS, file.arms, strict=True):
                self._arms.append(ProgramLink(name, entry, rate_hz, most_s, observer, system))

    def _measured(self, refusal: Callable[[ArmStatus], str | None] = lambda status: None) -> Array:
        """Return the measured joint positions, (2, 6).

        Args:
            refusal: Function that returns a further reason why an arm must not begin.

        Raises:
            StartError: An arm is not ready, or moves.
        """
        found = []
        for arm in self._arms:
            status = arm.next_status()
            reason = stop_reason(status, playing=False) or refusal(status)
            if reason is None and not max(map(abs, status.qd_rad_s)) < REST_RAD_S:
                reason = "it moves: wait until it rests"
            if reason is not None:
                raise StartError(f"{arm.name} cannot begin: {reason}")
            found.append(status.q_rad)
        return np.array(found)

    def _stop(self, arms: Sequence[ProgramLink]) -> tuple[str, ...]:
        """Stop the programs of arms, and return the names of those that did not report their end."""
        unseen = stop_programs(arms, self._clock)
        self._claim.note_stopped(not unseen)
        return unseen

    def _latched(self, error: BaseException) -> CellFaulted:
        """Latch the stop that an error was the reason of, and return the exception that reports it."""
        reason = str(error) if isinstance(error, DualUR10Error) else f"the sending program ended: {error!r}"
        self._claim.latch_stop(reason)
        if self._observer is not None:
            self._observer.stopped(reason)
        return CellFaulted(
            f"both arms were stopped: {reason}. Check both, correct the cause, then {self._file.clearing}"
        )

    def close(self) -> None:
        """Release both controllers. May be called twice."""
        for arm in self._arms:
            arm.close()
        self._claim.release()


def check_ended(unseen: Sequence[str]) -> None:
    """Check the result of `stop_programs`.

    Raises:
        LinkError: An arm did not report the end of its program.
    """
    if unseen:
        raise LinkError(f"{' and '.join(unseen)}: it did not report the end of its program, and may still move")


def stop_programs(arms: Sequence[ProgramLink], clock: Clock) -> tuple[str, ...]:
    """Stop the programs of arms: by a register, and by the dashboard where one does not end soon.

    Returns:
        Names of the arms that did not report that their program has ended.
    """
    pending, mute = [], []
    for arm in arms:
        try:
            arm.values["command"] = ProgramCommand.STOP
            arm.send()
            pending.append(arm)
        except DualUR10Error:
            mute.append(arm)
    unseen = [_halt(arm) for arm in mute]  # a silent dashboard must not delay the other arm
    end_s = clock.now_s() + _STOP_S
    while pending:
        for arm in list(pending):
            try:
                arm.poll()
                sample = arm.link.latest
                values: Any = {} if sample is None else sample.values
                status = None if sample is None else ArmStatus.from_sample(sample)
                final = values.get(TOKEN) != arm.token or values.get(STATE, 0) >= State.FINISHED
                if status is not None and final and status.runtime_state == RuntimeState.STOPPED:
                    pending.remove(arm)
                elif clock.now_s() > end_s:
                    raise LinkError("its program does not end")
            except DualUR10Error:
                pending.remove(arm)
                unseen.append(_halt(arm))
        clock.sleep(_POLL_S)
    return tuple(unseen)


def _halt(arm: ProgramLink) -> str:
    """Have the dashboard stop the program. If that fails, the program ends by itself, as nothing more comes.

    Returns:
        Name of the arm: nothing shows that its program has ended.
    """
    with contextlib.suppress(DualUR10Error):
        arm.dashboard.stop()
    return arm.name
