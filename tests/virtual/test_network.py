"""Connections in memory: bytes in order, ends of streams, resets, full buffers and refused ports, as TCP has them."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from ur_emulator.virtual.network import MemoryTransport, VirtualNetwork
from ur_emulator.virtual.scheduler import BEGIN_S, Group, Scheduler, VirtualClock

HOST, PORT = "127.0.0.2", 30004


class Net:
    """Network with a server's and a client's process."""

    def __init__(self):
        self.scheduler = Scheduler()
        self.network, self.clock = VirtualNetwork(self.scheduler), VirtualClock(self.scheduler)
        self.server, self.client = Group("server"), Group("client")

    def listen(self, port=PORT, size=0):
        return self.network.listen(HOST, port, self.server, size)

    def connect(self, port=PORT):
        return self.network.connect(HOST, port, self.client)

    def pair(self, size=0):
        """Return the client's and the server's end of a new connection."""
        listener = self.listen(size=size)
        here, there = self.connect(), listener.accept_now()
        listener.close()
        return here, there


@pytest.fixture
def net():
    return Net()


# Bytes.


@settings(max_examples=scaled(100))
@given(
    st.lists(st.one_of(st.binary(max_size=30), st.integers(1, 20)), max_size=40),
    st.integers(1, 50),
)
def test_bytes_come_in_order_and_no_more_than_fit_are_on_their_way(steps, size):
    """Bytes are sent, numbers are sizes of reads."""
    here, there = Net().pair(size)
    sent, received = b"", b""
    for step in steps:
        if isinstance(step, bytes):
            count = here.send_now(step)
            assert count == min(len(step), size - (len(sent) - len(received)))
            sent += step[:count]
        else:
            data = there.receive_now(step)
            assert (data is None) == (sent == received)
            received += data or b""
        assert sent.startswith(received)
        assert there.readable == (sent != received)
        assert here.writable == (len(sent) - len(received) < size)


def test_both_directions_are_apart(net):
    here, there = net.pair()
    here.send_now(b"ask")
    there.send_now(b"answer")
    assert here.receive_now(100) == b"answer"
    assert there.receive_now(100) == b"ask"
    assert here.receive_now(100) is None


def test_a_full_buffer_takes_nothing_until_it_is_read(net):
    here, there = net.pair(size=10)
    assert here.send_now(b"x" * 25) == 10
    assert here.send_now(b"y") == 0
    assert not here.writable
    assert there.receive_now(4) == b"xxxx"
    assert here.send_now(b"yyyyyy") == 4


# Waiting.


def test_a_reader_wakes_when_bytes_come_and_a_writer_when_they_fit(net):
    here, there = net.pair(size=4)
    clock, seen = net.clock, []

    def serve():
        clock.sleep(1.0)
        there.send_now(b"hello")
        clock.sleep(2.0)
        there.receive_now(100)

    net.scheduler.start(serve, net.server, "server")
    assert clock.wait((here.fileno(),), math.inf) == ([here.fileno()], [])
    seen.append(clock.now_s() - BEGIN_S)
    here.send_now(b"full")
    assert clock.wait((), math.inf, (here.fileno(),)) == ([], [here.fileno()])
    seen.append(clock.now_s() - BEGIN_S)
    assert seen == [1.0, 3.0]


def test_a_wait_ends_with_its_time_and_leaves_nothing(net):
    here, _ = net.pair()
    assert net.clock.wait((here.fileno(),), BEGIN_S + 2.0) == ([], [])
    assert net.clock.now_s() == BEGIN_S + 2.0
    assert net.scheduler.waiting == {}


def test_one_of_several_wakes_the_waiting_one(net):
    first, second = net.pair(), net.pair()
    net.scheduler.start(lambda: (net.clock.sleep(1.0), second[1].send_now(b"x")), net.server, "server")
    files = [first[0].fileno(), second[0].fileno()]
    assert net.clock.wait(files, math.inf)[0] == files[1:]
    assert net.scheduler.waiting == {}


# Ends.


def test_the_end_of_a_stream_comes_behind_its_bytes(net):
    here, there = net.pair()
    here.send_now(b"last")
    here.close()
    assert there.receive_now(100) == b"last"
    assert there.receive_now(100) == b""
    assert there.receive_now(100) == b""
    with pytest.raises(BrokenPipeError):
        there.send_now(b"x")


def test_a_half_closed_connection_goes_on_in_the_other_direction(net):
    here, there = net.pair()
    here.send_now(b"all")
    here.end_sending()
    assert there.receive_now(100) == b"all"
    assert there.receive_now(100) == b""
    there.send_now(b"still here")
    assert here.receive_now(100) == b"still here"
    with pytest.raises(BrokenPipeError):
        here.send_now(b"more")


@pytest.mark.parametrize("unread", [False, True])
def test_a_reset_discards_what_is_on_its_way(net, unread):
    """Closing an end that has unread bytes is one, too."""
    here, there = net.pair()
    here.send_now(b"lost")
    if unread:
        there.send_now(b"unread")
    here.close(reset=not unread)
    for use in (lambda: there.receive_now(100), lambda: there.send_now(b"x")):
        with pytest.raises((ConnectionResetError, BrokenPipeError)):
            use()
    with pytest.raises(ConnectionResetError):
        there.receive_now(100)


def test_an_end_wakes_who_waits(net):
    here, there = net.pair()
    net.scheduler.start(lambda: (net.clock.sleep(1.0), there.close()), net.server, "server")
    assert net.clock.wait((here.fileno(),), math.inf)[0] == [here.fileno()]
    assert net.clock.now_s() == BEGIN_S + 1.0
    assert here.receive_now(1) == b""


def test_a_closed_end_cannot_be_used(net):
    here, _ = net.pair()
    here.close()
    here.close()
    for use in (lambda: here.send_now(b"x"), lambda: here.receive_now(1), here.end_sending):
        with pytest.raises(OSError, match=r"descriptor|not connected"):
            use()
    assert net.clock.wait((here.fileno(),), math.inf)[0] == [here.fileno()]


# Ports.


def test_a_port_without_a_listener_refuses(net):
    with pytest.raises(ConnectionRefusedError):
        net.connect()
    listener = net.listen()
    net.connect()
    listener.close()
    listener.close()
    with pytest.raises(ConnectionRefusedError):
        net.connect()
    net.listen()  # the port is free again


def test_a_port_is_listened_on_once(net):
    net.listen()
    with pytest.raises(OSError, match="in use"):
        net.listen()
    assert net.listen(port=0).port != net.listen(port=0).port


def test_clients_are_accepted_in_order(net):
    listener = net.listen()
    assert listener.accept_now() is None
    clients = [net.connect() for _ in range(3)]
    assert listener.readable
    for number, client in enumerate(clients):
        client.send_now(bytes([number]))
    assert [listener.accept_now().receive_now(1) for _ in clients] == [b"\0", b"\1", b"\2"]
    assert not listener.readable


def test_clients_that_wait_when_a_port_closes_are_reset(net):
    listener = net.listen()
    client = net.connect()
    listener.close()
    with pytest.raises(ConnectionResetError):
        client.receive_now(1)


def test_a_transport_without_a_peer_is_broken():
    with pytest.raises(BrokenPipeError):
        MemoryTransport(Scheduler()).send_now(b"x")
