"""Process of the live page: reads the program's memory, draws it in a browser, and writes back what a person does."""

from __future__ import annotations

import contextlib
import dataclasses
import html
import logging
import math
import os
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final

import numpy as np

from dual_ur10.assets.prop import Camera
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.assets.visuals import FIXED_CAMERAS
from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.guard import address, bind, make_server
from dual_ur10.envs.rendering.live.history import SHOWN_S, History, Sending
from dual_ur10.envs.rendering.live.memory import BUTTONS, POLICIES, SPEEDS, TAKES, LiveMemory, Row
from dual_ur10.envs.rendering.live.scene import Poser, parts_of
from dual_ur10.errors import DualUR10Error, LinkError, RenderError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.processes.system import LOCAL, System
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.types import Array

STOPPED: Final = "the button to stop both arms was pressed in the live page"
"""Reason of the latched stop of a button."""

CAMERA: Final = (2.3, -2.2, 1.8), (-0.1, 0.25, 0.25)
"""Position of the viewpoint and the point that it looks at, m in the cell frame."""

FOV_RAD: Final = 0.8
"""Vertical angle of the picture."""

START: Final = "start"
"""Name of the viewpoint of a page that was just opened."""

_NARROW: Final = 0.8  # ratio of width to height below which the panel covers the lower part of the picture
_NARROW_CAMERA: Final = (3.6, -3.3, 2.4), (-0.1, 0.0, -0.6)

POLL_S: Final = 0.04
_WORDS_EVERY: Final = 5  # polls
_PLOTS_EVERY: Final = 8
_HANDLES_EVERY: Final = 3
_IMAGE_SIZE: Final = (320, 240)
_IMAGE_S: Final = 0.25
_IMAGE_SHARE: Final = 0.1  # of a core, at most, for drawing images
_NICE: Final = 5
_MOVED_M: Final = 1e-4  # a smaller change of a pose is not sent
_APART_M: Final = 0.003  # distance of a tool from its target from which on the target is shown
_TARGET_OPACITY: Final = 0.3
_TARGET_RGB: Final = ((40, 120, 255), (255, 120, 20))
_SERIES_RGB: Final = ("#2878ff", "#ff7814")
_LONGEST: Final = 24  # text of a policy
_AUTOGROUP: Final = "/proc/self/autogroup"

_LOG: Final = logging.getLogger(__name__)


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


@dataclasses.dataclass(frozen=True)
class About:
    """Content of a page, as the program sets it at the start.

    Attributes:
        title: Title of the panel.
        scene: Scene of the cell.
        speed_rad_s: (2, 6) speed limits of the joints.
        buttons: Names of the buttons shown, of `BUTTONS`; without any, and without handles, the page only watches.
        handles: Drag handles at both tools.
        grippers: Buttons for both grippers.
        cameras: Cameras whose images are shown.
        policies: Names of the policies between which the page switches, at most as many as `POLICIES`.
    """

    title: str
    scene: SceneSettings
    speed_rad_s: tuple[tuple[float, ...], tuple[float, ...]]
    buttons: tuple[str, ...] = ()
    handles: bool = False
    grippers: bool = False
    cameras: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()

    @property
    def commands(self) -> bool:
        """True if a page may command."""
        return bool(self.buttons) or self.handles


