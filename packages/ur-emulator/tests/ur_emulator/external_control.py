"""Loopback driver with the wire formats of UR's client library: what a controller's external control program talks to.

Formats: `reverse_interface.cpp`, `trajectory_point_interface.cpp`, `script_command_interface.cpp`, `script_sender.cpp`
and `script_reader.cpp` of the Universal Robots Client Library. All numbers are big-endian integers of 32 bits.
"""

from __future__ import annotations

import operator
import re
import struct
from collections.abc import Sequence
from enum import IntEnum

from ur_core.processes.system import System
from ur_core.processes.transport import Transport

PORTS = {"reverse": 50001, "script": 50002, "trajectory": 50003, "command": 50004}
SCALE = 1_000_000
TIME_SCALE = 1000

_COMPARE = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_CONDITION = re.compile(r"{%\s*(if|elif)\s+ROBOT_SOFTWARE_VERSION\s*([<>=!]+)\s*v([\d.]+)\s*%}")
_WORD = re.compile(r"{%\s*(else|endif)\s*%}")


class Mode(IntEnum):
    """Control modes of a message on the reverse interface."""

    STOPPED = -2
    IDLE = 0
    SERVOJ = 1
    SPEEDJ = 2
    FORWARD = 3
    SPEEDL = 4
    POSE = 5
    FREEDRIVE = 6


class Result(IntEnum):
    """Results of a trajectory."""

    SUCCESS = 0
    CANCELED = 1
    FAILURE = 2


class Point(IntEnum):
    """Types of a trajectory point."""

    MOVEJ = 0
    MOVEL = 1
    SPLINE = 51


class Driver:
    """Servers of the four interfaces of one arm. No method waits.

    Args:
        system: Network.
        host: Address to listen at.
        ports: Port numbers by interface; those of UR by default.
    """

    def __init__(self, system: System, host: str, ports: dict[str, int] | None = None) -> None:
        self.host, self.ports = host, ports or PORTS
        self._listeners = {name: system.listen(host, port) for name, port in self.ports.items()}
        self._clients: dict[str, Transport] = {}
        self._received = bytearray()
        self.program = ""  # served by the script interface
        self.timeout_s = 0.1

    def script(self, template: str, version: tuple[int, ...], *, servoj: str = "lookahead_time=0.03, gain=2000") -> str:
        """Return a template's program for a controller's version, as the client library fills it in."""
        values = {
            "BEGIN_REPLACE": "",
            "JOINT_STATE_REPLACE": str(SCALE),
            "TIME_REPLACE": str(TIME_SCALE),
            "SERVO_J_REPLACE": servoj,
            "SERVER_IP_REPLACE": self.host,
            "SERVER_PORT_REPLACE": str(self.ports["reverse"]),
            "TRAJECTORY_SERVER_PORT_REPLACE": str(self.ports["trajectory"]),
            "SCRIPT_COMMAND_SERVER_PORT_REPLACE": str(self.ports["command"]),
        }
        text = re.sub(r"{{\s*(\w+)\s*}}", lambda found: values[found[1]], template)
        body = "".join(f"\t{line}\n" for line in _chosen(text, version))
        return f"def externalControl():\n{body}end\n"

    def serve(self) -> None:
        """Accept connections, and answer requests for the program."""
        for name, listener in self._listeners.items():
            client = listener.accept_now()
            if client is not None:
                self._clients[name] = client
        client = self._clients.get("script")
        if client is not None and (client.receive_now(4096) or b"").startswith(b"request_program"):
            client.send_now(self.program.encode())

    @property
    def connected(self) -> bool:
        """True once the program has connected to all interfaces but that of the script."""
        return self._clients.keys() >= {"reverse", "trajectory", "command"}

    def ended(self) -> bool:
        """Return True if the program has closed its reverse connection."""
        try:
            return self._clients["reverse"].receive_now(1) == b""
        except OSError:
            return True

    def write(self, mode: Mode, values: Sequence[float] = (0.0,) * 6) -> None:
        """Send six numbers for a control mode."""
        self._reverse([round(value * SCALE) for value in values], mode)

    def start(self, count: int) -> None:
        """Announce a trajectory of so many points."""
        self._reverse([1, count, 0, 0, 0, 0], Mode.FORWARD)

    def keep_alive(self) -> None:
        """Keep a trajectory going."""
        self._reverse([0] * 6, Mode.FORWARD)

    def cancel(self) -> None:
        """Cancel a trajectory."""
        self._reverse([-1, 0, 0, 0, 0, 0], Mode.FORWARD)

    def freedrive(self, on: bool) -> None:
        """Switch freedrive on or off."""
        self._reverse([1 if on else -1, 0, 0, 0, 0, 0], Mode.FREEDRIVE)

    def spline(
        self, q: Sequence[float], qd: Sequence[float], time_s: float, qdd: Sequence[float] | None = None
    ) -> None:
        """Send a point of a cubic spline, or of a quintic one with accelerations."""
        numbers = [round(value * SCALE) for value in (*q, *qd, *((0.0,) * 6 if qdd is None else qdd))]
        self._send("trajectory", [*numbers, round(time_s * TIME_SCALE), 1 if qdd is None else 2, Point.SPLINE])

    def move(self, target: Sequence[float], kind: Point, *, v: float, a: float, time_s: float = 0.0) -> None:
        """Send a `movej` or `movel` point."""
        numbers = [round(value * SCALE) for value in (*target, *(0.0,) * 6, v, a)]
        self._send("trajectory", [*numbers, *(0,) * 4, round(time_s * TIME_SCALE), 0, kind])

    def command(self, kind: int, values: Sequence[float] = ()) -> None:
        """Send a script command."""
        numbers = [kind, *(round(value * SCALE) for value in values)]
        self._send("command", numbers + [0] * (28 - len(numbers)))

    def result(self) -> Result | None:
        """Return the next result of a trajectory, if one has come."""
        self._received += self._clients["trajectory"].receive_now(64) or b""
        if len(self._received) < 4:
            return None
        (number,) = struct.unpack_from(">i", self._received)
        del self._received[:4]
        return Result(number)

    def close(self) -> None:
        """Close everything."""
        for each in (*self._clients.values(), *self._listeners.values()):
            each.close()

    def _reverse(self, numbers: list[int], mode: Mode) -> None:
        self._send("reverse", [round(1e3 * self.timeout_s), *numbers, mode])

    def _send(self, name: str, numbers: Sequence[int]) -> None:
        data = struct.pack(f">{len(numbers)}i", *numbers)
        if self._clients[name].send_now(data) != len(data):
            raise AssertionError(f"the program does not read its {name} interface")


def _chosen(text: str, version: tuple[int, ...]) -> list[str]:
    """Return the lines whose conditions hold for a version."""
    lines: list[str] = []
    open_blocks: list[tuple[bool, bool]] = []  # whether a branch was taken, and whether this one is
    for line in text.splitlines():
        condition, word = _CONDITION.search(line), _WORD.search(line)
        if condition is not None:
            holds = _COMPARE[condition[2]](version[:3], tuple(map(int, condition[3].split("."))))
            taken = condition[1] == "elif" and open_blocks.pop()[0]
            open_blocks.append((taken or holds, holds and not taken))
        elif word is not None:
            taken, _ = open_blocks.pop()
            if word[1] == "else":
                open_blocks.append((True, not taken))
        elif all(this for _, this in open_blocks):
            lines.append(line)
    return lines
