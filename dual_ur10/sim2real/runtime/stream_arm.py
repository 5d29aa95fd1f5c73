"""Connections to one controller that interpolates points, and the stop of both; see `point_stream`."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.errors import DualUR10Error, LinkError, StartError
from dual_ur10.sim2real.config.cell_file_tables import ArmEntry
from dual_ur10.sim2real.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from dual_ur10.sim2real.links.dashboard_link import DashboardLink
from dual_ur10.sim2real.links.link_socket import LinkSocket
from dual_ur10.sim2real.links.rtde_link import PORT, RtdeClient, RtdeLink
from dual_ur10.sim2real.processes.clock import Clock
from dual_ur10.sim2real.processes.system import System
from dual_ur10.sim2real.protocol.modes import RuntimeState
from dual_ur10.sim2real.protocol.rtde import Kind, frame
from dual_ur10.sim2real.runtime.stream_script import INPUTS, NUMBER, OUTPUTS, RATE_BAND, STATE, TOKEN, Command, State
from dual_ur10.types import Array, Closing

CONNECT_S: Final = 6.0
"""Longest time for each connection with its requests, on a slow link."""

READY_S: Final = 5.0
"""Longest time for a program to start, and for a state to arrive."""

PATH_RATE: Final = 1.0 - RATE_BAND / 2
"""Rate of the path time: neither controller is ever faster than what was checked."""

_SCRIPT_PORT: Final = 30003
_STOP_S: Final = 2.0
_SEND_S: Final = 0.1
_POLL_S: Final = 0.01
_ROUND_TRIPS: Final = 5


class StreamArm(Closing):
    """Connections to one controller, and the program that runs on it."""

    def __init__(self, name: str, entry: ArmEntry, rate_hz: float, most_s: float, system: System) -> None:
        self.name, self._clock, self._system, self._host = name, system.clock, system, entry.host
        self.values: dict[str, float] = {
            "command": 0,
            "number": 0,
            "last": 0,
            "rate": PATH_RATE,
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
        self.values.update(command=Command.WAIT, number=0, shift=0.0, rate=PATH_RATE)
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
        end_s = self._clock.now_s() + READY_S
        while True:
            self.poll()
            values: Any = None if self.link.latest is None else self.link.latest.values
            if values is not None and values[TOKEN] == self.token and reached(values[STATE], values[NUMBER]):
                return
            if self._clock.now_s() > end_s:
                raise StartError(f"{self.name}: its controller had {READY_S:g} s {what}, and did not: see its log")
            self._clock.wait((self.link.fileno(), self._inputs.fileno()), end_s)

    def poll(self) -> None:
        """Read what has arrived.

        Raises:
            LinkError: A connection was lost.
        """
        self.link.poll()
        if self._inputs.receive_now() == b"":
            raise self._inputs.ended()

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
        self.values.update(number=number, time=time_s)
        self.point = np.concatenate([q_rad, qd_rad_s])
        self.send()

    def close(self) -> None:
        """Close all connections. May be called twice."""
        for each in self._open:
            each.close()


def stop_arms(arms: Sequence[StreamArm], clock: Clock) -> None:
    """Stop both arms: by a register, and by the dashboard where a program does not end soon."""
    pending = []
    for arm in arms:
        try:
            arm.values["command"] = Command.STOP
            arm.send()
            pending.append(arm)
        except DualUR10Error:
            _halt(arm)
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
                _halt(arm)
        clock.sleep(_POLL_S)


def _halt(arm: StreamArm) -> None:
    """Have the dashboard stop the program. If that fails, the program stops the arm, as no more points come."""
    with contextlib.suppress(DualUR10Error):
        arm.dashboard.stop()


def slowed(status: ArmStatus) -> str | None:
    """Return the reason why an arm cannot keep the path's time; None: it can."""
    scaling = min(status.slider, status.speed_scaling)
    if scaling < 1.0 - 1e-6:
        return f"its speed is scaled to {100 * scaling:.0f} %: points have fixed times, so set the slider to 100 %"
    return None
