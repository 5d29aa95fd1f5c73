"""Keys in the bytes of a terminal: escape sequences, as of arrow keys, hold letters that nobody typed."""

from __future__ import annotations

import re
from typing import Final

# An escape, also that of Alt; or a CSI or SS3 sequence, with the "[[" of the Linux console and the "$" of rxvt; or a
# whole answer of a terminal, as about its colours. The stop key belongs to none: an "x" ends a sequence, and counts.
_SEQUENCE: Final = re.compile(r"\x1b(?:(?:\[\[?|O)[0-?]{0,24}[$@-WY-wy-~]?|[]P^_][^xX\x07\x1b]{0,256}(?:\x07|\x1b\\))?")
_UNFINISHED: Final = re.compile(r"\x1b(?:(?:\[\[?|O)[0-?]{0,24})?\Z")


class TerminalKeys:
    """Parser of the bytes that a terminal sends, in pieces of any length."""

    def __init__(self) -> None:
        self._unfinished = ""

    def keys(self, data: bytes) -> str:
        """Return the keys in the next bytes, in lower case, without escape sequences and what is not ASCII.

        A sequence that these bytes leave unfinished goes on in the next ones.
        """
        text = self._unfinished + data.decode("ascii", "ignore")
        unfinished = _UNFINISHED.search(text)
        self._unfinished = unfinished[0] if unfinished else ""
        return _SEQUENCE.sub("", text).lower()
