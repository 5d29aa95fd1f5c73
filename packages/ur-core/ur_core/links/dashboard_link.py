"""Client of the dashboard server: queries, and the command that stops the program.

Nothing here unlocks a stop, starts or loads a program: that is for a person at the pendant.
"""

from __future__ import annotations

import re
from typing import Final

from ur_core.errors import OperationRefusedError, ProtocolError, SettingsError
from ur_core.links.link_socket import LinkSocket, SocketClient, check_timeout
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.text_lines import LineReader

PORT: Final = 29999

FORBIDDEN: Final = ("play", "unlock protective stop", "close safety popup", "restart safety", "load")
"""Commands that resume motion after a stop, or start something: they are for a person."""

_LONGEST: Final = 1024  # of a command, characters
_GREETING: Final = "Connected"
_UNKNOWN: Final = "could not understand"
_REMOTE_SINCE: Final = (5, 6)  # UR's article "Dashboard Server e-Series"; a CB3 has no such mode


class DashboardLink(SocketClient):
    """Connection to a dashboard. Any failure closes it, so that a late answer is not taken for that of another query.

    Args:
        host: IPv4 address.
        timeout_s: Time limit of the connection, and of each query.
        port: Port number.
        name: Name of the arm, for messages.
        system: Clock and network.

    Raises:
        SettingsError: An argument is not legal.
        LinkError: There is no dashboard server, or it does not greet in time.
    """

    def __init__(
        self, host: str, timeout_s: float = 2.0, port: int = PORT, *, name: str = "", system: System = LOCAL
    ) -> None:
        self._clock = system.clock
        self._timeout_s = check_timeout(timeout_s)
        self._version: tuple[int, ...] | None = None
        deadline_s = self._clock.now_s() + timeout_s
        self._socket = LinkSocket(name, "dashboard", host, port, deadline_s, system=system)
        self._lines = LineReader()
        with self._socket.closed_on_error():
            greeting = self._line(deadline_s)
            if not greeting.startswith(_GREETING):
                raise self._socket.error(
                    f"greets with {greeting[:80]!r}", "this is no dashboard server: check the address"
                )

    def ask(self, command: str) -> str:
        """Send one command.

        Args:
            command: One line of printable ASCII.

        Returns:
            The line that answers it.

        Raises:
            SettingsError: The command is not such a line.
            OperationRefusedError: It is one of `FORBIDDEN`.
            LinkError: There is no answer in time, or it is not valid. The connection was closed.
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
        deadline_s = self._clock.now_s() + self._timeout_s
        with self._socket.closed_on_error():  # also by an interrupt: its answer would be taken for the next one
            self.check()
            self._socket.send(command.encode("ascii") + b"\n", deadline_s)
            return self._line(deadline_s)

    def check(self) -> None:
        """Check that the connection stands, and that nothing was sent unasked. It does not wait.

        Raises:
            LinkError: It was lost, or the server sent something.
            ClosedError: It was closed.
        """
        data = self._socket.receive_now()
        if data == b"":
            raise self._socket.ended()
        if data is not None:
            raise self._socket.error(f"sent {data[:80]!r} unasked", "connect again: answers may be mixed up")

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

    def _query(self, command: str, prefix: str = "") -> str:
        answer = self.ask(command)
        if not answer.lower().startswith(prefix.lower()):
            raise self._socket.error(
                f"answers {answer[:80]!r} to {command!r}", f"expected is {prefix!r}...: check the controller's version"
            )
        return answer[len(prefix) :].strip()

    def _query_if_known(self, command: str) -> str | None:
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
        """Return the version of PolyScope, three or four numbers. It is queried once."""
        if self._version is None:
            answer = self.ask("PolyscopeVersion")
            found = re.search(r"(\d{1,9})\.(\d{1,9})\.(\d{1,9})(?:\.(\d{1,9}))?", answer, re.ASCII)
            if found is None:
                raise self._socket.error(f"answers {answer[:80]!r} to 'PolyscopeVersion'", "check the address")
            self._version = tuple(int(each) for each in found.groups() if each is not None)
        return self._version

    def robot_mode(self) -> str:
        """Return UR's name of the robot mode, such as "RUNNING"."""
        return self._query("robotmode", "Robotmode:")

    def safety(self) -> str:
        """Return UR's name of the safety status, such as "NORMAL"; in old versions, of the safety mode."""
        answer = self._query_if_known("safetystatus")
        return self._query("safetymode", "Safetymode:") if answer is None else answer.partition(":")[2].strip()

    def program_state(self) -> str:
        """Return state and name of the program, such as "STOPPED lift.urp"."""
        return self._query("programState")

    def remote_control(self) -> bool | None:
        """Return True in remote control; None if the controller has no such mode."""
        if self.version() < _REMOTE_SINCE:
            return None
        answer = self.ask("is in remote control").lower()
        if answer not in ("true", "false"):
            raise self._socket.error(f"answers {answer[:80]!r} to 'is in remote control'", "expected is true or false")
        return answer == "true"

    def serial_number(self) -> str | None:
        """Return the serial number, or None if this version does not report it."""
        return self._query_if_known("get serial number")

    def model(self) -> str | None:
        """Return the model, such as "UR10", or None if this version does not report it."""
        return self._query_if_known("get robot model")
