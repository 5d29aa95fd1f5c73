"""Button that stops both arms, above all that viser draws, whose panel scrolls and collapses.

A press is a request of its own to the page's server, which needs none of viser's scripts.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Final

STOP_PATH: Final = "/stop"
"""Path of the request of a press."""

_FILE: Final = "overlay.html"
_BUTTON: Final = b"<button"  # with its script behind it
_END: Final = b"</body>"


class Overlay:
    """Button above the page, its hotkey, which is the space bar, and styles of the page.

    Args:
        stops: With the button.

    Attributes:
        stops: As above.
        on_stop: Function that a press calls, in the thread of the server.
    """

    def __init__(self, stops: bool) -> None:
        self.stops = stops
        self.on_stop: Callable[[], None] = _nothing
        whole = (files(__package__) / _FILE).read_bytes()
        self._added = whole if stops else whole.partition(_BUTTON)[0]

    def over(self, page: bytes) -> bytes:
        """Return an HTML page with the overlay."""
        before, end, after = page.rpartition(_END)
        return before + self._added + end + after


def _nothing() -> None:
    """Stop nothing: there are no arms yet."""
