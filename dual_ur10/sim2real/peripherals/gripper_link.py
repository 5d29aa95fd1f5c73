"""Interface to grippers, and the client of a Robotiq 2F-85: one request at a time, each with a time limit.

A link sends no command by itself, neither when it is made nor when it is closed: a held object stays held.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Final, NamedTuple

from dual_ur10.assets.robotiq_2f85 import ROBOTIQ_2F85
from dual_ur10.assets.tool import Tool
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.links.link_socket import LinkSocket, SocketClient, check_timeout
from dual_ur10.sim2real.processes.system import LOCAL, System
from dual_ur10.types import Closing

COUNTS: Final = 255
"""Largest value of a Robotiq's position, force and speed."""

ANSWER_S: Final = 0.5
"""Time limit of an answer."""

_LONGEST: Final = 256  # of an answer, bytes
_NOT_UNDERSTOOD: Final = "?"
_RESET, _ACTIVE = 0, 3  # of STA
_STOPPED: Final = (1, 2)  # of OBJ: by an object, while opening and while closing
_ACTIVATION_FIRST: Final = 5
_STEP_S: Final = 0.05

FAULTS: Final = {
    5: "a command has to wait for the end of the activation",
    7: "it has to be activated before it takes commands",
    8: "too hot: let it cool down",
    9: "it has received nothing from the controller for a second: check its cable",
    10: "supply voltage too low: check the tool's power",
    11: "automatic release is going on: the fingers open slowly",
    12: "internal fault: switch its power off and on",
    13: "the activation failed: see that nothing blocks the fingers",
    14: "overcurrent",
    15: "automatic release is complete: it has to be activated again",
}
"""Meaning of the lower four bits of FLT: Robotiq's manual of the 2F-85."""


class GripperReading(NamedTuple):
    """Reading of a gripper.

    Attributes:
        opening_m: Distance of the fingers, 0 to the tool's stroke; None if unknown.
        fault: Reason why it would not obey a command, or "".
        holding: True if an object between or outside the fingers has stopped them; None if unknown.
    """

    opening_m: float | None
    fault: str
    holding: bool | None


class GripperLink(Closing):
    """Connection to one gripper. Each call takes at most `ANSWER_S`, except `activate`. Closing sends nothing.

    Attributes:
        tool: The gripper.
    """

    tool: Tool = ROBOTIQ_2F85

    @property
    @abstractmethod
    def where(self) -> str:
        """Arm, gripper and address, for messages."""

    @abstractmethod
    def read(self) -> GripperReading:
        """Return its present reading.

        Raises:
            LinkError: It was lost.
            ClosedError: It was closed; so in all methods.
        """

    @abstractmethod
    def command(self, opening_m: float) -> bool:
        """Open or close. Return True if a command had to be sent.

        Args:
            opening_m: Target distance of the fingers, 0 to the tool's stroke.

        Raises:
            LinkError: It was lost.
        """

    @abstractmethod
    def forget(self) -> None:
        """Forget the last command, since somebody else may have moved it: the next command is sent in any case."""

    @abstractmethod
    def needs_activation(self) -> bool:
        """Return True if it must be activated before it accepts commands.

        Raises:
            LinkError: It was lost.
        """

    @abstractmethod
    def activate(self, within_s: float) -> None:
        """Activate it. The fingers open, and may close before: a held object falls.

        Raises:
            LinkError: It was lost, or has not become active within the time.
        """


def counts_of(opening_m: float, stroke_m: float) -> int:
    """Return POS, 0 open to 255 closed, of an opening in m."""
    return min(max(round(COUNTS * (1.0 - opening_m / stroke_m)), 0), COUNTS)


def opening_of(counts: int, stroke_m: float) -> float:
    """Return the opening of POS, m."""
    return stroke_m * (1.0 - counts / COUNTS)


def force_counts(force_n: float, tool: Tool) -> int:
    """Return FOR, 0 to 255, of a grip force in N.

    Raises:
        SettingsError: The tool has no such force.
    """
    least, most = tool.force_n
    if not (math.isfinite(force_n) and least <= force_n <= most):
        raise SettingsError(f"grip force is {force_n!r} N: must be within {least:g} to {most:g} N")
    return round(COUNTS * (force_n - least) / (most - least))


