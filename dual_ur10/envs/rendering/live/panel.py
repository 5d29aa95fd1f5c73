"""Panel of a live page: its buttons, and the state in words."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Collection, Mapping
from typing import Any, Final

from dual_ur10.envs.rendering.live.memory import BUTTONS, POLICIES, SPEEDS

_LONGEST: Final = 24  # text of a policy


@dataclasses.dataclass(frozen=True)
class Button:
    """Button of the page.

    Attributes:
        label: Text.
        hint: Text beside the pointer.
        color: Colour, as viser names it.
    """

    label: str
    hint: str
    color: str = "gray"


LOOKS: Final[Mapping[str, Button]] = {
    "stop": Button("STOP BOTH ARMS", "Stop both arms at once. Every open page may.", "red"),
    "reset": Button("Reset", "Begin the episode again, with the same seed"),
    "record": Button("Record", "Begin to keep the episode"),
    "success": Button("Success", "Keep the episode as a success", "green"),
    "discard": Button("Discard", "Throw the episode away"),
    "take_left": Button("Take left", "Lead the left arm by its handle; the policy leads the other"),
    "take_right": Button("Take right", "Lead the right arm by its handle; the policy leads the other"),
    "take_both": Button("Take both", "Lead both arms by their handles"),
    "hand_back": Button("Hand back", "Let the policy lead both arms again"),
    "pause": Button("Pause / go on", "Stop and start the simulation's time"),
    "step": Button("One step", "Advance the paused simulation by one action"),
    "next_seed": Button("Next seed", "Begin the episode of the next seed"),
}
"""Looks of the buttons, by their names; those of `SPEEDS` and `POLICIES` stand in groups."""


def end_of(name: str, names: Collection[str]) -> str:
    """Return the end of a long name, or the whole where another one ends likewise."""
    end = name[-_LONGEST:]
    return name if end == name or any(each.endswith(end) for each in names if each != name) else f"…{end}"


def refuse(client: Any) -> None:
    """Say in a page that another one commands."""
    client.add_notification(
        title="This page watches",
        body="Another page commands. When it is closed, or leaves the controls, press: Take the controls.",
        auto_close_seconds=6.0,
        color="orange",
    )


def table(words: Mapping[str, str]) -> str:
    """Return the state in words as HTML, a row per line."""
    rows = "".join(
        f'<tr><th style="text-align:left;vertical-align:top;padding:1px 10px 1px 0;white-space:nowrap;'
        f'font-weight:500">{html.escape(name)}</th><td style="overflow-wrap:anywhere">{_cell(text)}</td></tr>'
        for name, text in words.items()
    )
    return f'<table aria-label="State" style="font-size:0.8rem;margin:0 0.6rem;border-spacing:0">{rows}</table>'


def _cell(text: str) -> str:
    alarming = text.startswith(("LATCHED", "LOST", "STOPPED by", "REFUSED"))
    return f'<b style="color:#c92a2a">{html.escape(text)}</b>' if alarming else html.escape(text)


if not {*LOOKS, *SPEEDS, *POLICIES} == {*BUTTONS}:
    raise RuntimeError("every button of the page has a look")
