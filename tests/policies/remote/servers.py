"""Policy servers of tests: stand-ins that answer with given messages, over real sockets on a loopback address."""

import contextlib
import threading

import msgspec
import numpy as np
import websockets.sync.server

from dual_ur10.policies.remote.wire import packed


def as_openpi(array):
    """Return an array as openpi's client and server write it."""
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}


@contextlib.contextmanager
def stand_in(answers, metadata=None, greeting=None):
    """Serve messages, in their order, to one client; yield the address and what was received.

    Args:
        answers: Messages, or functions of the decoded request that return one; a list: several; None: nothing is sent;
            Ellipsis: the connection is closed.
        metadata: Content of the first message.
        greeting: First message in place of the metadata.
    """
    received = []

    def handle(connection):
        connection.send(packed(metadata or {}) if greeting is None else greeting)
        for message, answer in zip(connection, answers, strict=False):
            received.append(msgspec.msgpack.decode(message))
            found = answer(received[-1]) if callable(answer) else answer
            if found is ...:
                return
            for each in found if isinstance(found, list) else [] if found is None else [found]:
                connection.send(each)
        connection.recv()

    with websockets.sync.server.serve(handle, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}", received
        finally:
            server.shutdown()
            thread.join()


def chunk_of(rows, **more):
    """Return the message of a chunk."""
    return msgspec.msgpack.encode({"actions": as_openpi(np.asarray(rows)), **more})
