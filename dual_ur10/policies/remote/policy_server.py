"""Server of a policy, by openpi's WebSocket protocol."""

from __future__ import annotations

import hmac
import http
import ipaddress
import logging
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any, Final, Self

import numpy as np
import websockets.sync.server

from dual_ur10.errors import ActionError, ChunkError, DualUR10Error, PolicyServerError, SettingsError
from dual_ur10.policies.chunks.chunk_policy import ChunkPolicy
from dual_ur10.policies.remote.wire import MOST_BYTES, packed, unpacked

SILENT_S: Final = 60.0
"""Time without a message after which a client makes way for another one: it may be stopped, and not gone."""

_TURN_S: Final = 1.0
_PROBES: Final = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 25_000}
"""Options that end the connection of a machine that is silent for 25 s, as far as the platform has them."""

_LOG: Final = logging.getLogger(__name__)


class PolicyServer:
    """Server that answers each observation with a chunk of actions, to one client at a time.

    A client that has sent nothing for `SILENT_S` makes way for the next one.

    It answers `{"observation": ...}`, with `{"actions": (H, D), "server_timing": {"infer_ms": ...}}`. A chunk policy
    also gets the number under "time_s", or 0. `{"endpoint": "reset"}` resets the policy, and so does each connection.
    An error is a text, after which the connection is closed. `GET /healthz` answers OK.

    Args:
        policy: A policy, whose chunks have one action, or a chunk policy.
        metadata: Sent to each client first.
        host: Address to listen on.
        port: Port; 0: any that is free.
        token: Text that clients must send as "Authorization: Api-Key ..."; None: none, on loopback addresses only.

    Attributes:
        address: Address for clients, such as "ws://127.0.0.1:8000".

    Raises:
        SettingsError: The address is not a loopback one and there is no token, or it cannot be listened on.
    """

    def __init__(
        self,
        policy: Any,
        metadata: Mapping[str, Any],
        *,
        host: str = "127.0.0.1",
        port: int = 8000,
        token: str | None = None,
    ) -> None:
        try:
            parsed = ipaddress.ip_address(host)
        except ValueError:
            raise SettingsError(f"{host!r:.80} is no IP address, such as 127.0.0.1 or 192.168.1.10") from None
        if not parsed.is_loopback and token is None:
            raise SettingsError(
                f"a server on {host} answers other machines: give it a token, with which clients must come"
            )
        self._policy, self._metadata, self._token = policy, packed(dict(metadata)), token
        self._turn = threading.Lock()
        self._silent: tuple[Any, float] | None = None  # the client, and since when it is waited for
        try:
            self._server = websockets.sync.server.serve(
                self._serve,
                host,
                port,
                family=socket.AF_INET if parsed.version == 4 else socket.AF_INET6,
                max_size=MOST_BYTES,
                compression=None,
                close_timeout=_TURN_S,
                ping_interval=None,  # a client that waits for its turn in a loop of its own does not answer
                origins=[None],  # no page of a browser
                process_request=self._admit,
            )
        except OSError as error:
            raise SettingsError(f"no server on {host}:{port}: {error}; choose another port") from error
        shown = f"[{host}]" if ":" in host else host
        self.address = f"ws://{shown}:{self._server.socket.getsockname()[1]}"
        self._thread: threading.Thread | None = None

    def run(self) -> None:
        """Serve until `close` is called from another thread, or Ctrl-C."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop serving. May be called twice."""
        self._server.shutdown()
        if self._thread is not None:
            self._thread.join()

    def __enter__(self) -> Self:
        """Serve in a thread."""
        self._thread = threading.Thread(target=self.run, name="policy server", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _admit(self, connection: Any, request: Any) -> Any:
        """Answer a health check, and refuse clients without the token."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "")
        if self._token is not None and not hmac.compare_digest(given.encode(), f"Api-Key {self._token}".encode()):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "the token is missing or wrong\n")
        return None

    def _serve(self, connection: Any) -> None:
        """Answer one client."""
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _PROBES.items():
            if hasattr(socket, name):
                connection.socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        if not self._has_turn():
            _end(connection, "busy: this server answers one client at a time")
            return
        try:
            self._policy.reset()
            connection.send(self._metadata)
            self._silent = connection, time.monotonic()
            for message in connection:
                self._silent = None
                connection.send(self._answered(message))
                self._silent = connection, time.monotonic()
        except websockets.exceptions.ConnectionClosed:
            pass
        except DualUR10Error as error:
            _end(connection, str(error))
        except Exception as error:
            _LOG.exception("the policy failed")
            _end(connection, f"the policy failed: {type(error).__name__}: {error}")
        finally:
            self._silent = None
            self._turn.release()

    def _has_turn(self) -> bool:
        """Wait for the turn, and return True if it has come; a silent client makes way."""
        if self._turn.acquire(timeout=_TURN_S):  # a client that comes back may be sooner than its own end
            return True
        silent = self._silent
        if silent is None or time.monotonic() - silent[1] < SILENT_S:
            return False
        _end(silent[0], f"another client came, and this one had sent nothing for {SILENT_S:g} s: connect again")
        return self._turn.acquire(timeout=_TURN_S)

    def _answered(self, message: Any) -> bytes:
        """Return the answer to a message.

        Raises:
            PolicyServerError: It is none, or holds no observation.
            Exception: As raised by the policy.
        """
        if not isinstance(message, bytes):
            raise PolicyServerError("a request is a binary message of msgpack, found a text")
        request = unpacked(message, "the client")
        if not isinstance(request, dict):
            raise PolicyServerError(f"a request is a dict, found {type(request).__name__}")
        endpoint = request.get("endpoint", "infer")
        if endpoint == "reset":
            self._policy.reset()
            return packed({"status": "reset"})
        if endpoint != "infer" or "observation" not in request:
            raise PolicyServerError(
                f"a request of the endpoint {endpoint!r:.40} with {', '.join(map(repr, request))[:200]}: send "
                '{"observation": ...} to "infer", or {"endpoint": "reset"}'
            )
        observation, time_s = request["observation"], request.get("time_s", 0.0)
        if not isinstance(time_s, int | float):
            raise PolicyServerError(f"time_s is {type(time_s).__name__}: it must be a number")
        began_s = time.perf_counter()
        if isinstance(self._policy, ChunkPolicy):
            actions = np.asarray(self._policy.chunk(observation, float(time_s)))
        else:
            if not isinstance(observation, np.ndarray):
                raise ActionError(f"an observation is an array, found {type(observation).__name__}")
            actions = np.asarray(self._policy(observation))[None]
        if actions.ndim != 2:
            raise ChunkError(f"the policy returned actions of shape {actions.shape}")
        taken_ms = 1e3 * (time.perf_counter() - began_s)
        return packed({"actions": actions, "server_timing": {"infer_ms": taken_ms}})


def _end(connection: Any, text: str) -> None:
    """Send an error as a text, and close the connection."""
    try:
        connection.send(text)
        connection.close(1011, text.encode()[:120].decode(errors="ignore"))
    except websockets.exceptions.ConnectionClosed:
        pass
