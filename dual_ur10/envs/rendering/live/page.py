"""Process of the live page: reads the program's memory, draws it in a browser, and writes back what a person does."""

from __future__ import annotations

import contextlib
import logging
import math
import os
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.visuals import FIXED_CAMERAS
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.controllers import Controllers
from dual_ur10.envs.rendering.live.drawing import MOVED_M, Drawing, Pictures
from dual_ur10.envs.rendering.live.guard import address, bind, make_server
from dual_ur10.envs.rendering.live.memory import POLICIES, SPEEDS, TAKES, LiveMemory, Row
from dual_ur10.envs.rendering.live.panel import LOOKS, end_of, refuse, table
from dual_ur10.envs.rendering.live.plots import Plots
from dual_ur10.envs.rendering.live.viewpoints import CAMERA, FOV_RAD, NARROW, START, look_from
from dual_ur10.errors import DualUR10Error, LinkError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.processes.system import LOCAL, System

STOPPED: Final = "the button to stop both arms was pressed in the live page"
"""Reason of the latched stop of a button."""

POLL_S: Final = 0.04
_WORDS_EVERY: Final = 5  # polls
_PLOTS_EVERY: Final = 8
_HANDLES_EVERY: Final = 3
_NICE: Final = 5
_AUTOGROUP: Final = "/proc/self/autogroup"

_LOG: Final = logging.getLogger(__name__)


class Page:
    """The page behind one server.

    Args:
        server: viser's server.
        memory: Memory of the program.
        about: What the page shows.
        system: Clock.

    Attributes:
        commander: The one page that commands.
    """

    def __init__(self, server: Any, memory: LiveMemory, about: About, system: System = LOCAL) -> None:
        self._server, self._memory, self._about, self._clock = server, memory, about, system.clock
        self.commander = Commander(memory, system.clock)
        model = build_model(about.scene)
        self._handles: dict[int, list[Any]] = {}
        self._controllers: Controllers | None = None
        self._seen, self._polls = 0, 0
        self._row: Row | None = None
        server.gui.configure_theme(
            control_layout="floating", control_width="medium", show_logo=False, show_share_button=False, dark_mode=False
        )
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = *CAMERA, (0.0, 0.0, 1.0), FOV_RAD
        with server.atomic():
            self._add_panel(server.gui)
            self._drawing = Drawing(server, model)
            self._pictures = Pictures(server.gui, about, model)
            self._plots = Plots(server.gui, about)
        server.on_client_connect(self._enter)
        server.on_client_disconnect(self._leave)

    # The panel.

    def _add_panel(self, gui: Any) -> None:
        about = self._about
        if "stop" in about.buttons:
            self._add_button(gui, "stop")
        self._words = gui.add_html(table({}))
        cameras = *FIXED_CAMERAS, *about.scene.equipment.cameras
        viewpoints = {START: None, **{each.name: each for each in cameras}}
        group = gui.add_button_group(
            "View from", tuple(viewpoints), hint="Move this page's viewpoint, not those of others"
        )

        async def look(event: Any) -> None:
            look_from(event.client, viewpoints[event.target.value])

        group.on_click(look)
        if not about.commands:
            return
        with gui.add_folder("Episode"):
            for name in ("reset", "record", "success", "discard", "next_seed", "pause", "step"):
                if name in about.buttons:
                    self._add_button(gui, name)
            if set(SPEEDS) <= {*about.buttons}:
                self._add_group(gui, "Speed", {f"{ratio:g}×": name for name, ratio in SPEEDS.items()})
            if about.policies:
                names = dict(zip(about.policies, POLICIES, strict=False))
                self._add_group(gui, "Policy", {end_of(policy, names): name for policy, name in names.items()})
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

    def _add_button(self, gui: Any, name: str) -> None:
        look = LOOKS[name]
        button = gui.add_button(look.label, hint=look.hint, color=look.color)

        async def press(event: Any) -> None:
            if name == "stop":
                self._stop()
            self._press(event, name)

        button.on_click(press)

    def _add_group(self, gui: Any, label: str, names: Mapping[str, str]) -> None:
        """Add buttons side by side: their names by their texts."""
        group = gui.add_button_group(label, tuple(names))

        async def press(event: Any) -> None:
            self._press(event, names[event.target.value])

        group.on_click(press)

    def _press(self, event: Any, name: str) -> None:
        if not self.commander.press(event.client_id, name):
            refuse(event.client)

    def _stop(self) -> None:
        """Latch a stop of both arms of controllers, without waiting for the program."""
        if self._controllers is not None:
            self._controllers.cell.enter_fault(STOPPED)

    def _gripper_of(self, arm: int) -> Callable[[Any], Any]:
        async def grip(event: Any) -> None:
            opening = 1.0 if event.target.value == "open" else 0.0
            if not self.commander.grip(event.client_id, arm, opening, self._drawing.poser.tool_targets()[arm]):
                refuse(event.client)

        return grip

    async def _take(self, event: Any) -> None:
        if self.commander.take(event.client_id):
            self._add_handles(event.client)
        else:
            refuse(event.client)

    async def _give_up(self, event: Any) -> None:
        if self.commander.give_up(event.client_id):
            self._remove_handles(event.client_id)

    # Pages that come and go.

    async def _enter(self, client: Any) -> None:
        if client.camera.aspect < NARROW:
            look_from(client, None)
        if self.commander.enter(client.client_id) and self._about.commands:
            self._add_handles(client)

    async def _leave(self, client: Any) -> None:
        self.commander.leave(client.client_id)
        self._handles.pop(client.client_id, None)

    def _add_handles(self, client: Any) -> None:
        """Add the drag handles to one page alone."""
        if not self._about.handles or client.client_id in self._handles:
            return
        poses = self._drawing.poser.tool_targets()
        handles = []
        for arm, name in enumerate(ARMS):
            handle = client.scene.add_transform_controls(
                f"/handles/{name}",
                scale=0.25,
                line_width=4.0,
                depth_test=False,
                disable_sliders=False,
                position=poses[arm, :3],
                wxyz=poses[arm, 3:],
            )
            handle.on_update(self._drag_of(arm))
            handles.append(handle)
        self._handles[client.client_id] = handles

    def _remove_handles(self, client: int) -> None:
        for handle in self._handles.pop(client, ()):
            handle.remove()

    def _drag_of(self, arm: int) -> Callable[[Any], Any]:
        async def drag(event: Any) -> None:
            pose = np.concatenate([event.target.position, event.target.wxyz])
            self.commander.drag(event.client_id, arm, pose, held=event.phase != "end")

        return drag

    # The loop.

    def poll(self) -> None:
        """Show what is new."""
        memory, now_s = self._memory, self._clock.now_s()
        memory.beat(now_s)
        self.commander.poll()
        self._polls += 1
        if self._controllers is None and (names := memory.attached) is not None:
            self._controllers = Controllers(names)
        rows, self._seen = memory.rows(self._seen)
        late_ms, skew_ms = (math.nan, math.nan) if self._controllers is None else self._controllers.sending.read()
        self._plots.history.add(rows, late_ms, skew_ms)
        with self._server.atomic():
            if rows:
                self._row = rows[-1]
                self._drawing.show(self._row)
            if self._polls % _HANDLES_EVERY == 0:
                self._follow()
            if self._polls % _WORDS_EVERY == 0:
                self._say(now_s)
            if self._polls % _PLOTS_EVERY == 0:
                self._plots.draw(now_s)
            if self._row is not None and memory.pages:
                self._pictures.draw(self._drawing.poser.data, self._clock.now_s)

    def _follow(self) -> None:
        """Let the handles that nobody drags follow the commanded tools."""
        poses = self._drawing.poser.tool_targets()
        for handles in list(self._handles.values()):
            for arm, handle in enumerate(handles):
                pose = poses[arm]
                if self.commander.dragged(arm) or np.abs(handle.position - pose[:3]).max() < MOVED_M:
                    continue
                handle.position, handle.wxyz = pose[:3], pose[3:]

    def _say(self, now_s: float) -> None:
        words = self._memory.words
        if self._controllers is not None:
            words |= self._controllers.words(now_s)
        if self._pictures.failure:
            words["cameras"] = self._pictures.failure
        count, client = self._memory.pages, self.commander.client
        words["pages"] = f"{count} open, {'one commands' if client is not None else 'none commands'}"
        if not self._about.commands:
            words["pages"] = f"{count} open; this program only watches, --command lets one page command"
        content = table(words)
        if self._words.content != content:
            self._words.content = content

    def close(self) -> None:
        """Release the memories of the controllers."""
        if self._controllers is not None:
            self._controllers.close()


