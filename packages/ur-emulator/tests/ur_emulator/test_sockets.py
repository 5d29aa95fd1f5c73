"""Sockets of an emulated controller, and their injected faults."""

import logging
import socket
import time

import pytest

from tests.ur_emulator import rtde_bytes
from ur_core.errors import AddressError, ProtocolError
from ur_core.protocol.rtde import FrameReader, Kind
from ur_emulator.addresses import check_loopback, listening
from ur_emulator.ports.link_faults import LinkFaults
from ur_emulator.ports.sockets import MAX_CONNECTIONS, Hub

HOST = "127.0.0.1"


class Echo:
    """Peer that echoes its input; `!` violates its protocol."""

    finished = False

    def __init__(self):
        self.ended = 0
        self.got = b""
        self.mute = False

    def received(self, data):
        self.got += data
        if b"!" in data:
            raise ProtocolError("this protocol has no '!'")
        if b"bye" in data:
            self.finished = True
        return b"" if self.mute else data

    def closed(self):
        self.ended += 1


class Harness:
    def __init__(self):
        self.hub = Hub(seed=1)
        self.peers = []
        self.port = self.hub.add("echo", (HOST, 0), self.peer, lambda: b"hello\n")
        self.clients = []

    def peer(self):
        self.peers.append(Echo())
        return self.peers[-1]

    def client(self, *, greeted=True):
        client = socket.create_connection((HOST, self.port.number), timeout=2.0)
        client.setblocking(False)
        self.clients.append(client)
        self.serve()
        if greeted:
            assert self.read(client) == b"hello\n"
        return client

    def serve(self, seconds=0.01):
        self.hub.poll(time.monotonic() + seconds)

    def read(self, client):
        self.serve()
        try:
            return client.recv(1 << 20)
        except BlockingIOError:
            return None

    def answer(self, client, data):
        client.sendall(data)
        return self.read(client)


@pytest.fixture
def harness():
    made = Harness()
    yield made
    for client in made.clients:
        client.close()
    made.hub.close()


def test_clients_are_answered(harness):
    first, second = harness.client(), harness.client()
    assert harness.answer(first, b"one") == b"one"
    assert harness.answer(second, b"two") == b"two"
    first.close()
    harness.serve()
    assert len(harness.port.connections) == 1
    assert harness.peers[0].ended == 1
    assert harness.answer(second, b"still here") == b"still here"


def test_packets_are_sent_at_once(harness):
    harness.client()
    assert harness.port.connections[0].transport._sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_client_that_breaks_the_protocol_is_closed_and_named(harness, caplog):
    bad, good = harness.client(), harness.client()
    with caplog.at_level(logging.WARNING):
        assert harness.answer(bad, b"!") == b""
    assert "echo" in caplog.text
    assert "no '!'" in caplog.text
    assert harness.answer(good, b"fine") == b"fine"


def test_a_peer_that_is_finished_is_closed_after_its_answer(harness):
    client = harness.client()
    assert harness.answer(client, b"bye") == b"bye"
    assert harness.read(client) == b""


@pytest.mark.parametrize(("frozen", "mute"), [(False, True), (False, False), (True, True)])
def test_the_last_bytes_of_a_disconnected_client_take_effect(harness, frozen, mute):
    """Many clients send a program and close at once, with the stream unread: the end arrives as a reset."""
    client = harness.client(greeted=False)
    harness.port.inject(frozen=frozen)
    harness.peers[0].mute = mute
    program = 42_000 * b"-" + b"\n"  # as long as that of ur_rtde
    client.sendall(program)
    client.close()
    harness.port.broadcast(lambda: b"a packet of the stream")
    assert harness.peers[0].got == (b"" if frozen else program)
    assert harness.port.connections == []
    assert harness.peers[0].ended == 1


def test_a_client_that_never_reads_loses_packets(harness):
    lazy, eager = harness.client(), harness.client()
    packet = bytes(1000)
    got = 0
    for _ in range(4000):
        harness.port.broadcast(lambda: packet)
        harness.hub.poll(0.0)
        got += len(eager.recv(1 << 20))
    connection = harness.port.connections[0]
    assert connection.dropped > 500
    assert len(connection._out) < 2000
    assert got == 4000 * len(packet)
    # What arrives is whole packets all the same.
    lazy.settimeout(0.2)
    total = 0
    try:
        while data := lazy.recv(1 << 20):
            total += len(data)
            harness.hub.poll(0.0)
    except TimeoutError:
        pass
    assert total % len(packet) == 0
    assert total == (4000 - connection.dropped) * len(packet)


def test_a_packet_that_nobody_takes_is_not_encoded(harness):
    harness.client()
    packets = iter([bytes(1000)] * 4000)
    for _ in range(4000):
        harness.port.broadcast(lambda: next(packets))
    connection = harness.port.connections[0]
    assert connection.dropped > 500
    assert len(list(packets)) == connection.dropped
    harness.port.inject(lose=1)  # which counts packets that are encoded
    harness.port.broadcast(lambda: bytes(1000))
    assert harness.port.faults.lose == 0


def test_a_client_that_never_reads_its_answers_is_closed(harness, caplog):
    lazy, other = harness.client(), harness.client()
    connection = harness.port.connections[0]
    question = bytes(60_000)
    for _ in range(400):
        try:
            lazy.send(question)
        except BlockingIOError:
            pass
        except OSError:
            break
        harness.hub.poll(0.0)
        if not connection.open:
            break
    assert not connection.open
    assert "does not read" in caplog.text
    assert harness.answer(other, b"fine") == b"fine"