class Drawing:
    """Both arms, their targets and the objects in the browser's scene."""

    def __init__(self, server: Any, model: Any) -> None:
        self.poser = Poser(model)
        self._frames: dict[tuple[int, bool], Any] = {}
        self._sent: dict[tuple[int, bool], Array] = {}
        self._arms = {
            body: 0 if model.body(body).name.startswith(f"{ARMS[0]}/") else 1 for body in self.poser.arm_bodies
        }
        server.scene.set_up_direction("+z")
        # Its own light throws no shadows: without a GPU they halve the rate of the pictures.
        server.scene.configure_default_lights(cast_shadow=False)
        for number, part in enumerate(parts_of(model)):
            parent = self._frame(server, part.body, target=False)
            server.scene.add_mesh_simple(
                f"{parent}/{number}",
                part.vertices.astype(np.float32),
                part.faces,
                color=part.rgb,
                opacity=None if part.opacity >= 1.0 else part.opacity,
                flat_shading=False,
                cast_shadow=False,
                receive_shadow=False,
            )
            if part.body in self._arms:
                parent = self._frame(server, part.body, target=True)
                server.scene.add_mesh_simple(
                    f"{parent}/{number}",
                    part.vertices.astype(np.float32),
                    part.faces,
                    color=_TARGET_RGB[self._arms[part.body]],
                    opacity=_TARGET_OPACITY,
                    cast_shadow=False,
                    receive_shadow=False,
                )

        for body, arm in ((model.body(f"{name}/base_link").id, name) for name in ARMS):
            base = self._frame(server, body, target=False)
            server.scene.add_label(f"{base}/label", arm, position=(0.0, 0.0, 0.35))

    def _frame(self, server: Any, body: int, *, target: bool) -> str:
        name = f"/{'targets' if target else 'cell'}/{body}"
        if (body, target) not in self._frames:
            self._frames[body, target] = server.scene.add_frame(name, show_axes=False)
        return name

    def show(self, row: Row) -> None:
        """Show the state of a row; only what has moved is sent."""
        self.poser.pose(row.qpos, row.mocap, row.commanded_rad)
        away_m = self.poser.away_m()
        for (body, target), frame in self._frames.items():
            if target:
                shown = bool(away_m[self._arms[body]] > _APART_M)
                if frame.visible != shown:
                    frame.visible = shown
                if not shown:
                    continue
            position, quat = self.poser.body(body, target=target)
            pose = np.concatenate([position, quat])
            sent = self._sent.get((body, target))
            if sent is not None and np.abs(pose - sent).max() < _MOVED_M:
                continue
            self._sent[body, target] = pose
            frame.position, frame.wxyz = position, quat


class Pictures:
    """Images of cameras, drawn as seldom as a tenth of a core allows."""

    def __init__(self, gui: Any, about: About, model: Any) -> None:
        self._model, self._cameras = model, about.cameras
        self._canvas: Canvas | None = None
        self._due_s = 0.0
        self.failure = ""
        blank = np.full((*_IMAGE_SIZE[::-1], 3), 40, np.uint8)
        with gui.add_folder("Cameras", expand_by_default=True) if about.cameras else contextlib.nullcontext():
            self._shown = {name: gui.add_image(blank, label=name, format="jpeg") for name in about.cameras}

    def draw(self, data: Any, now_s: Callable[[], float]) -> None:
        """Draw the images if they are due."""
        begun_s = now_s()
        if not self._shown or self.failure or begun_s < self._due_s:
            return
        import mujoco

        try:
            if self._canvas is None:
                self._canvas = Canvas(self._model, *_IMAGE_SIZE)
            mujoco.mj_camlight(self._model, data)
            for name, shown in self._shown.items():
                shown.image = self._canvas.image(data, name)
        except RenderError as error:
            self.failure = str(error)
        self._due_s = begun_s + max(_IMAGE_S, (now_s() - begun_s) / _IMAGE_SHARE)


class Plots:
    """Plots of the last seconds."""

    def __init__(self, gui: Any, about: About) -> None:
        self.history = History(np.array(about.speed_rad_s))
        none = np.array([-SHOWN_S, 0.0])
        blank = np.array([np.nan, np.nan])
        self._plots: list[tuple[Any, tuple[int, ...]]] = []
        with gui.add_folder("Plots", expand_by_default=False):
            for title, columns, names in (
                ("Tracking error, mrad", (1, 2), ARMS),
                ("Speed, share of the limit", (3, 4), ARMS),
                ("Clearance above the least, mm", (5,), ("arms",)),
                ("Lateness and skew, ms", (6, 7), ("late", "skew")),
            ):
                series = [{"label": "s"}, *_series(names)]
                plot = gui.add_uplot(
                    (none, *(blank for _ in columns)),
                    tuple(series),
                    title=title,
                    scales={"x": {"time": False, "auto": False, "range": (-SHOWN_S, 0.0)}, "y": {"auto": True}},
                    height=150,
                )
                self._plots.append((plot, columns))

    def draw(self, now_s: float) -> None:
        """Show the series."""
        series = self.history.series(now_s)
        if len(series[0]) < 2:
            return
        for plot, columns in self._plots:
            if any(np.isfinite(series[column]).any() for column in columns):
                plot.data = (series[0], *(_known(series[column]) for column in columns))


def _known(values: Array) -> Array:
    """Return values with the last known one, at first 0, in place of those that are not known: a plot needs all."""
    known = np.where(np.isfinite(values), np.arange(len(values)), -1)
    last = np.maximum.accumulate(known)
    return np.where(last < 0, 0.0, values[last])


