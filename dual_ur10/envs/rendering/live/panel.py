"""Panel of a live page: its buttons, and the state in words."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final

from dual_ur10.assets.visuals import FIXED_CAMERAS
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.buttons import BUTTONS, POLICIES, SPEEDS, TAKES
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.drag_handles import DragHandles
from dual_ur10.envs.rendering.live.drawing import APART_M, TARGET_RGB
from dual_ur10.envs.rendering.live.viewpoints import START, look_from
from ur_core.kinematics.ur10 import ARMS

_LONGEST: Final = 24  # text of a policy
_OTHERS: Final = "Another page commands. When it is closed, or leaves the controls, press: Take the controls."


@dataclasses.dataclass(frozen=True)
class Button:
    """Button of the page.

    Attributes:
        label: Text.
        hint: Text beside the pointer.
        key: Hotkey, as viser names it. W, A, S, D, Q, E and the arrow keys move its viewpoint.
        color: Colour, as viser names it.
    """

    label: str
    hint: str
    key: str
    color: str = "gray"


LOOKS: Final[Mapping[str, Button]] = {
    "reset": Button("Reset", "Begin the episode again, with the same seed", "R"),
    "record": Button("Record", "Begin to keep the episode", "B"),
    "success": Button("Success", "Keep the episode as a success", "K", "green"),
    "discard": Button("Discard", "Throw the episode away", "backspace"),
    "take_left": Button("Take left", "Lead the left arm by its handle; the policy leads the other", "1"),
    "take_right": Button("Take right", "Lead the right arm by its handle; the policy leads the other", "2"),
    "take_both": Button("Take both", "Lead both arms by their handles", "3"),
    "hand_back": Button("Hand back", "Let the policy lead both arms again", "0"),
    "pause": Button("Pause / go on", "Stop and start the simulation's time", "P"),
    "step": Button("One step", "Advance the paused simulation by one action", "O"),
    "next_seed": Button("Next seed", "Begin the episode of the next seed", "N"),
}
"""Looks of the buttons, by their names. Those of `SPEEDS` and `POLICIES` stand in groups, "stop" above the panel."""


class Panel:
    """Buttons and words of the page.

    Args:
        gui: viser's panel.
        about: What the page shows.
        commander: The one page that commands.
        handles: Drag handles of the pages.
    """

    def __init__(self, gui: Any, about: About, commander: Commander, handles: DragHandles) -> None:
        self._commander, self._handles, self._stops = commander, handles, "stop" in about.buttons
        self._words = gui.add_html(_table({}))
        gui.add_html(_legend())
        cameras = *FIXED_CAMERAS, *(each for each in about.scene.equipment.cameras if not each.body)
        viewpoints = {START: None, **{each.name: each for each in cameras}}
        group = gui.add_button_group(
            "View from", tuple(viewpoints), hint="Move this page's viewpoint, not those of others"
        )

        async def look(event: Any) -> None:
            look_from(event.client, viewpoints[event.target.value])

        group.on_click(look)
        if not about.commands:
            return
        if {*about.buttons} - {*TAKES, "stop"}:
            with gui.add_folder("Episode"):
                self._add_episode(gui, about)
        if about.handles:
            with gui.add_folder("Lead the arms"):
                for name in TAKES:
                    if name in about.buttons:
                        self._add_button(gui, name)
                for arm, name in enumerate(ARMS if about.grippers else ()):
                    group = gui.add_button_group(f"{name} gripper", ("open", "close"))
                    group.on_click(self._gripper_of(arm))
        with gui.add_folder("Who commands", expand_by_default=about.handles):
            take = gui.add_button("Take the controls", hint="Command, if no other page does")
            take.on_click(self._take)
            leave = gui.add_button("Leave the controls", hint="Watch, so that another page may command")
            leave.on_click(self._give_up)

    def _add_episode(self, gui: Any, about: About) -> None:
        for name in ("reset", "record", "success", "discard", "next_seed", "pause", "step"):
            if name in about.buttons:
                self._add_button(gui, name)
        if set(SPEEDS) <= {*about.buttons}:
            self._add_group(gui, "Speed", {f"{ratio:g}×": name for name, ratio in SPEEDS.items()})
        if about.policies:
            names = dict(zip(about.policies, POLICIES, strict=False))
            self._add_group(gui, "Policy", {end_of(policy, names): name for policy, name in names.items()})

    def _add_button(self, gui: Any, name: str) -> None:
        look = LOOKS[name]
        # The space bar stops both arms where something does.
        key = "space" if name == "pause" and not self._stops else look.key
        button = gui.add_button(look.label, hint=f"{look.hint}. Key: {key}", color=look.color)

        async def press(event: Any) -> None:
            self._press(event, name)

        button.on_click(press)
        gui.add_command(look.label, hotkey=key).on_trigger(press)

    def _add_group(self, gui: Any, label: str, names: Mapping[str, str]) -> None:
        """Add buttons side by side: their names by their texts."""
        group = gui.add_button_group(label, tuple(names))

        async def press(event: Any) -> None:
            self._press(event, names[event.target.value])

        group.on_click(press)

    def _press(self, event: Any, name: str) -> None:
        if not self._commander.press(event.client_id, name):
            self._refuse(event.client)

    def _refuse(self, client: Any) -> None:
        """Say why a press does not count."""
        free = self._commander.client is None
        client.add_notification(
            title="This page watches",
            body="No page commands: press Take the controls." if free else _OTHERS,
            auto_close_seconds=6.0,
            color="orange",
        )

    def _gripper_of(self, arm: int) -> Callable[[Any], Any]:
        async def grip(event: Any) -> None:
            opening = 1.0 if event.target.value == "open" else 0.0
            if not self._commander.grip(event.client_id, arm, opening, self._handles.tool(arm)):
                self._refuse(event.client)

        return grip

    async def _take(self, event: Any) -> None:
        if self._commander.take(event.client_id):
            self._handles.add(event.client)
        else:
            self._refuse(event.client)

    async def _give_up(self, event: Any) -> None:
        if self._commander.give_up(event.client_id):
            self._handles.remove(event.client_id)

    def say(self, words: Mapping[str, str]) -> None:
        """Show the state in words, a row per line."""
        content = _table(words)
        if self._words.content != content:
            self._words.content = content


def end_of(name: str, names: Collection[str]) -> str:
    """Return the end of a long name, or the whole where another one ends likewise."""
    end = name[-_LONGEST:]
    return name if end == name or any(each.endswith(end) for each in names if each != name) else f"…{end}"


def _legend() -> str:
    """Return what the colours of the scene mean, as HTML."""
    marks = (f'<span style="color:rgb{rgb}">\u25a0</span>' for rgb in TARGET_RGB)
    names = " ".join(f"{mark} {arm} arm" for mark, arm in zip(marks, ARMS, strict=True))
    text = f"Targets more than {1e3 * APART_M:g} mm away: {names}"
    return f'<div style="font-size:0.75rem;margin:2px 0.6rem">{text}</div>'


def _table(words: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th style="text-align:left;vertical-align:top;padding:1px 10px 1px 0;white-space:nowrap;'
        f'font-weight:500">{html.escape(name)}</th><td style="overflow-wrap:anywhere">{_cell(text)}</td></tr>'
        for name, text in words.items()
    )
    return f'<table aria-label="State" style="font-size:0.8rem;margin:0 0.6rem;border-spacing:0">{rows}</table>'


def _cell(text: str) -> str:
    alarming = text.startswith(("LATCHED", "LOST", "STOPPED by", "REFUSED"))
    return f'<b style="color:#c92a2a">{html.escape(text)}</b>' if alarming else html.escape(text)


if not {*LOOKS, *SPEEDS, *POLICIES, "stop"} == {*BUTTONS}:
    raise RuntimeError("every button of the page has a look")
