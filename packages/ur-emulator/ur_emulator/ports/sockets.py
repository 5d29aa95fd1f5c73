"""Non-blocking connections of emulated controllers, with injected link faults."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final, Protocol

from ur_core.errors import ProtocolError
from ur_core.processes.system import LOCAL, System
from ur_core.processes.transport import Listener, Transport
from ur_emulator.addresses import listening
from ur_emulator.ports.link_faults import DelayLine, LinkFaults

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 32
"""Concurrent clients of one port. More are closed at once. UR publishes no figure."""

_RECEIVE_BYTES: Final = 8192  # per read, so that a busy client cannot delay the others
_MAX_WAITING_BYTES: Final = 262_144  # unread by a client: beyond this, packets are dropped or it is disconnected
_SEND_BUFFER_BYTES: Final = 65_536
_SERVED_S: Final = 0.001  # time for clients in a control period that is already late


class Peer(Protocol):
    """Protocol handler of one client: bytes in, bytes out, no sockets."""

    @property
    def finished(self) -> bool:
        """True if the connection is to be closed after the last answer."""
        ...

    def received(self, data: bytes) -> bytes:
        """Answer received bytes.

        Raises:
            ProtocolError: The connection must be closed.
        """

    def closed(self) -> None:
        """React to the end of the connection."""


class Connection:
    """One client.

    Attributes:
        dropped: Packets dropped because the client was slow.
    """

    def __init__(self, hub: Hub, transport: Transport, peer: Peer, port: Port) -> None:
        self.hub, self.transport, self.peer, self.port = hub, transport, peer, port
        self.dropped = 0
        self.served = 0
        self.open = True
        self.half_open = port.faults.half_open
        self._gone = False
        self._number = transport.fileno()
        self._out = bytearray()
        self._coming, self._going = DelayLine(), DelayLine()

    def drop(self) -> bool:
        """Drop one packet of a stream if it would be dropped anyway, so that nobody encodes it. Return True if so."""
        if not self._out or self.port.faulty or self._going.waiting:
            return False
        self.dropped += 1
        return True

    def send(self, data: bytes, *, droppable: bool = False) -> None:
        """Send, or queue unsent bytes.

        Args:
            data: Bytes.
            droppable: Whether they are one packet of a stream, which is dropped as a whole when the client is slow.
        """
        if not data or not self.open or self._gone:
            return
        if not (self.port.faulty or self.half_open or self._going.waiting):
            self._write(data, droppable)
            return
        faults = self.port.faults
        if faults.mute or self.half_open:
            return
        if droppable and faults.lose > 0:
            faults.lose -= 1
            return
        if droppable:
            data = faults.damage(data)
        if faults.corrupt > 0:
            faults.corrupt -= 1
            where = self.hub.random.randrange(len(data))
            data = data[:where] + bytes([data[where] ^ 0xFF]) + data[where + 1 :]
        if faults.delay_s or faults.jitter_s or self._going.waiting:
            self._going.put(self.hub.due(faults), data, droppable)
            self._note()
        else:
            self._write(data, droppable)

    def _write(self, data: bytes, droppable: bool) -> None:
        if droppable and self._out:
            self.dropped += 1
            return
        if not self._out:
            try:
                sent = self.transport.send_now(data)
            except OSError:
                sent = 0  # `flush` meets the same error, and handles it
            if sent == len(data):
                return
            data = data[sent:]
        self._out += data
        self.flush()
        if len(self._out) > _MAX_WAITING_BYTES:
            self.close("it does not read its answers")

    def fileno(self) -> int:
        """Return the file number of the transport."""
        return self._number

    @property
    def reads(self) -> bool:
        """True if bytes of the client are taken."""
        return not self.port.faults.frozen

    def _note(self) -> None:
        """Tell the hub whether bytes wait for the client or for their time of arrival."""
        if self.open and self._out:
            self.hub.unsent[self._number] = self
        else:
            self.hub.unsent.pop(self._number, None)
        if self.open and (self._coming.waiting or self._going.waiting):
            self.hub.delayed[self] = None
        else:
            self.hub.delayed.pop(self, None)

    def flush(self) -> None:
        """Send queued bytes, as far as the client accepts them."""
        if not self.open:
            return
        try:
            if self._out:
                del self._out[: self.transport.send_now(self._out)]
        except OSError:
            # The client has gone. Its last bytes may be unread, and a program in them still runs.
            self._out.clear()
            self._gone = True
            while self.reads and self.read():
                pass
            self.close("")
        self._note()

    def read(self) -> bool:
        """Receive bytes and answer them. Return False if there were none."""
        try:
            data = self.transport.receive_now(_RECEIVE_BYTES)
        except OSError:  # reset by the client
            data = b""
        if data is None:
            return False
        if not data:
            self.close("")
            return False
        faults = self.port.faults
        if self._coming.waiting or faults.delay_s or faults.jitter_s:
            self._coming.put(self.hub.due(faults), data)
            self._note()
        else:
            self._take(data)
        return True

    def _take(self, data: bytes) -> None:
        if self.half_open or not self.open:
            return
        try:
            reply = self.peer.received(data)
        except ProtocolError as error:
            self.close(str(error))
            return
        except Exception:  # a bug must not end the other connections, let alone the other arm
            log.exception("%s: a client is disconnected after an internal error", self.port.name)
            self.close("an error inside the emulated cell")
            return
        self.send(reply)
        if self.peer.finished:
            self.close("")

    @property
    def next_s(self) -> float:
        """Arrival time of the next delayed bytes."""
        return min(self._coming.next_s, self._going.next_s)

    def deliver(self, now_s: float) -> None:
        """Deliver delayed bytes that are due."""
        for data, _ in self._coming.due(now_s):
            self._take(data)
        for data, droppable in self._going.due(now_s):
            if self.open:
                self._write(data, droppable)
        self._note()

    def close(self, reason: str, *, reset: bool = False) -> None:
        """End the connection. May be called twice.

        Args:
            reason: Reason for the log; "" if the client or the emulator ended it.
            reset: Whether to send a reset instead of an end.
        """
        if not self.open:
            return
        self.open = False
        if reason:
            log.warning("%s: a client is disconnected: %s", self.port.name, reason)
        self.port.connections.remove(self)
        self._note()
        self.hub.changed()
        self.transport.close(reset=reset)
        self.peer.closed()


class Port:
    """One listening port and its clients.

    Args:
        hub: Hub of all ports.
        name: Name for the log.
        address: Host and port.
        accept: Factory of the peer of a new client.
        greeting: Factory of the first bytes for every client.

    Attributes:
        faults: Injected faults. Change them with `inject`.
        faulty: True if some were injected and not removed since.
    """

    def __init__(
        self, hub: Hub, name: str, address: tuple[str, int], accept: Callable[[], Peer], greeting: Callable[[], bytes]
    ) -> None:
        self.hub, self.name, self.address = hub, name, address
        self.faults, self.faulty = LinkFaults(), False
        self.connections: list[Connection] = []
        self.served = 0  # hub's count at its last service
        self._accept, self._greeting = accept, greeting
        self._listener: Listener | None = None
        self.listen()

    def inject(self, **faults: Any) -> None:
        """Inject faults; see `LinkFaults`. Those that are not named stay as they are."""
        for name, value in faults.items():
            setattr(self.faults, name, value)
        self.faulty = self.faults != LinkFaults()
        self.hub.changed()  # a frozen port is not read

    def listen(self) -> None:
        """Listen, if it does not already.

        Raises:
            AddressError: The address cannot be used.
        """
        if self._listener is None:
            self._listener = listening(self.address, self.hub.system, _SEND_BUFFER_BYTES)
            self.hub.changed()

    @property
    def number(self) -> int:
        """Port number, also where the system chose it."""
        return self.address[1] if self._listener is None else self._listener.port

    def refuse(self) -> None:
        """Stop listening, so that new clients are refused. Connected clients stay."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self.hub.changed()

    @property
    def reads(self) -> bool:
        """True if it accepts clients."""
        return self._listener is not None

    def fileno(self) -> int:
        """Return the file number of the listener; -1 if it does not listen."""
        return -1 if self._listener is None else self._listener.fileno()

    def accept(self) -> None:
        """Accept a new client."""
        if self._listener is None:
            return
        try:
            transport = self._listener.accept_now()
        except OSError as error:
            log.warning("%s: a client could not be accepted: %s", self.name, error)
            return
        if transport is None:
            return
        if len(self.connections) >= MAX_CONNECTIONS:
            log.warning("%s: a client is refused: there are %d already", self.name, len(self.connections))
            transport.close()
            return
        connection = Connection(self.hub, transport, self._accept(), self)
        self.connections.append(connection)
        self.hub.changed()
        connection.send(self._greeting())

    def broadcast(self, encode: Callable[[], bytes]) -> None:
        """Send one packet of a stream to all clients. It is encoded only if somebody takes it."""
        data = b""
        for connection in list(self.connections):
            if not connection.drop():
                data = data or encode()
                connection.send(data, droppable=True)

    def disconnect(self, reason: str, *, reset: bool = False, whose: Callable[[Peer], bool] = lambda _: True) -> None:
        """Close all connections, or those of selected peers."""
        for connection in list(self.connections):
            if whose(connection.peer):
                connection.close(reason, reset=reset)

    def close(self) -> None:
        """Close the connections and stop listening."""
        self.disconnect("")
        self.refuse()


