"""Transports of bytes: TCP connections and pairs of sockets. None of their operations waits."""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import Final, Protocol, Self

_RESET: Final = struct.pack("ii", 1, 0)  # SO_LINGER that makes close() send RST


class Transport(Protocol):
    """Stream of bytes between two ends. Two implementations exist: `TcpTransport`, and memory in a `VirtualCell`."""

    def fileno(self) -> int:
        """Return the file number for `Clock.wait`."""

    def send_now(self, data: bytes | bytearray | memoryview) -> int:
        """Send as much as fits, and return the number of bytes.

        Raises:
            OSError: The connection was broken.
        """

    def receive_now(self, size: int) -> bytes | None:
        """Return up to `size` waiting bytes, None if there are none, or b"" at the end of the stream.

        Raises:
            OSError: The connection was broken.
        """

    def end_sending(self) -> None:
        """End the stream in this direction.

        Raises:
            OSError: The connection was broken.
        """

    def close(self, *, reset: bool = False) -> None:
        """Close this end. May be called twice.

        Args:
            reset: Break the connection instead of ending the stream.
        """


class Listener(Protocol):
    """Listening port."""

    @property
    def port(self) -> int:
        """Port number, also where the system chose it."""

    def fileno(self) -> int:
        """Return the file number for `Clock.wait`: readable when a client waits."""

    def accept_now(self) -> Transport | None:
        """Return the next client, or None if there is none.

        Raises:
            OSError: It cannot be accepted.
        """

    def close(self) -> None:
        """Stop listening."""


class TcpTransport:
    """Connected socket.

    Args:
        sock: The socket, which this object owns.
        quick: Acknowledge every packet at once: clients with Nagle's algorithm wait for that before their next packet.
    """

    def __init__(self, sock: socket.socket, *, quick: bool = False) -> None:
        self._sock = sock
        self._quick = quick and hasattr(socket, "TCP_QUICKACK")
        sock.setblocking(False)
        if sock.family == socket.AF_INET:
            with contextlib.suppress(OSError):  # the peer may have gone already, which the next read reports
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @classmethod
    def connect(cls, host: str, port: int, within_s: float, *, quick: bool = False) -> Self:
        """Connect to a port.

        Raises:
            OSError: There is no connection in time.
        """
        return cls(socket.create_connection((host, port), timeout=within_s), quick=quick)

    @classmethod
    def pair(cls) -> tuple[Self, Self]:
        """Return two connected ends on this machine."""
        first, second = socket.socketpair()
        return cls(first), cls(second)

    @classmethod
    def of_file(cls, number: int) -> Self:
        """Return the transport of an inherited socket."""
        return cls(socket.socket(fileno=number))

    def fileno(self) -> int:
        """See `Transport`."""
        return self._sock.fileno()

    def send_now(self, data: bytes | bytearray | memoryview) -> int:
        """See `Transport`."""
        try:
            return self._sock.send(data)
        except BlockingIOError:
            return 0

    def receive_now(self, size: int) -> bytes | None:
        """See `Transport`."""
        try:
            data = self._sock.recv(size)
        except BlockingIOError:
            return None
        if self._quick:
            with contextlib.suppress(OSError):  # the system resets this option after every packet
                self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return data

    def end_sending(self) -> None:
        """See `Transport`."""
        self._sock.shutdown(socket.SHUT_WR)

    def close(self, *, reset: bool = False) -> None:
        """See `Transport`."""
        if reset:
            with contextlib.suppress(OSError):
                self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self._sock.close()


class TcpListener:
    """Listening socket.

    Args:
        host: IPv4 address.
        port: Port number; 0: the system chooses one.
        send_buffer_bytes: Size of the system's buffers of bytes that clients have not read; 0: the system's choice.

    Raises:
        OSError: The address cannot be listened on.
    """

    def __init__(self, host: str, port: int, send_buffer_bytes: int = 0) -> None:
        self._send_buffer_bytes = send_buffer_bytes
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._sock.setblocking(False)
            self._sock.bind((host, port))
            self._sock.listen(64)
        except OSError:
            self._sock.close()
            raise

    @property
    def port(self) -> int:
        """See `Listener`."""
        return int(self._sock.getsockname()[1])

    def fileno(self) -> int:
        """See `Listener`."""
        return self._sock.fileno()

    def accept_now(self) -> TcpTransport | None:
        """See `Listener`."""
        try:
            sock, _ = self._sock.accept()
        except BlockingIOError:
            return None
        if self._send_buffer_bytes:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._send_buffer_bytes)
        return TcpTransport(sock, quick=True)

    def close(self) -> None:
        """See `Listener`."""
        self._sock.close()
