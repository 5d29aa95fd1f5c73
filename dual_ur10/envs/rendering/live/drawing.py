"""Arms, objects and images of cameras in the browser."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.scene import MOVED_M, Poser, parts_of, swollen
from dual_ur10.errors import RenderError
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

APART_M: Final = 0.02
"""Distance of a tool from its target from which on the target is shown."""

_IMAGE_SIZE: Final = (320, 240)
_IMAGE_S: Final = 0.25
_IMAGE_SHARE: Final = 0.1  # of a core, at most, for drawing images
_SWOLLEN_M: Final = 0.003  # of the target's surfaces: where they lie on those of the arm, a browser mixes both
_TARGET_OPACITY: Final = 0.3

TARGET_RGB: Final = ((40, 120, 255), (255, 120, 20))
"""Red, green and blue, 0 to 255, of the target of each arm."""


class Drawing:
    """Both arms, their targets and the objects in the browser's scene.

    Args:
        server: viser's server.
        model: MuJoCo's model of the cell.
        poser: Poses of its bodies.
    """

    def __init__(self, server: Any, model: Any, poser: Poser) -> None:
        self._poser = poser
        self._frames: dict[tuple[int, bool], Any] = {}
        self._sent: dict[tuple[int, bool], Array] = {}
        self._arms = {
            body: 0 if model.body(body).name.startswith(f"{ARMS[0]}/") else 1 for body in self._poser.arm_bodies
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
                    swollen(part.vertices, part.faces, _SWOLLEN_M).astype(np.float32),
                    part.faces,
                    color=TARGET_RGB[self._arms[part.body]],
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

    def draw(self) -> None:
        """Show the poses of all bodies; only what has moved is sent."""
        away_m = self._poser.away_m()
        for (body, target), frame in self._frames.items():
            if target:
                shown = bool(away_m[self._arms[body]] > APART_M)
                if frame.visible != shown:
                    frame.visible = shown
                if not shown:
                    continue
            position, quat = self._poser.body(body, target=target)
            pose = np.concatenate([position, quat])
            sent = self._sent.get((body, target))
            if sent is not None and np.abs(pose - sent).max() < MOVED_M:
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

    def draw(
        self, data: Any, now_s: Callable[[], float], taken: Callable[[float], Mapping[str, NDArray[np.uint8]]]
    ) -> None:
        """Show the images if they are due.

        Args:
            data: Data of the model, with the poses of its bodies.
            now_s: Function that returns the time.
            taken: Function of the time that returns images of cameras by their names; the others are drawn.
        """
        begun_s = now_s()
        if not self._shown or begun_s < self._due_s:
            return
        images = taken(begun_s)
        for name in self._shown.keys() & images.keys():
            self._shown[name].image = images[name]
        others = [name for name in self._shown if name not in images]
        if others and not self.failure:
            try:
                self._draw(data, others)
            except RenderError as error:
                self.failure = str(error)
        self._due_s = begun_s + max(_IMAGE_S, (now_s() - begun_s) / _IMAGE_SHARE)

    def _draw(self, data: Any, names: list[str]) -> None:
        """Draw images of the model.

        Raises:
            RenderError: No OpenGL backend was found.
        """
        import mujoco

        if self._canvas is None:
            self._canvas = Canvas(self._model, *_IMAGE_SIZE)
        mujoco.mj_camlight(self._model, data)
        for name in names:
            self._shown[name].image = self._canvas.image(data, name)
