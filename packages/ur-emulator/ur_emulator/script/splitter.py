"""Splitter of the byte stream of a script port into programs.

A line that begins with `def` or `sec` begins a program, which goes on to the `end` that closes it. Any other line is a
program of its own. Blank lines, comments and labels of PolyScope are none. Each byte is scanned once, whatever the
pieces in which it arrives.
"""

from __future__ import annotations

import re
from typing import Final

from ur_core.errors import ProtocolError
from ur_core.protocol.text_lines import refuse_http

PROGRAM_MAX: Final = 1 << 18
"""Bytes of the longest program."""

# Strings and comments are matched in order to skip the words in them.
_WORDS: Final = re.compile(r'"[^"\n]*"|#.*|\b(?:(def|thread|sec|while|if|switch)|(end))\b')
_BEGINS: Final = re.compile(r"\s*(?:def|sec)\b")
_SILENT: Final = re.compile(r"\s*(?:[#$].*)?$", re.DOTALL)


class Splitter:
    """Incremental splitter: bytes in, programs out."""

    def __init__(self) -> None:
        self._line = bytearray()
        self._lines: list[str] = []
        self._held = 0
        self._open = 0

    def feed(self, data: bytes) -> list[str]:
        """Add received bytes and return the programs that they complete.

        Raises:
            ProtocolError: More than `PROGRAM_MAX` bytes have come without the end of a program, or HTTP has.
        """
        programs: list[str] = []
        *ends, rest = data.split(b"\n")
        for end in ends:
            self._line += end
            line = self._line.decode("utf-8", errors="replace")
            self._held += len(self._line) + 1
            self._line = bytearray()
            self._check(0)
            self._take(line + "\n", programs)
        self._line += rest
        self._check(len(self._line))
        return programs

    @property
    def rest(self) -> bytes:
        """Bytes of the incomplete program."""
        return "".join(self._lines).encode() + bytes(self._line)

    def _check(self, more: int) -> None:
        if self._held + more > PROGRAM_MAX:
            raise ProtocolError(
                f"no program ended within {PROGRAM_MAX} bytes: close each def with end, and end the last line"
            )

    def _take(self, line: str, programs: list[str]) -> None:
        if not self._open and not _BEGINS.match(line):
            refuse_http(line)
            if not _SILENT.match(line):
                programs.append(line)
            self._held = 0
            return
        for match in _WORDS.finditer(line):
            opens, closes = match.groups()
            self._open += bool(opens) - bool(closes)
        self._lines.append(line)
        if self._open <= 0:
            programs.append("".join(self._lines))
            self._lines, self._held, self._open = [], 0, 0