class RobotiqLink(SocketClient, GripperLink):
    """Robotiq gripper behind the text protocol of its URCap, which answers at the arm's controller.

    Positions are assumed to be linear from POS 0, fully open, to POS 255, closed.

    Args:
        host: IPv4 address of the controller.
        port: Port number.
        force_n: Grip force; None: the tool's least.
        timeout_s: Time limit of the connection.
        name: Name of the arm, for messages.
        system: Clock and network.
        tool: The gripper.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: Nothing answers there.
    """

    def __init__(
        self,
        host: str,
        port: int,
        force_n: float | None = None,
        timeout_s: float = 2.0,
        *,
        name: str = "",
        system: System = LOCAL,
        tool: Tool = ROBOTIQ_2F85,
    ) -> None:
        self._clock, self.tool = system.clock, tool
        self._force = force_counts(tool.force_n[0] if force_n is None else force_n, tool)
        deadline_s = self._clock.now_s() + check_timeout(timeout_s)
        self._socket = LinkSocket(name, "Robotiq gripper", host, port, deadline_s, system=system)
        self._rest = b""
        self._commanded: int | None = None
        with self._socket.closed_on_error():
            self._get("STA", deadline_s)  # checks that the service speaks this protocol

    def read(self) -> GripperReading:
        """See `GripperLink`. It asks for POS, STA, FLT and OBJ."""
        deadline_s = self._clock.now_s() + ANSWER_S
        position, state, fault, stopped = (self._get(name, deadline_s) for name in ("POS", "STA", "FLT", "OBJ"))
        opening_m = None if position is None else opening_of(position, self.tool.stroke_m)
        if position is None or state is None or fault is None or stopped is None:
            text = "the controller does not reach its gripper: check the tool's power and the gripper's cable"
            return GripperReading(opening_m, text, None)
        text = ""
        if fault:
            code = fault & 15
            text = f"FLT {fault}: {FAULTS.get(code, 'a fault that its manual does not list')}"
        elif state != _ACTIVE:
            text = f"not activated (STA {state}, expected {_ACTIVE}): activate it at the start of a run"
        return GripperReading(opening_m, text, stopped in _STOPPED)

    def command(self, opening_m: float) -> bool:
        """See `GripperLink`. A command is sent with full speed, if POS differs from the last one."""
        counts = counts_of(opening_m, self.tool.stroke_m)
        if counts == self._commanded:
            return False
        self._set(f"POS {counts} SPE {COUNTS} FOR {self._force} GTO 1", self._clock.now_s() + ANSWER_S)
        self._commanded = counts
        return True

    def forget(self) -> None:
        """See `GripperLink`."""
        self._commanded = None

    def needs_activation(self) -> bool:
        """Return True if it is not active, or has a fault that only activation clears."""
        deadline_s = self._clock.now_s() + ANSWER_S
        return self._get("STA", deadline_s) != _ACTIVE or (self._get("FLT", deadline_s) or 0) & 15 > _ACTIVATION_FIRST

    def activate(self, within_s: float) -> None:
        """See `GripperLink`. A reset precedes the activation."""
        end_s = self._clock.now_s() + within_s
        self._commanded = None
        for active, state in ((0, _RESET), (1, _ACTIVE)):
            self._set(f"ACT {active}", self._clock.now_s() + ANSWER_S)
            while (found := self._get("STA", self._clock.now_s() + ANSWER_S)) != state:
                if self._clock.now_s() >= end_s:
                    raise self._socket.error(
                        f"not active after {within_s:g} s (STA {found}, expected {state})",
                        "see that nothing blocks the fingers, and that the tool has power",
                    )
                self._clock.sleep(_STEP_S)

    def _set(self, words: str, deadline_s: float) -> None:
        # "ack" comes without an end of line; whatever else comes has one.
        answer = self._exchange(f"SET {words}", deadline_s, (b"ack", b"\n"))
        if answer != "ack":
            raise self._socket.error(
                f"answers {answer[:40]!r} to 'SET {words}'", "expected is 'ack': check the tool's power and the port"
            )

    def _get(self, name: str, deadline_s: float) -> int | None:
        """Value of a register, or None if the controller cannot reach the gripper."""
        answer = self._exchange(f"GET {name}", deadline_s, (b"\n",))
        word, _, value = answer.partition(" ")
        if word == name and value == _NOT_UNDERSTOOD:
            return None
        if word != name or not (value.isascii() and value.isdigit() and int(value) <= COUNTS):
            raise self._socket.error(
                f"answers {answer[:40]!r} to 'GET {name}'", f"expected is '{name} ' and a number: check the port"
            )
        return int(value)

    def _exchange(self, line: str, deadline_s: float, ends: tuple[bytes, ...]) -> str:
        """Return the answer to a line. Any failure closes the connection, so that no late answer is mistaken."""
        with self._socket.closed_on_error():
            self._socket.send(line.encode("ascii") + b"\n", deadline_s)
            buffer = self._rest
            while True:
                buffer = buffer.lstrip()  # the end of line after an "ack", if there was one
                for end in ends:
                    place = buffer.find(end)
                    if place >= 0:
                        place += len(end)
                        self._rest = buffer[place:]
                        return buffer[:place].decode("ascii", "replace").strip()
                if len(buffer) > _LONGEST:
                    raise self._socket.error(f"an answer of {len(buffer)} bytes", "this is no Robotiq gripper")
                buffer += self._socket.receive(deadline_s)
