"""Guards of the live page's server: loopback alone, its own origins alone, a token, and no tunnel.

viser listens on all interfaces, asks nobody who they are, and opens a public tunnel for whoever asks for one. Here it
gets a socket that is bound already, and the handshake of every connection is checked.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hmac
import http
import http.cookies
import socket
import urllib.parse
from collections.abc import Callable, Iterator
from typing import Any, Final

from dual_ur10.envs.rendering.live.overlay import STOP_PATH, Overlay
from dual_ur10.errors import MissingExtraError, SettingsError

LOOPBACK: Final = "127.0.0.1"
"""Only address of the page."""

PORT: Final = 8642
"""Port of the page, unless another one is named."""

_COOKIE: Final = "dual_ur10_live_{}"
_SENDER, _OWN = "Sec-Fetch-Site", "same-origin"  # cookies know no ports: it tells other servers' pages from this one
_LARGEST_BYTES: Final = 2**16  # of a message from a browser: a press or a pose
_PING_S, _PONG_S = 2.0, 4.0  # a page that is lost without a word is gone after at most their sum
_REFUSED: Final = "This page needs the token of its program: open the whole address that it has printed.\n"


def bind(port: int) -> socket.socket:
    """Return a socket that listens on a port of the loopback interface; 0: any free one.

    Raises:
        SettingsError: The port is busy or not allowed.
    """
    try:
        return socket.create_server((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        busy = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        reason = "is busy: another program, perhaps another live page, listens there" if busy else f"cannot be: {error}"
        raise SettingsError(f"port {port} of {LOOPBACK} {reason}. Name another one, or 0 for any free one") from None


def address(port: int, token: str) -> str:
    """Return the address of the page."""
    return f"http://{LOOPBACK}:{port}/?token={token}"


def make_server(listener: socket.socket, token: str, label: str, overlay: Overlay) -> Any:
    """Return a viser server behind all guards.

    Args:
        listener: Bound socket of the loopback interface.
        token: Secret of the page's address.
        label: Title of the panel.
        overlay: Button that stops both arms.

    Raises:
        MissingExtraError: viser is not installed.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtraError("viser", "live", "the live page") from None
    with _guarded(listener, token, overlay):
        server = viser.ViserServer(host=LOOPBACK, port=listener.getsockname()[1], label=label, verbose=False)
    # Hiding the button would not do: a message is enough.
    server.request_share_url = _nothing  # type: ignore[method-assign]
    server.disconnect_share_url = _nothing  # type: ignore[method-assign]
    return server


def _nothing(*_: Any, **__: Any) -> None:
    """Answer a request for a tunnel."""


@contextlib.contextmanager
def _guarded(listener: socket.socket, token: str, overlay: Overlay) -> Iterator[None]:
    """Let servers of websockets that are made within the block serve this socket, behind the guards."""
    import websockets.asyncio.server as module

    serve, port = module.serve, listener.getsockname()[1]
    origins: list[Any] = [f"http://{host}:{port}" for host in (LOOPBACK, "localhost")]

    @functools.wraps(serve)
    def guarded_serve(handler: Any, host: Any, port_: Any, *, process_request: Any, **settings: Any) -> Any:
        settings.update(max_size=_LARGEST_BYTES, ping_interval=_PING_S, ping_timeout=_PONG_S)
        return serve(
            handler,
            sock=listener,
            origins=origins,
            process_request=_checked(process_request, token, port, overlay),
            **settings,
        )

    module.serve = guarded_serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        module.serve = serve  # type: ignore[misc]


def _checked(
    process_request: Callable[[Any, Any], Any], token: str, port: int, overlay: Overlay
) -> Callable[[Any, Any], Any]:
    """Return a handler that refuses requests without the token, and gives a page with the token a cookie of it.

    The handshake of the page's own connection has no query, so that the cookie carries the token there. The same holds
    for the requests of the button that stops both arms.
    """
    name = _COOKIE.format(port)

    def answer(connection: Any, request: Any) -> Any:
        if overlay.stops and request.path == STOP_PATH:
            if request.headers.get(_SENDER, _OWN) != _OWN:
                return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSED)
            overlay.on_stop()
            return connection.respond(http.HTTPStatus.OK, "stopped\n")
        with contextlib.suppress(KeyError):
            del request.headers["Accept-Encoding"]  # nothing can be added to a compressed page
        response = process_request(connection, request)
        if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
            response.body = overlay.over(response.body)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    def check(connection: Any, request: Any) -> Any:
        asked = urllib.parse.parse_qs(urllib.parse.urlsplit(request.path).query).get("token", [""])[-1]
        if _equal(asked, token):
            response = answer(connection, request)
            if response is not None:
                response.headers["Set-Cookie"] = f"{name}={token}; Path=/; HttpOnly; SameSite=Strict"
                response.headers["Referrer-Policy"] = "no-referrer"
            return response
        if _equal(_cookie(request, name), token):
            return answer(connection, request)
        return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSED)

    return check


def _cookie(request: Any, name: str) -> str:
    found = http.cookies.SimpleCookie()
    for header in request.headers.get_all("Cookie"):
        with contextlib.suppress(http.cookies.CookieError):
            found.load(header)
    return found[name].value if name in found else ""


def _equal(found: str, token: str) -> bool:
    return hmac.compare_digest(found.encode(errors="replace"), token.encode())
