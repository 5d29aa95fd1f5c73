"""Client of a service that answers one line of JSON with another: a camera, or what places objects."""

from __future__ import annotations

import json
from typing import Any, Final, NoReturn

from ur_core.errors import LinkError, OperationRefusedError, ProtocolError
from ur_core.links.link_socket import LinkSocket, check_timeout
from ur_core.processes.system import LOCAL, System
from ur_core.types import Closing

ANSWER_S: Final = 10.0
"""Default time limit of a request."""

_LONGEST: Final = 4 << 20  # of an answer, bytes
_LONGEST_REASON: Final = 1000  # characters
_LONGEST_SHOWN: Final = 200  # bytes of an answer


class JsonLink(Closing):
    """Connection that the first request makes. After a failure, the next request makes another.

    Args:
        what: Service at the port, for messages.
        host: IPv4 address.
        port: Port number.
        timeout_s: Time limit of each request.

    Attributes:
        where: Service and address, for messages.

    Raises:
        SettingsError: The time is not positive and finite.
    """

    def __init__(self, what: str, host: str, port: int, timeout_s: float = ANSWER_S, *, system: System = LOCAL) -> None:
        self._system = system
        self.where = f"{what} at {host}:{port}"
        self.timeout_s = check_timeout(timeout_s)
        self._address = (what, host, port)
        self._socket: LinkSocket | None = None
        self._rest = b""

    def ask(self, do: str, **values: Any) -> Any:
        """Send a request, such as `ask("stop", arm="left", mode=3)`, and return the value of its answer.

        Raises:
            OperationRefusedError: The service refuses the request.
            LinkError: There is no answer in time, or it is not valid. The connection was closed.
        """
        deadline_s = self._system.clock.now_s() + self.timeout_s
        try:
            if self._socket is None:
                self._socket = LinkSocket("", *self._address, deadline_s, system=self._system)
            self._socket.send(json.dumps({"do": do, **values}).encode() + b"\n", deadline_s)
            answer = _answer(self._line(self._socket, deadline_s))
        except (LinkError, ProtocolError) as error:
            self.close()  # so that a late answer is not taken for that of the next request
            raise LinkError(f"no answer to {do!r}: {_reason(error)}") from error
        if not answer["ok"]:
            raise OperationRefusedError(answer.get("error", ""))
        return answer.get("value")

    def _line(self, socket: LinkSocket, deadline_s: float) -> bytes:
        parts = [self._rest]
        size = 0
        while b"\n" not in parts[-1]:
            parts.append(socket.receive(deadline_s))
            size += len(parts[-1])
            if size > _LONGEST:
                raise socket.error(f"an answer of more than {_LONGEST} bytes", "check the port")
        line, self._rest = b"".join(parts).split(b"\n", 1)
        return line

    def close(self) -> None:
        """End the connection. May be called twice."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._rest = None, b""


def _answer(line: bytes) -> dict[str, Any]:
    """Return an answer: `ok`, and `value` or the text `error`.

    Raises:
        ProtocolError: It is none.
    """
    try:
        found = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{line[:_LONGEST_SHOWN]!r} is no JSON: {error}") from error
    if not (
        isinstance(found, dict)
        and found.keys() <= {"ok", "value", "error"}
        and isinstance(found.get("ok"), bool)
        and isinstance(found.get("error", ""), str)
    ):
        raise ProtocolError(f"{line[:_LONGEST_SHOWN]!r} is no answer: expected are `ok`, and `value` or `error`")
    return found


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _reason(error: LinkError | ProtocolError) -> str:
    """Return the text of an error, short even where the answer is long and all of it is wrong."""
    text = str(error)
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."
