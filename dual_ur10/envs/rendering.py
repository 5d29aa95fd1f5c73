"""Drawing a cell: images, and a viewer. OpenGL is loaded with the first picture, never before."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import CAMERAS
from dual_ur10.envs.viewer import Viewer, has_display
from dual_ur10.errors import RenderError, SettingsError, UnknownNameError

RENDER_MODES = ("rgb_array", "human")

_MAX_PIXELS = (1920, 1080)  # the offscreen buffer of the scene

_NO_GL = (
    "no OpenGL backend was found for drawing. On Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 "
    "libgl1-mesa-dri (or libosmesa6, with MUJOCO_GL=osmesa)"
)


class Renderer:
    """Draws MuJoCo's model and data.

    Args:
        camera: One of `dual_ur10.assets.scene.CAMERAS`.
        width, height: Size of images in pixels, at most 1920 × 1080.
        shadows: Shadows and reflections; without a GPU they cost five to seven times the rest of a picture.

    Raises:
        UnknownNameError: No such camera.
        SettingsError: A size is not possible.
    """

    def __init__(self, camera: str = "perspective", width: int = 640, height: int = 480, shadows: bool = False) -> None:
        if camera not in CAMERAS:
            raise UnknownNameError("camera", str(camera), CAMERAS)
        for name, value, most in (("width", width, _MAX_PIXELS[0]), ("height", height, _MAX_PIXELS[1])):
            if not (isinstance(value, int) and 1 <= value <= most):
                raise SettingsError(f"{name} is {value!r}: it must be a whole number of pixels, 1 to {most}")
        self.camera, self.width, self.height, self.shadows = camera, width, height, shadows
        self.viewer = Viewer()
        self._offscreen: Any = None

    def draw(self, mode: str, model: Any, data: Any) -> NDArray[np.uint8] | None:
        """An image with "rgb_array"; with "human", None, and the viewer shows the data."""
        if mode == "rgb_array":
            return self.image(model, data)
        self.viewer.show(model, data)
        return None

    def image(self, model: Any, data: Any) -> NDArray[np.uint8]:
        """An image, (height, width, 3).

        Raises:
            RenderError: No OpenGL backend was found; the message says which package to install.
        """
        if self._offscreen is None:
            self._offscreen = _offscreen(model, self.height, self.width)
        self._offscreen.update_scene(data, camera=self.camera)
        flags = self._offscreen.scene.flags
        import mujoco

        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            flags[flag] = self.shadows
        pixels: NDArray[np.uint8] = self._offscreen.render()
        return pixels

    def close(self) -> None:
        """Release viewer and OpenGL. May be called twice."""
        if self._offscreen is not None:
            self._offscreen.close()
        self._offscreen = None
        self.viewer.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_offscreen": None, "viewer": Viewer()}


def _offscreen(model: Any, height: int, width: int) -> Any:
    """MuJoCo's offscreen renderer; on a Linux machine without a display by EGL, unless MUJOCO_GL says otherwise."""
    import mujoco

    try:
        if not has_display() and not os.environ.get("MUJOCO_GL"):
            # MuJoCo chose a backend that needs a display when it was imported, before anything was to be drawn.
            from mujoco.egl import GLContext
            from mujoco.rendering.classic import gl_context

            gl_context.GLContext = GLContext
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, FatalError, ...
        raise RenderError(f"{_NO_GL}. MuJoCo said: {error}") from error
