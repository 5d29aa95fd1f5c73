"""Connections in memory between the actors of a virtual cell."""

from __future__ import annotations

import errno
import os
from collections import deque
from typing import Final

from ur_emulator.virtual.scheduler import Endpoint, Group, Scheduler

_BUFFER_BYTES: Final = 262_144
"""Bytes on their way in one direction, as in the buffers of both ends of a TCP connection."""

_FIRST_PORT: Final = 50_000  # that the network chooses


class MemoryTransport(Endpoint):
    """End of a connection, a `ur_core.processes.transport.Transport`.

    Args:
        scheduler: Scheduler of the actors.
        size: Bytes that may be on their way to this end.
    """

    def __init__(self, scheduler: Scheduler, size: int = _BUFFER_BYTES) -> None:
        super().__init__(scheduler)
        self._size = size
        self._data = bytearray()
        self._peer: MemoryTransport | None = None
        self._no_more = False  # the peer has ended its stream
        self._broken = False
        self.closed = False

    def join(self, peer: MemoryTransport) -> None:
        """Connect two ends."""
        self._peer, peer._peer = peer, self

    @property
    def readable(self) -> bool:  # type: ignore[override]  # an attribute of others
        """True if there are bytes, or the end of the stream."""
        return bool(self._data) or self._no_more or self._broken

    @property
    def writable(self) -> bool:  # type: ignore[override]  # likewise
        """True if bytes fit, or sending would fail."""
        peer = self._peer
        return self._broken or peer is None or peer.closed or peer._no_more or len(peer._data) < peer._size

    def send_now(self, data: bytes | bytearray | memoryview) -> int:
        """See `Transport`."""
        peer = self._peer
        if self.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        if self._broken or peer is None or peer.closed or peer._no_more:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        piece = data[: max(0, peer._size - len(peer._data))]
        if len(piece):
            peer._data += piece
            self._scheduler.readable.add(peer.number)
            self._scheduler.notify_readers(peer.number)
        return len(piece)

    def receive_now(self, size: int) -> bytes | None:
        """See `Transport`."""
        if self.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        if self._data:
            data = bytes(self._data[:size])
            del self._data[:size]
            self.update()
            if self._peer is not None:
                self._scheduler.notify_writers(self._peer.number)
            return data
        if self._broken:
            raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
        return b"" if self._no_more else None

    def end_sending(self) -> None:
        """See `Transport`."""
        peer = self._peer
        if self.closed or self._broken or peer is None:
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
        peer._no_more = True
        peer.note()

    def close(self, *, reset: bool = False) -> None:
        """See `Transport`. Unread bytes make it a reset, as in TCP."""
        if self.closed:
            return
        self.closed = True
        self._scheduler.forget_file(self.number)
        peer = self._peer
        if peer is not None and not peer.closed:
            peer._no_more = True
            if reset or self._data:
                peer._broken = True
                peer._data.clear()
            peer.note()


class MemoryListener(Endpoint):
    """Listening port, a `ur_core.processes.transport.Listener`."""

    def __init__(self, network: VirtualNetwork, address: tuple[str, int], group: Group, size: int) -> None:
        super().__init__(network.scheduler)
        self._network, self._address, self._group, self._size = network, address, group, size
        self._waiting: deque[MemoryTransport] = deque()
        self._closed = False

    @property
    def port(self) -> int:
        """See `Listener`."""
        return self._address[1]

    @property
    def readable(self) -> bool:  # type: ignore[override]  # an attribute of others
        """True if a client waits."""
        return bool(self._waiting)

    def reach(self) -> MemoryTransport:
        """Return the client's end of a new connection."""
        scheduler = self._network.scheduler
        here, there = MemoryTransport(scheduler), MemoryTransport(scheduler, self._size or _BUFFER_BYTES)
        here.join(there)
        self._waiting.append(there)
        self._group.endpoints.append(there)
        self.note()
        return here

    def accept_now(self) -> MemoryTransport | None:
        """See `Listener`."""
        transport = self._waiting.popleft() if self._waiting else None
        self.note()
        return transport

    def close(self) -> None:
        """See `Listener`."""
        if not self._closed:
            self._closed = True
            self._network.release(self._address)
            self._network.scheduler.forget_file(self.number)
            while self._waiting:
                self._waiting.popleft().close(reset=True)


class VirtualNetwork:
    """Listening ports of a virtual cell by address."""

    def __init__(self, scheduler: Scheduler) -> None:
        self.scheduler = scheduler
        self._listeners: dict[tuple[str, int], MemoryListener] = {}

    def listen(self, host: str, port: int, group: Group, send_buffer_bytes: int) -> MemoryListener:
        """Listen on a port; 0: the network chooses one.

        Raises:
            OSError: It is taken.
        """
        if not port:
            port = next(each for each in range(_FIRST_PORT, 2**16) if (host, each) not in self._listeners)
        if (host, port) in self._listeners:
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        listener = MemoryListener(self, (host, port), group, send_buffer_bytes)
        self._listeners[host, port] = listener
        group.endpoints.append(listener)
        return listener

    def release(self, address: tuple[str, int]) -> None:
        """Free an address."""
        self._listeners.pop(address, None)

    def connect(self, host: str, port: int, group: Group) -> MemoryTransport:
        """Connect to a port.

        Raises:
            OSError: Nothing listens there.
        """
        listener = self._listeners.get((host, port))
        if listener is None:
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
        transport = listener.reach()
        group.endpoints.append(transport)
        return transport
