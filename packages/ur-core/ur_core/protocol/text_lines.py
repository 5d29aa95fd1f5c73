"""Lines of text from a byte stream, with a bound on the memory that a peer can take."""

from __future__ import annotations

import re
from typing import Final

from ur_core.errors import ProtocolError

MAX_LINE_BYTES: Final = 4096
"""Longest line. The text of a popup, the longest that a client needs, is far shorter."""

_HTTP: Final = re.compile(r"[A-Z]+ \S+ HTTP/[\d.]+\s*")


def refuse_http(line: str) -> None:
    """Refuse the first line of an HTTP request: a web page must not command a controller on its reader's machine.

    Raises:
        ProtocolError: The line is one.
    """
    if _HTTP.fullmatch(line):
        raise ProtocolError("this is a request of HTTP, which no port of a controller serves; the connection is closed")


class LineReader:
    r"""Reader of lines that end with `\n` from a byte stream.

    Args:
        limit: Longest line without its end, bytes.
    """

    def __init__(self, limit: int = MAX_LINE_BYTES) -> None:
        self.limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        r"""Return the lines that `data` completes, without `\n` or `\r\n`. Bytes that are not UTF-8 are replaced.

        Raises:
            ProtocolError: A line is longer than the limit. The stream cannot be read on.
        """
        *lines, rest = (self._rest + data).split(b"\n")
        longest = max(map(len, [*lines, rest]))
        if longest > self.limit:
            self._rest = b"?" * (self.limit + 1)  # refuses all further data as well
            raise ProtocolError(
                f"a line of {longest} bytes or more: lines of this protocol have at most {self.limit} and end with "
                "a newline; the connection is closed"
            )
        self._rest = rest
        return [line.removesuffix(b"\r").decode("utf-8", "replace") for line in lines]
