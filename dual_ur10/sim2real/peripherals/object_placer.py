"""Client of the fault-injection port of an emulated cell: one JSON object per line, answered by one line."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any, Final

from dual_ur10.errors import EmulatorError, LinkError
from dual_ur10.sim2real.links.link_socket import LinkSocket, checked_timeout
from dual_ur10.types import Closing

ANSWER_S: Final = 10.0
"""How long an answer is waited for, unless said otherwise."""

_LONGEST: Final = 4 << 20  # of an answer, bytes


class FaultInjectionClient(Closing):
    """One connection, made with the first request. After a failure the next request makes another.

    Args:
        host: Of the left controller.
        port: Fault-injection port.
        timeout_s: For each request.

    Raises:
        SettingsError: The time is not positive and finite.
    """

    def __init__(self, host: str, port: int, timeout_s: float = ANSWER_S) -> None:
        self.host, self.port, self.timeout_s = host, port, checked_timeout(timeout_s)
        self._socket: LinkSocket | None = None
        self._rest = b""

    def ask(self, do: str, **values: Any) -> Any:
        """Send one request, such as `ask("stop", arm="left", mode=3)`.

        Returns:
            The value of the answer.

        Raises:
            EmulatorError: The request was refused, or there was no answer.
        """
        deadline_s = time.monotonic() + self.timeout_s
        try:
            if self._socket is None:
                self._socket = LinkSocket("", "fault injection", self.host, self.port, deadline_s)
            self._socket.send(json.dumps({"do": do, **values}).encode() + b"\n", deadline_s)
            answer = json.loads(self._line(self._socket, deadline_s))
        except (LinkError, ValueError) as error:
            self.close()  # an answer that comes late is not to be taken for that of the next request
            raise EmulatorError(f"the emulated cell gave no answer to {do!r}: {error}") from error
        if not (isinstance(answer, dict) and answer.get("ok")):
            text = answer.get("error") if isinstance(answer, dict) else answer
            raise EmulatorError(str(text))
        return answer.get("value")

    def _line(self, socket: LinkSocket, deadline_s: float) -> bytes:
        parts = [self._rest]
        size = 0
        while b"\n" not in parts[-1]:
            parts.append(socket.receive(deadline_s))
            size += len(parts[-1])
            if size > _LONGEST:
                raise socket.error(f"an answer of more than {_LONGEST} bytes", "this is no emulated cell")
        line, self._rest = b"".join(parts).split(b"\n", 1)
        return line

    def place(self, position_m: Sequence[float], quat: Sequence[float]) -> None:
        """Put the object of the cell's task somewhere, at rest.

        Args:
            position_m: (3,) of its centre, in the cell frame.
            quat: (4,) its orientation (w, x, y, z).

        Raises:
            EmulatorError: There is no object, it cannot be put there, or there was no answer.
        """
        self.ask("place", position_m=[float(each) for each in position_m], quat=[float(each) for each in quat])

    def close(self) -> None:
        """End the connection. May be called twice."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._rest = None, b""
