"""A client of the dashboard server: questions about a controller, and the one command that stops its program.

Nothing here unlocks a stop, starts or loads a program: that is for a person at the pendant.
"""

from __future__ import annotations

import re
import time
from typing import Final

from dual_ur10.errors import OperationRefusedError, ProtocolError, SettingsError
from dual_ur10.sim2real.links.link_socket import LinkSocket, checked_timeout
from dual_ur10.sim2real.protocol.text_lines import LineReader
from dual_ur10.types import Closing

PORT: Final = 29999

FORBIDDEN: Final = ("play", "unlock protective stop", "close safety popup", "restart safety", "load")
"""Commands that would let an arm go on after a stop, or start something: they are for a person."""

_LONGEST: Final = 1024  # of a command, characters
_GREETING: Final = "Connected"
_UNKNOWN: Final = "could not understand"
_REMOTE_SINCE: Final = (5, 6)  # UR's article "Dashboard Server e-Series"; a CB3 has no such mode


class DashboardLink(Closing):
    """One connection. Any failure ends it, so that a late answer is never taken for that of another question.

    Args:
        host: IPv4 address.
        timeout_s: For connecting, and for each question.
        port: Number.
        name: Of the arm, for messages.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: There is no dashboard server, or it does not greet in time.
    """

    def __init__(self, host: str, timeout_s: float = 2.0, port: int = PORT, *, name: str = "") -> None:
        self._timeout_s = checked_timeout(timeout_s)
        self._version: tuple[int, ...] | None = None
        deadline_s = time.monotonic() + timeout_s
        self._socket = LinkSocket(name, "dashboard", host, port, deadline_s)
        self._lines = LineReader()
        try:
            greeting = self._line(deadline_s)
            if not greeting.startswith(_GREETING):
                raise self._socket.error(
                    f"greets with {greeting[:80]!r}", "this is no dashboard server: check the address"
                )
        except BaseException:
            self._socket.close()
            raise

    @property
    def where(self) -> str:
        """Arm and address, for messages."""
        return self._socket.where

    def fileno(self) -> int:
        """For `select`: readable when an answer, or the end, has come.

        Raises:
            ClosedError: It was closed.
        """
        return self._socket.fileno()

    def ask(self, command: str) -> str:
        """Send one command.

        Args:
            command: One line of printable ASCII.

        Returns:
            The line that answers it.

        Raises:
            SettingsError: The command is no such line.
            OperationRefusedError: It is one of `FORBIDDEN`.
            LinkError: There is no answer in time, or it is none. The connection was closed.
            ClosedError: It was closed before.
        """
        if not (0 < len(command) <= _LONGEST and command.isascii() and command.isprintable()):
            raise SettingsError(
                f"dashboard command {command[:80]!r}: it must be one line of 1 to {_LONGEST} printable characters"
            )
        words = " ".join(command.lower().split())
        if any(words == each or words.startswith(each + " ") for each in FORBIDDEN):
            raise OperationRefusedError(
                f"dashboard command {words!r} is not sent by this program: a person does that at the pendant, after "
                "looking at the cause of the stop"
            )
        deadline_s = time.monotonic() + self._timeout_s
        try:
            self.check()
            self._socket.send(command.encode("ascii") + b"\n", deadline_s)
            return self._line(deadline_s)
        except BaseException:  # an interrupt, too: its answer would be taken for the next one's
            self._socket.close()
            raise

    def check(self) -> None:
        """See that it still stands, and that nothing was said unasked. It does not wait.

        Raises:
            LinkError: It was lost, or something was said.
            ClosedError: It was closed.
        """
        data = self._socket.receive_now()
        if data == b"":
            raise self._socket.ended()
        if data is not None:
            raise self._socket.error(f"said {data[:80]!r} unasked", "connect again: answers may be those of others")

    def _line(self, deadline_s: float) -> str:
        while True:
            try:
                lines = self._lines.feed(self._socket.receive(deadline_s))
            except ProtocolError as error:
                raise self._socket.error(str(error), "this is no dashboard server: check the address") from error
            if len(lines) > 1:
                raise self._socket.error(f"{len(lines)} lines as one answer", "this is no dashboard server")
            if lines:
                return lines[0].strip()

    def _told(self, command: str, prefix: str = "") -> str:
        answer = self.ask(command)
        if not answer.lower().startswith(prefix.lower()):
            raise self._socket.error(
                f"answers {answer[:80]!r} to {command!r}", f"expected is {prefix!r}...: check the controller's version"
            )
        return answer[len(prefix) :].strip()

    def _told_if_known(self, command: str) -> str | None:
        answer = self.ask(command)
        return None if not answer or answer.lower().startswith(_UNKNOWN) else answer

    def stop(self) -> None:
        """Stop the program.

        Raises:
            OperationRefusedError: The controller refuses.
            LinkError: There is no answer.
        """
        answer = self.ask("stop")
        if answer != "Stopped":
            raise OperationRefusedError(
                f"{self.where}: answers {answer[:120]!r} to 'stop': stop the program at the pendant"
            )

    def version(self) -> tuple[int, ...]:
        """Version of PolyScope: three or four numbers. It is asked for once."""
        if self._version is None:
            answer = self.ask("PolyscopeVersion")
            found = re.search(r"(\d{1,9})\.(\d{1,9})\.(\d{1,9})(?:\.(\d{1,9}))?", answer, re.ASCII)
            if found is None:
                raise self._socket.error(f"answers {answer[:80]!r} to 'PolyscopeVersion'", "check the address")
            self._version = tuple(int(each) for each in found.groups() if each is not None)
        return self._version

    def robot_mode(self) -> str:
        """UR's word for it, such as "RUNNING"."""
        return self._told("robotmode", "Robotmode:")

    def safety(self) -> str:
        """UR's word for the safety status, such as "NORMAL"; before there was one, for the safety mode."""
        answer = self._told_if_known("safetystatus")
        return self._told("safetymode", "Safetymode:") if answer is None else answer.partition(":")[2].strip()

    def program_state(self) -> str:
        """State and name of the program, such as "STOPPED lift.urp"."""
        return self._told("programState")

    def remote_control(self) -> bool | None:
        """Whether the controller is in remote control; None where it has no such mode."""
        if self.version() < _REMOTE_SINCE:
            return None
        answer = self.ask("is in remote control").lower()
        if answer not in ("true", "false"):
            raise self._socket.error(f"answers {answer[:80]!r} to 'is in remote control'", "expected is true or false")
        return answer == "true"

    def serial_number(self) -> str | None:
        """Serial number, or None where it cannot be asked for."""
        return self._told_if_known("get serial number")

    def model(self) -> str | None:
        """Model, such as "UR10", or None where it cannot be asked for."""
        return self._told_if_known("get robot model")

    def close(self) -> None:
        """End the connection. May be called twice."""
        self._socket.close()