def main(
    name: str, shape: tuple[int, int], about: About, port: int, token: str, parent: int, *, system: System = LOCAL
) -> None:
    """Serve the page until the program ends it or has ended.

    Args:
        name: Name of the memory.
        shape: Numbers of positions and of placed props of the cell's model.
        about: What the page shows.
        port: Port; 0: any free one.
        token: Secret of the address.
        parent: Process id of the program.
        system: Clock and processes.
    """
    system.ignore_interrupts()  # the program handles them, and ends the page
    _yield_to_others()
    memory = LiveMemory(*shape, name)
    try:
        listener = bind(port)
        server = make_server(listener, token, about.title)
        page = Page(server, memory, about, system)
    except DualUR10Error as error:
        memory.enter_ready({"error": str(error), "kind": type(error).__name__})
        return
    memory.enter_ready({"url": address(listener.getsockname()[1], token)})
    terminated, clock = system.terminated(), system.clock
    due_s = clock.now_s()
    while not (memory.ending or terminated.is_set() or system.is_orphan(parent)):
        try:
            page.poll()
        except (LinkError, OSError) as error:
            _LOG.warning("the live page has lost the program: %s", error)
            break
        due_s = max(due_s + POLL_S, clock.now_s())
        clock.sleep(due_s - clock.now_s())
    page.close()
    memory.close()
    os._exit(0)  # threads of the server may still wait for browsers


def _yield_to_others() -> None:
    """Give way to all processes that owe something in time."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    with contextlib.suppress(OSError), open(_AUTOGROUP, "w") as file:
        file.write(str(_NICE))
