"""Two arms of controllers as the process of a live page reads and stops them."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class ArmsView(Protocol):
    """View of a cell whose arms another process moves.

    A cell offers it as `live_view`: the path of its class, "module:Class", and the strings to make it of.
    """

    @property
    def owe_motion(self) -> bool:
        """True during an episode, and on the way to its start."""

    def words(self, now_s: float) -> dict[str, str]:
        """Return the state in words, by the names of the page's lines."""

    def sending(self) -> tuple[float, float]:
        """Return the largest delay of a target, and the largest skew of both arms' targets, since the last call.

        Both in ms; NaN: nothing was sent.
        """

    def images(self, now_s: float) -> dict[str, NDArray[np.uint8]]:
        """Return the newest images of observed cameras, (height, width, 3), by name."""

    def stop(self, reason: str) -> None:
        """Latch a stop of both arms. May be called in any thread."""

    def close(self) -> None:
        """Release what it holds."""