def _series(names: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{"label": name, "stroke": rgb, "width": 1.5} for name, rgb in zip(names, _SERIES_RGB, strict=False)]


class Controllers:
    """Supervisor, latch and streams of a cell of controllers, from its memories."""

    def __init__(self, names: tuple[str, str, str]) -> None:
        self.cell = CellMemory(names[2])
        self.arms = ArmMemory(names[0]), ArmMemory(names[1])
        self.sending = Sending(self.arms)

    def words(self, now_s: float) -> dict[str, str]:
        """Return the lines of the page."""
        cell = self.cell
        age_s = now_s - cell.supervisor_beat_s
        if not cell.ready:
            supervisor = "starts"
        elif age_s < 1.0:
            supervisor = f"watches both arms, time scaling {100 * cell.time_scaling.goal:.0f} %"
        else:
            supervisor = f"no sign of life for {age_s:.1f} s"
        found = {"supervisor": supervisor, "latch": f"LATCHED: {cell.fault}" if cell.fault else "open, arms may move"}
        for name, memory in zip(ARMS, self.arms, strict=True):
            text = memory.text if memory.phase >= Phase.STOPPING else ""
            found[f"{name} stream"] = f"{memory.phase.name.lower()}{': ' if text else ''}{text}"
        return found

    def close(self) -> None:
        """Release the memories."""
        for each in (self.cell, *self.arms):
            each.close()


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
        self._words = gui.add_html(_table({}))
        cameras = *FIXED_CAMERAS, *about.scene.equipment.cameras
        viewpoints = {START: None, **{each.name: each for each in cameras}}
        group = gui.add_button_group(
            "View from", tuple(viewpoints), hint="Move this page's viewpoint, not those of others"
        )

        async def look(event: Any) -> None:
            _look(event.client, viewpoints[event.target.value])

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
                self._add_group(gui, "Policy", {_end_of(policy, names): name for policy, name in names.items()})
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
            _refuse(event.client)

    def _stop(self) -> None:
        """Latch a stop of both arms of controllers, without waiting for the program."""
        if self._controllers is not None:
            self._controllers.cell.enter_fault(STOPPED)

    def _gripper_of(self, arm: int) -> Callable[[Any], Any]:
        async def grip(event: Any) -> None:
            opening = 1.0 if event.target.value == "open" else 0.0
            if not self.commander.grip(event.client_id, arm, opening, self._drawing.poser.tool_targets()[arm]):
                _refuse(event.client)

        return grip

    async def _take(self, event: Any) -> None:
        if self.commander.take(event.client_id):
            self._add_handles(event.client)
        else:
            _refuse(event.client)

    async def _give_up(self, event: Any) -> None:
        if self.commander.give_up(event.client_id):
            self._remove_handles(event.client_id)

    # Pages that come and go.

    async def _enter(self, client: Any) -> None:
        if client.camera.aspect < _NARROW:
            _look(client, None)
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
                if self.commander.dragged(arm) or np.abs(handle.position - pose[:3]).max() < _MOVED_M:
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
        content = _table(words)
        if self._words.content != content:
            self._words.content = content

    def close(self) -> None:
        """Release the memories of the controllers."""
        if self._controllers is not None:
            self._controllers.close()


def _look(client: Any, camera: Camera | None) -> None:
    """Move the viewpoint of one page to that of a camera; None: to where it began."""
    start = _NARROW_CAMERA if client.camera.aspect < _NARROW else CAMERA
    position, at = start if camera is None else (camera.position_m, camera.target_m)
    with client.atomic():
        # Moving the position moves the point that is looked at, too.
        client.camera.position = position
        client.camera.look_at = at


def _end_of(name: str, names: Collection[str]) -> str:
    """Return the end of a long name, or the whole where another one ends likewise."""
    end = name[-_LONGEST:]
    return name if end == name or any(each.endswith(end) for each in names if each != name) else f"…{end}"


def _refuse(client: Any) -> None:
    client.add_notification(
        title="This page watches",
        body="Another page commands. When it is closed, or leaves the controls, press: Take the controls.",
        auto_close_seconds=6.0,
        color="orange",
    )


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


if not {*LOOKS, *SPEEDS, *POLICIES} == {*BUTTONS}:
    raise RuntimeError("every button of the page has a look")
