"""Connections that are closed in bounded time, after the controller has seen it."""

import time

import pytest

from tests.links.fake_servers import DEADLINE_S, serving, until_closed
from ur_core.errors import ClosedError, LinkError
from ur_core.links.link_socket import LinkSocket

HERE = "127.0.0.1"


def soon(seconds=DEADLINE_S):
    return time.monotonic() + seconds


def test_closing_waits_until_the_controller_has_seen_it():
    seen = []

    def talk(connection):
        connection.sendall(b"data that nobody reads")
        seen.append(until_closed(connection))
        time.sleep(0.2)
        seen.append("closed")

    with serving(talk) as port:
        socket = LinkSocket("left", "RTDE", HERE, port, soon())
        socket.send(b"last words", soon())
        socket.close_and_wait(soon())
        assert seen == [b"last words", "closed"]
        with pytest.raises(ClosedError, match="left arm, RTDE at"):
            socket.receive(soon())
        socket.close_and_wait(soon())


def test_the_wait_for_a_controller_that_does_not_close_is_bounded():
    done = []

    def talk(connection):
        while not done:
            connection.sendall(b"more and more")
            time.sleep(0.01)

    with serving(talk) as port:
        socket = LinkSocket("", "RTDE", HERE, port, soon())
        socket.close_and_wait(soon(0.2))
        done.append(True)
        with pytest.raises(ClosedError):
            socket.fileno()


def test_a_deadline_that_has_passed_sends_and_reads_nothing():
    sent = []
    with serving(lambda connection: sent.append(until_closed(connection))) as port:
        with LinkSocket("", "RTDE", HERE, port, soon()) as socket:
            for use in (lambda: socket.send(b"late", soon(-1.0)), lambda: socket.receive(soon(-1.0))):
                with pytest.raises(LinkError, match="no answer in time"):
                    use()
        with pytest.raises(LinkError, match="no answer in time"):
            LinkSocket("", "RTDE", HERE, port, soon(-1.0))
    assert sent == [b""]


def test_a_peer_that_does_not_read_is_an_error():
    done = []

    def talk(connection):
        while not done:
            time.sleep(0.01)

    with serving(talk) as port, LinkSocket("", "RTDE", HERE, port, soon()) as socket:
        with pytest.raises(LinkError, match="no answer in time"):
            socket.send(b"x" * 50_000_000, soon(0.3))
        done.append(True)
