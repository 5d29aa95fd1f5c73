"""TCP connection to a controller. Every operation has a deadline."""

from __future__ import annotations

import contextlib
import ipaddress
import math
from typing import Final

from ur_core.errors import ClosedError, LinkError, SettingsError
from ur_core.processes.system import LOCAL, System
from ur_core.processes.transport import Transport
from ur_core.types import Closing

NO_ANSWER: Final = "no answer in time"
"""Finding about a peer that is silent."""

_RECEIVE_BYTES: Final = 65_536


def check_host(host: str) -> str:
    """Return an address in canonical form.

    Raises:
        SettingsError: It is not an IPv4 address. Names are not resolved: that takes an unbounded time, and the result
            can change between two connections.
    """
    try:
        return str(ipaddress.IPv4Address(host))
    except ValueError:
        raise SettingsError(
            f"controller address {host!r}: give its IPv4 address, such as 192.168.1.11; names are not looked up"
        ) from None


def check_timeout(timeout_s: float) -> float:
    """Return a time limit.

    Raises:
        SettingsError: It is not positive and finite.
    """
    if not (math.isfinite(timeout_s) and timeout_s > 0.0):
        raise SettingsError(f"timeout_s is {timeout_s!r}: it must be positive and finite")
    return timeout_s


class LinkSocket(Closing):
    """Connected socket. Any failure is a [LinkError][ur_core.errors.LinkError] that names arm, host and remedy.

    Args:
        name: Name of the arm, for messages; "" if it has none.
        service: Service at the port, for messages.
        host: IPv4 address.
        port: Port number.
        deadline_s: Deadline of the connection, on the system's clock.
        late: Remedy where it does not answer in time.
        system: Clock and network.

    Attributes:
        where: Arm, interface and address, for messages.

    Raises:
        SettingsError: The host is not an IPv4 address.
        LinkError: There is no connection before the deadline.
    """

    def __init__(
        self,
        name: str,
        service: str,
        host: str,
        port: int,
        deadline_s: float,
        *,
        late: str = "check that the controller is up and not overloaded, and the network",
        system: System = LOCAL,
    ) -> None:
        host = check_host(host)
        self.where = f"{name + ' arm, ' if name else ''}{service} at {host}:{port}"
        self._clock, self._remedy = system.clock, late
        self._transport: Transport | None = None
        try:
            self._transport = system.connect(host, port, self._left(deadline_s))
        except OSError as error:
            if isinstance(error, LinkError):
                raise
            raise self.error(
                f"no connection ({_reason(error)})",
                "check that the controller is on, the address, the cable, and its firewall and services",
            ) from error

    def error(self, found: str, remedy: str) -> LinkError:
        """Return an error about this connection."""
        return LinkError(f"{self.where}: {found}; {remedy}")

    def _left(self, deadline_s: float) -> float:
        left = deadline_s - self._clock.now_s()
        if left <= 0.0:
            raise self._late()
        return left

    def _late(self) -> LinkError:
        return self.error(NO_ANSWER, self._remedy)

    @property
    def _open(self) -> Transport:
        if self._transport is None:
            raise ClosedError(f"{self.where}: this connection was closed; make another")
        return self._transport

    def fileno(self) -> int:
        """Return the file number for `Clock.wait`.

        Raises:
            ClosedError: It was closed.
        """
        return self._open.fileno()

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all data.

        Raises:
            LinkError: They are not sent before the deadline, or the connection ended.
            ClosedError: It was closed.
        """
        open_ = self._open
        left = memoryview(data)
        try:
            while True:
                self._left(deadline_s)
                left = left[open_.send_now(left) :]
                if not left:
                    return
                self._clock.wait((), deadline_s, (open_.fileno(),))
        except OSError as error:
            raise self._failed(error) from error

    def receive(self, deadline_s: float) -> bytes:
        """Wait for data, and return them.

        Raises:
            LinkError: Nothing arrives before the deadline, or the connection ended.
            ClosedError: It was closed.
        """
        self._left(deadline_s)
        while (data := self.receive_now()) is None:
            self._left(deadline_s)
            self._clock.wait((self.fileno(),), deadline_s)
        if not data:
            raise self.ended()
        return data

    def receive_now(self) -> bytes | None:
        """Return waiting data, None if there are none, or b"" at the end of the stream. It does not wait.

        Raises:
            LinkError: The connection was broken.
            ClosedError: It was closed.
        """
        try:
            return self._open.receive_now(_RECEIVE_BYTES)
        except OSError as error:
            raise self._failed(error) from error

    def ended(self) -> LinkError:
        """Return the error that the controller closed the connection."""
        return self.error(
            "the controller closed the connection",
            "check that it was not shut down or restarted, and that no other program takes its connections",
        )

    def _failed(self, error: OSError) -> LinkError:
        if isinstance(error, LinkError):
            return error
        return self.error(f"the connection broke ({_reason(error)})", "check the controller and the cable")

    def close(self) -> None:
        """End the connection. May be called twice."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def close_and_wait(self, deadline_s: float) -> None:
        """End the connection, and wait until the controller has closed its side. Data that it sends are dropped.

        The controller has then released the resources of this connection. The wait ends at the deadline.
        """
        with contextlib.suppress(OSError, ClosedError):
            self._open.end_sending()
            while True:
                self.receive(deadline_s)
        self.close()


class SocketClient(Closing):
    """Client that owns one connection, `_socket`."""

    _socket: LinkSocket

    @property
    def where(self) -> str:
        """Arm, service and address, for messages."""
        return self._socket.where

    def fileno(self) -> int:
        """Return the file number for `Clock.wait`: readable when there are data, or the end.

        Raises:
            ClosedError: It was closed.
        """
        return self._socket.fileno()

    def close(self) -> None:
        """End the connection without sending anything. May be called twice."""
        self._socket.close()


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return NO_ANSWER
    return (error.strerror or str(error) or type(error).__name__).lower()
