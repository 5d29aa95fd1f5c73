"""Interface to grippers, and the client of a Robotiq 2F-85: one request at a time, each with a time limit.

A link sends no command by itself, neither when it is made nor when it is closed: a held object stays held.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple, TypeVar

from dual_ur10.errors import DualUR10Error, LinkError, SettingsError
from ur_core.links.link_socket import LinkSocket, SocketClient, check_timeout
from ur_core.processes.system import LOCAL, System
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85
from ur_core.tools.tool import Tool
from ur_core.types import Closing

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


_FIGURES: Final = ("stroke_m", "speed_m_s", "force_n")
_SLACK: Final = 0.15  # of the stroke, by which a measured opening may be outside of it

T = TypeVar("T")


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


@dataclass(frozen=True, kw_only=True)
class GripperRequest:
    """Request for the link to one gripper, from which a driver of one's own is made.

    Attributes:
        arm: Name of the arm, for messages.
        host: IPv4 address of the arm's controller.
        tool: The gripper.
        force_n: Grip force.
        system: Clock and network.
    """

    arm: str
    host: str
    tool: Tool
    force_n: float
    system: System = LOCAL


class GripperLink(Closing):
    """Connection to one gripper. Each call takes at most `ANSWER_S`, except `activate`. Closing sends nothing.

    Attributes:
        drives: Least and most of figures of the tools that it can drive, by their names: `stroke_m`, `speed_m_s` and
            `force_n`. Other tools are refused before anything moves.
        emulated: Emulated gripper for emulated and virtual cells, "module:Class" of an
            `ur_emulator.ports.grippers.EmulatedGripper`; "": there is none.
        tool: The gripper.
    """

    drives: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})
    emulated: ClassVar[str] = ""
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


def check_drives(driver: type[GripperLink], tool: Tool, where: str) -> None:
    """Check that a driver can drive a tool.

    Args:
        driver: The driver.
        tool: The tool.
        where: Description of both, for messages.

    Raises:
        SettingsError: It cannot, or names a figure that is none.
    """
    for name, (least, most) in driver.drives.items():
        if name not in _FIGURES:
            raise SettingsError(f"{where}: drives has {name!r}, allowed are {', '.join(_FIGURES)}")
        found = getattr(tool, name)
        low, high = found if isinstance(found, tuple) else (found, found)
        if not (least <= low and high <= most):
            has = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            raise SettingsError(
                f"{where} drives tools with {name} of {least:g} to {most:g}, and the tool {tool.name!r} has {has}: "
                "name the tool at the flange, or another driver"
            )


class CheckedGripper(GripperLink):
    """Link of one's own, whose errors and whose readings that are none are those of a lost gripper.

    Args:
        link: The link.
        tool: Its tool.
        where: Description of the gripper, for messages.
    """

    def __init__(self, link: GripperLink, tool: Tool, where: str) -> None:
        self.link, self.tool, self._where = link, tool, where

    @property
    def where(self) -> str:
        """Arm and driver, for messages."""
        return self._where

    def read(self) -> GripperReading:
        """See `GripperLink`."""
        return self._call(self._read)

    def _read(self) -> GripperReading:
        found = GripperReading(*self.link.read())
        opening_m = None if found.opening_m is None else float(found.opening_m)
        slack_m = _SLACK * self.tool.stroke_m
        if opening_m is not None and not -slack_m <= opening_m <= self.tool.stroke_m + slack_m:
            raise LinkError(
                f"{self._where}: found an opening of {opening_m} m; expected are 0 to {self.tool.stroke_m:g} m, or None"
            )
        if not isinstance(found.fault, str):
            raise LinkError(f"{self._where}: found the fault {found.fault!r}; expected is text, empty without a fault")
        return found._replace(opening_m=opening_m)

    def command(self, opening_m: float) -> bool:
        """See `GripperLink`."""
        return self._call(lambda: bool(self.link.command(opening_m)))

    def forget(self) -> None:
        """See `GripperLink`."""
        self._call(self.link.forget)

    def needs_activation(self) -> bool:
        """See `GripperLink`."""
        return self._call(lambda: bool(self.link.needs_activation()))

    def activate(self, within_s: float) -> None:
        """See `GripperLink`."""
        self._call(lambda: self.link.activate(within_s))

    def _call(self, act: Callable[[], T]) -> T:
        try:
            return act()
        except DualUR10Error:
            raise
        except Exception as error:  # of any kind: both arms must stop
            raise LinkError(f"{self._where}: {error!r}") from error

    def close(self) -> None:
        """Close the link. May be called twice."""
        self.link.close()


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
        late = "check the tool's power, the gripper's cable, and that its URCap runs on the controller"
        self._socket = LinkSocket(name, "Robotiq gripper", host, port, deadline_s, late=late, system=system)
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