_served: Final = attrgetter("served")


class Hub:
    """All ports and connections of an emulated cell, on one thread.

    Args:
        seed: Seed of random faults.
        system: Clock and network.

    Attributes:
        unsent: Connections with bytes that wait for the client, by file number, in order.
        delayed: Connections with bytes that wait for their time of arrival, in order.
    """

    def __init__(self, seed: int = 0, *, system: System = LOCAL) -> None:
        self.system, self._clock = system, system.clock
        self.random = random.Random(seed)
        self.ports: list[Port] = []
        self.unsent: dict[int, Connection] = {}
        self.delayed: dict[Connection, None] = {}
        self._served = 0
        self._serves: dict[int, Port | Connection] | None = None
        self._readers: list[int] = []

    def add(
        self, name: str, address: tuple[str, int], accept: Callable[[], Peer], greeting: Callable[[], bytes] = bytes
    ) -> Port:
        """Listen on a port.

        Raises:
            AddressError: The address cannot be used.
        """
        port = Port(self, name, address, accept, greeting)
        self.ports.append(port)
        return port

    def due(self, faults: LinkFaults) -> float:
        """Return the arrival time of bytes sent or received now."""
        return self._clock.now_s() + faults.delay_s + faults.jitter_s * self.random.random()

    def changed(self) -> None:
        """React to new, closed or frozen ports and connections."""
        self._serves = None

    def _numbered(self) -> dict[int, Port | Connection]:
        """Return all ports and connections that are read, by file number."""
        serves: list[Port | Connection] = [each for each in self.ports if each.reads]
        serves += [each for port in self.ports for each in port.connections if each.reads]
        self._serves = {each.fileno(): each for each in serves}
        self._readers = list(self._serves)
        return self._serves

    def poll(self, until_s: float) -> None:
        """Serve clients until a time of the clock; at least once."""
        clock = self._clock
        end = max(until_s, clock.now_s() + _SERVED_S)
        while True:
            serves = self._serves or self._numbered()
            wake_s = min((each.next_s for each in self.delayed), default=until_s) if self.delayed else until_s
            readable, writable = clock.wait(self._readers, min(wake_s, until_s), tuple(self.unsent))
            for number in writable:
                if number in self.unsent:
                    self.unsent[number].flush()
            ready = [serves[number] for number in readable]
            if len(ready) > 1:  # longest-waiting first, so that no client starves where time is short
                ready.sort(key=_served)
            for serve in ready:
                self._served += 1
                serve.served = self._served
                if isinstance(serve, Port):
                    serve.accept()
                elif serve.open:
                    serve.read()
                if clock.now_s() > end:
                    break  # the others are served after the control period
            now = clock.now_s()
            for connection in tuple(self.delayed):
                connection.deliver(now)
            if now >= until_s:
                return

    def close(self) -> None:
        """End everything."""
        for port in self.ports:
            port.close()