def test_excess_clients_are_refused(harness):
    clients = [harness.client() for _ in range(MAX_CONNECTIONS)]
    late = harness.client(greeted=False)
    assert harness.read(late) in (b"", None)
    assert len(harness.port.connections) == MAX_CONNECTIONS
    assert harness.answer(clients[-1], b"fine") == b"fine"
    clients[0].close()
    harness.serve()
    harness.client()


def test_a_thousand_connections_leave_nothing_behind(harness):
    first = harness.client()
    for _ in range(1000):
        with socket.create_connection((HOST, harness.port.number), timeout=2.0):
            harness.hub.poll(0.0)
    harness.serve()
    assert harness.answer(first, b"fine") == b"fine"
    assert len(harness.port.connections) == 1


# Faults.


def test_a_muted_port_is_silent(harness):
    client = harness.client()
    harness.port.inject(mute=True)
    assert harness.answer(client, b"anyone?") is None
    harness.port.inject(mute=False)
    assert harness.answer(client, b"ah") == b"ah"


def test_a_frozen_port_reads_later(harness):
    client = harness.client()
    harness.port.inject(frozen=True)
    harness.port.connections[0].flush()
    assert harness.answer(client, b"later") is None
    harness.port.inject(frozen=False)
    harness.port.connections[0].flush()
    assert harness.read(client) == b"later"


def test_a_half_open_port_accepts_and_sends_nothing(harness):
    harness.port.inject(half_open=True)
    client = harness.client(greeted=False)
    assert harness.answer(client, b"anyone?") is None


def test_delayed_bytes_keep_their_order(harness):
    client = harness.client()
    harness.port.inject(delay_s=0.02, jitter_s=0.03)
    begin = time.monotonic()
    for number in range(20):
        client.sendall(b"%02d" % number)
        harness.serve(0.001)
    got = b""
    while len(got) < 40 and time.monotonic() < begin + 5.0:
        got += harness.read(client) or b""
        if got and time.monotonic() < begin + 0.02:
            pytest.fail("it came before its time")
    assert got == b"".join(b"%02d" % number for number in range(20))


def test_lost_packets_are_those_of_streams(harness):
    client = harness.client()
    harness.port.inject(lose=2)
    assert harness.answer(client, b"answered") == b"answered"
    for number in range(4):
        harness.port.broadcast(lambda number=number: b"%d" % number)
    assert harness.read(client) == b"23"


def test_one_byte_of_a_packet_is_changed(harness):
    client = harness.client()
    harness.port.inject(corrupt=1)
    sent = bytes(range(100, 150))
    got = harness.answer(client, sent)
    assert len(got) == len(sent)
    assert sum(a != b for a, b in zip(sent, got, strict=True)) == 1
    assert harness.answer(client, sent) == sent


def test_a_port_that_refuses_keeps_its_clients(harness):
    client = harness.client()
    number = harness.port.number
    harness.port.refuse()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((HOST, number), timeout=2.0)
    assert harness.answer(client, b"fine") == b"fine"


def test_a_reset_is_seen_as_one(harness):
    client = harness.client()
    harness.port.disconnect("a test", reset=True)
    with pytest.raises(ConnectionResetError):
        client.recv(10)
    other = harness.client()
    harness.port.disconnect("a test")
    assert other.recv(10) == b""


# Addresses.


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "192.168.0.1", "10.0.0.1", "::1", "localhost", "127.0.0.1 ", "", "128.0.0.1", "127.1", "ü"]
)
def test_other_addresses_than_loopback_are_refused(host):
    with pytest.raises(AddressError, match="loopback"):
        check_loopback(host)
    with pytest.raises(AddressError, match="loopback"):
        listening((host, 0))


def test_a_taken_address_is_reported(harness):
    with pytest.raises(AddressError, match="taken by another program"):
        listening((HOST, harness.port.number))


def test_an_address_that_does_not_exist_says_so(monkeypatch):
    import errno

    def bind(self, address):
        raise OSError(errno.EADDRNOTAVAIL, "cannot assign")

    class Socket(socket.socket):
        pass

    Socket.bind = bind
    monkeypatch.setattr(socket, "socket", Socket)
    with pytest.raises(AddressError, match="alias"):
        listening(("127.9.9.9", 0))


def test_an_error_of_ours_ends_one_connection_only(harness, monkeypatch, caplog):
    first, second = harness.client(), harness.client()

    def broken(data):
        raise AttributeError("a mistake")

    monkeypatch.setattr(harness.peers[0], "received", broken)
    assert harness.answer(first, b"x") == b""
    assert "a mistake" in caplog.text
    assert harness.answer(second, b"fine") == b"fine"


def test_damaged_packages_have_a_consistent_length():
    package = rtde_bytes.data(1, "3B", 1, 2, 3)
    for name, payload in (
        ("short", b"\x01\x01\x02"),
        ("long", b"\x01\x01\x02\x03\0"),
        ("foreign", b"\xfe\x01\x02\x03"),
    ):
        faults = LinkFaults(**{name: 1})
        assert list(FrameReader().feed(faults.damage(package))) == [(Kind.DATA_PACKAGE, payload)]
        assert faults == LinkFaults()
        assert faults.damage(package) == package
