"""Small servers, for behaviour that an emulated controller does not have."""

import contextlib
import socket
import struct
import threading

DEADLINE_S = 20.0


@contextlib.contextmanager
def serving(talk):
    """Yield the port of a server at 127.0.0.1 that runs `talk(connection)` for its first client.

    Its errors are raised at the end of the block, unless the client went away.
    """
    errors = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(DEADLINE_S)

        def run():
            try:
                connection, _ = listener.accept()
                with connection:
                    connection.settimeout(DEADLINE_S)
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    talk(connection)
            except ConnectionError:
                pass
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            thread.join(DEADLINE_S)
    assert not thread.is_alive()
    if errors:
        raise errors[0]


def exactly(connection, count):
    data = b""
    while len(data) < count:
        more = connection.recv(count - len(data))
        if not more:
            raise ConnectionError
        data += more
    return data


def until_closed(connection):
    """Return everything that the client still sends."""
    found = b""
    with contextlib.suppress(ConnectionError):
        while data := connection.recv(65536):
            found += data
    return found


def rtde_frame(kind, payload=b""):
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def rtde_request(connection):
    """Return kind and payload of the client's next package."""
    size, kind = struct.unpack(">HB", exactly(connection, 3))
    return chr(kind), exactly(connection, size - 3)


ANSWERS = {"V": b"\1", "v": struct.pack(">4I", 3, 15, 8, 1), "O": b"\1DOUBLE,INT32", "S": b"\1"}
"""Answers to a client that reads `timestamp` and `robot_mode`."""


def rtde_talk(connection, **answers):
    """Answer the requests of a link up to its start; `answers` replace `ANSWERS`."""
    wanted = {**ANSWERS, **answers}
    for kind in "VvOS":
        assert rtde_request(connection)[0] == kind
        connection.sendall(rtde_frame(kind, wanted[kind]))


def rtde_data(timestamp_s, mode=7, recipe=1):
    return rtde_frame("U", struct.pack(">Bdi", recipe, timestamp_s, mode))
