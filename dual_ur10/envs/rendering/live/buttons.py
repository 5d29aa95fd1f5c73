"""Names of the buttons of a live page, some of which devices have, too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

EPISODES: Final = ("record", "success", "discard", "reset")
"""Names of the buttons that begin episodes, keep them, and throw them away."""

TAKES: Final = ("take_left", "take_right", "take_both", "hand_back")
"""Names of the buttons that take over arms and hand them back."""

SPEEDS: Final[Mapping[str, float]] = {f"speed_{ratio:g}": ratio for ratio in (0.25, 0.5, 1.0, 2.0, 4.0)}
"""Speeds of a simulation, as ratios to real time, by the names of the buttons that set them."""

POLICIES: Final = tuple(f"policy_{number}" for number in range(16))
"""Names of the buttons that let another policy act: by number, so that a page can name no other than the program."""

BUTTONS: Final = (*EPISODES, *TAKES, "stop", "pause", "step", "next_seed", *SPEEDS, *POLICIES)
"""Names of the buttons of a page; the program acts on them."""
