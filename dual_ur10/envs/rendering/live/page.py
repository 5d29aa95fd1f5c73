"""Process of the live page: reads the program's memory, draws it in a browser, and writes back what a person does."""

from __future__ import annotations

import logging
import math
import os
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.arms_view import ArmsView
from dual_ur10.envs.rendering.live.attendance import Attendance
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.drag_handles import DragHandles
from dual_ur10.envs.rendering.live.drawing import Drawing, Pictures
from dual_ur10.envs.rendering.live.guard import address, bind, make_server
from dual_ur10.envs.rendering.live.memory import LiveMemory, Row
from dual_ur10.envs.rendering.live.overlay import Overlay
from dual_ur10.envs.rendering.live.panel import Panel
from dual_ur10.envs.rendering.live.plots import Plots
from dual_ur10.envs.rendering.live.scene import Poser
from dual_ur10.envs.rendering.live.viewpoints import CAMERA, FOV_RAD, NARROW, look_from
from dual_ur10.errors import DualUR10Error, LinkError
from ur_core.objects import load_object
from ur_core.processes.system import LOCAL, System

STOPPED: Final = "the button to stop both arms was pressed in the live page"
"""Reason of the latched stop of a button."""

POLL_S: Final = 0.04
_WORDS_EVERY: Final = 5  # polls
_PLOTS_EVERY: Final = 8
_HANDLES_EVERY: Final = 3

_LOG: Final = logging.getLogger(__name__)


class Page:
    """The page behind one server.

    Args:
        server: viser's server.
        memory: Memory of the program.
        about: What the page shows.
        overlay: Button that stops both arms.
        system: Clock.

    Attributes:
        commander: The one page that commands.
    """

    def __init__(self, server: Any, memory: LiveMemory, about: About, overlay: Overlay, system: System = LOCAL) -> None:
        self._server, self._memory, self._about, self._clock = server, memory, about, system.clock
        self.commander = Commander(memory, system.clock, asks=about.controllers)
        self._attendance = Attendance(memory, system.clock, required=about.attended)
        model = build_model(about.scene)
        self._poser = Poser(model)
        self._poser.rest(home_q_rad(about.scene.mounts))
        self._handles = DragHandles(about, self.commander, self._poser)
        self._arms: ArmsView | None = None
        self._seen, self._polls = 0, 0
        self._row: Row | None = None
        server.gui.configure_theme(
            control_layout="floating", control_width="medium", show_logo=False, show_share_button=False, dark_mode=False
        )
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = *CAMERA, (0.0, 0.0, 1.0), FOV_RAD
        with server.atomic():
            self._panel = Panel(server.gui, about, self.commander, self._handles)
            self._drawing = Drawing(server, model, self._poser)
            self._drawing.draw()
            self._pictures = Pictures(server.gui, about, model)
            self._plots = Plots(server.gui, about)
        overlay.on_stop = self._stop
        server.on_client_connect(self._enter)
        server.on_client_disconnect(self._leave)

    def _stop(self) -> None:
        """Latch a stop of both arms of controllers, without waiting for the program, which stops simulated arms."""
        self.commander.stop()  # before the look at the arms, which `poll` may just be attaching
        if self._arms is not None:
            self._arms.stop(STOPPED)

    async def _enter(self, client: Any) -> None:
        if client.camera.aspect < NARROW:
            look_from(client, None)
        if self.commander.enter(client.client_id) and self._about.commands:
            self._handles.add(client)

    async def _leave(self, client: Any) -> None:
        self.commander.leave(client.client_id)
        self._handles.forget(client.client_id)

    def poll(self) -> None:
        """Show what is new."""
        memory, now_s = self._memory, self._clock.now_s()
        memory.beat(now_s)
        self.commander.poll()
        self._polls += 1
        if self._arms is None and (view := memory.attached):
            path, *names = view
            self._arms = load_object(path, "the view of the arms", registered=True)(*names)
            if memory.stops:  # pressed before they were known
                self._arms.stop(STOPPED)
        self._attendance.poll(self._arms)
        rows, self._seen = memory.rows(self._seen)
        late_ms, skew_ms = (math.nan, math.nan) if self._arms is None else self._arms.sending()
        self._plots.history.add(rows, late_ms, skew_ms)
        with self._server.atomic():
            if rows:
                self._row = rows[-1]
                self._poser.pose(self._row.qpos, self._row.mocap, self._row.commanded_rad)
                self._drawing.draw()
            if self._polls % _HANDLES_EVERY == 0:
                self._handles.follow()
            if self._polls % _WORDS_EVERY == 0:
                self._say(now_s)
            if self._polls % _PLOTS_EVERY == 0:
                self._plots.draw(now_s)
            if self._row is not None and memory.pages:
                self._pictures.draw(self._poser.data, self._clock.now_s, self._taken)

    def _taken(self, now_s: float) -> dict[str, NDArray[np.uint8]]:
        return {} if self._arms is None else self._arms.images(now_s)

    def _say(self, now_s: float) -> None:
        words = self._memory.words
        if self._arms is not None:
            words |= self._arms.words(now_s)
        if self._row is None:
            words["drawn"] = "both arms at home: nothing is known of them yet"
        if self._pictures.failure:
            words["cameras"] = self._pictures.failure
        count, client = self._memory.pages, self.commander.client
        if self._about.controllers or count != 1 or client is None:
            words["pages"] = f"{count} open, {'one commands' if client is not None else 'none commands'}"
        if not self._about.commands:
            hint = ", --command lets one page command" if self._about.controllers else ""
            words["pages"] = f"{count} open; this program only watches{hint}"
        self._panel.say(words)

    def close(self) -> None:
        """Release the view of the arms."""
        if self._arms is not None:
            self._arms.close()


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
    system.give_way()
    memory = LiveMemory(*shape, name)
    try:
        listener = bind(port)
        overlay = Overlay("stop" in about.buttons)
        server = make_server(listener, token, about.title, overlay)
        page = Page(server, memory, about, overlay, system)
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
