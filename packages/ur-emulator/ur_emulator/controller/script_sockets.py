"""Connections that a URScript program opens. No operation waits: the program's thread does, over control periods.

An emulated controller connects to this machine alone. Bytes of a peer stay in the system's buffers until the program
reads them, as on a real controller.
"""

from __future__ import annotations

import logging
from concurrent.futures import Executor, Future
from typing import Final

from ur_core.processes.system import System
from ur_core.processes.transport import Transport
from ur_emulator.addresses import check_loopback

log = logging.getLogger(__name__)

SOCKETS_MAX: Final = 32
"""Most open connections of a program. UR publishes no figure."""

CONNECT_S: Final = 2.0
"""Longest attempt to connect (UR's script manual)."""

_READ_BYTES: Final = 8192
_HELD_BYTES: Final = 65_536  # received and not yet read by the program


class ScriptSocket:
    """Open connection of a program.

    Attributes:
        received: Bytes that the program has not read yet.
        ended: Whether the peer has closed or broken it.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self.received = bytearray()
        self._unsent = bytearray()
        self.ended = False

    def fill(self) -> None:
        """Take the bytes that have arrived."""
        while not self.ended and len(self.received) < _HELD_BYTES:
            try:
                data = self._transport.receive_now(_READ_BYTES)
            except OSError:
                data = b""
            if data is None:
                return
            self.ended = not data
            self.received += data
            if len(data) < _READ_BYTES:
                return

    def send(self, data: bytes) -> bool:
        """Send bytes after those that wait, and return True if none is left."""
        self._unsent += data
        try:
            while self._unsent and (sent := self._transport.send_now(self._unsent)):
                del self._unsent[:sent]
        except OSError:
            self.ended = True
            self._unsent.clear()
        return not self._unsent

    def close(self) -> None:
        """Close it."""
        self.ended = True
        self._transport.close()


class ScriptSockets:
    """Connections of one controller's program, by the names that it gives them.

    Args:
        system: Network. Attempts to connect wait in a thread of their own.
        name: Name of the controller.
    """

    def __init__(self, system: System, name: str) -> None:
        self._system, self._name = system, name
        self._sockets: dict[str, ScriptSocket] = {}
        self._connector: Executor | None = None

    def __len__(self) -> int:
        return len(self._sockets)

    def find(self, name: str) -> ScriptSocket | None:
        """Return an open connection, or None."""
        return self._sockets.get(name)

    def connect(self, address: object, port: object) -> Future[Transport]:
        """Begin to connect.

        Raises:
            AddressError: The address is not one of this machine's loopback network.
            ValueError: There is no such port, or the program has too many connections.
        """
        host = "127.0.0.1" if address == "localhost" else address
        check_loopback(host, "a program of an emulated controller connects to")
        if isinstance(port, bool) or not isinstance(port, int) or not 0 < port < 1 << 16:
            raise ValueError(f"there is no port {port!r}: they are 1 to 65535")
        if len(self._sockets) >= SOCKETS_MAX:
            raise ValueError(f"a program has at most {SOCKETS_MAX} open sockets: close one with socket_close")
        if self._connector is None:
            self._connector = self._system.worker(f"{self._name} connections")
        return self._connector.submit(self._system.connect, str(host), port, CONNECT_S, quick=True)

    def add(self, name: str, transport: Transport) -> None:
        """Add a connection."""
        self._sockets[name] = ScriptSocket(transport)

    def close(self, name: str) -> None:
        """Close a connection, if it is open."""
        socket = self._sockets.pop(name, None)
        if socket is not None:
            socket.close()

    def close_all(self) -> None:
        """Close all connections: the program has ended."""
        for name in tuple(self._sockets):
            self.close(name)

    def shut_down(self) -> None:
        """Close all connections, and connect no more."""
        self.close_all()
        if self._connector is not None:
            self._connector.shutdown(wait=False, cancel_futures=True)


def discard(attempt: Future[Transport]) -> None:
    """Close a connection as soon as it is made: nobody waits for it any more."""

    def close(done: Future[Transport]) -> None:
        if not done.cancelled() and done.exception() is None:
            done.result().close()

    attempt.add_done_callback(close)
