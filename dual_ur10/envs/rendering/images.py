"""Images of a cell. OpenGL is loaded with the first image, never before."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.visuals import CAMERAS
from dual_ur10.envs.rendering.viewer import Viewer, has_display
from dual_ur10.errors import RenderError, SettingsError, UnknownNameError

RENDER_MODES = ("rgb_array", "human")

_MAX_PIXELS = (1920, 1080)  # size of the offscreen buffer of the scene

_BACKENDS = ("egl", "osmesa")  # without a display, in this order

_NO_GL = (
    "no OpenGL backend was found for drawing. On Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 "
    "libgl1-mesa-dri (or libosmesa6)"
)


class Renderer:
    """Renderer of MuJoCo's model and data, to images or to a viewer.

    Args:
        camera: Default camera.
        width, height: Size of images in pixels, at most 1920 × 1080.
        shadows: Shadows and reflections; without a GPU they cost five to seven times the rest of an image.
        cameras: Names of the scene's cameras.

    Raises:
        UnknownNameError: There is no such camera.
        SettingsError: A size is not possible.
    """

    def __init__(
        self,
        camera: str = "perspective",
        width: int = 640,
        height: int = 480,
        shadows: bool = False,
        *,
        cameras: Sequence[str] = CAMERAS,
    ) -> None:
        if camera not in cameras:
            raise UnknownNameError("camera", str(camera), list(cameras))
        for name, value, most in (("width", width, _MAX_PIXELS[0]), ("height", height, _MAX_PIXELS[1])):
            if not (isinstance(value, int) and 1 <= value <= most):
                raise SettingsError(f"{name} is {value!r}: it must be a whole number of pixels, 1 to {most}")
        self.camera, self.width, self.height, self.shadows = camera, width, height, shadows
        self.viewer = Viewer()
        self._offscreen: Any = None

    def draw(self, mode: str, model: Any, data: Any) -> NDArray[np.uint8] | None:
        """Return an image with "rgb_array"; show the data in the viewer with "human" and return None."""
        if mode == "rgb_array":
            return self.image(model, data)
        self.viewer.show(model, data)
        return None

    def image(
        self, model: Any, data: Any, camera: str | None = None, out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Return an image, (height, width, 3).

        Args:
            model: The same object at every call.
            data: Its data.
            camera: Camera; None: the default.
            out: Contiguous array for the image; None: a new one.

        Raises:
            RenderError: No OpenGL backend was found; the message names the package to install.
        """
        if self._offscreen is None:
            self._offscreen = _offscreen(model, self.height, self.width)
        self._offscreen.update_scene(data, camera=camera or self.camera)
        flags = self._offscreen.scene.flags
        import mujoco

        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            flags[flag] = self.shadows
        pixels: NDArray[np.uint8] = self._offscreen.render(out=out)
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
    """Return MuJoCo's offscreen renderer; on Linux without a display by EGL, else OSMesa, unless MUJOCO_GL is set."""
    import mujoco

    named = has_display() or os.environ.get("MUJOCO_GL")
    reasons, last = [], None
    for backend in (None,) if named else _BACKENDS:
        try:
            if backend is not None:
                return _offscreen_by(backend, model, height, width)
            return mujoco.Renderer(model, height, width)
        except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, FatalError, ...
            reasons.append(f"{backend}: {error}" if backend else str(error))
            last = error
    raise RenderError(f"{_NO_GL}. MuJoCo reports: {'; '.join(reasons)}") from last


def _offscreen_by(backend: str, model: Any, height: int, width: int) -> Any:
    """Return MuJoCo's offscreen renderer by one backend. A failure leaves nothing behind that hinders the next one."""
    import mujoco
    from mujoco.rendering.classic import gl_context

    # When it was imported, MuJoCo chose a backend that needs a display.
    chosen, loaded = gl_context.GLContext, set(sys.modules)
    named = {name: os.environ.get(name) for name in ("PYOPENGL_PLATFORM", "MUJOCO_GL")}
    try:
        gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
        os.environ["MUJOCO_GL"] = backend  # MuJoCo's own library reads it, and otherwise takes another loaded backend
        return mujoco.Renderer(model, height, width)
    except Exception:
        gl_context.GLContext = chosen
        # PyOpenGL binds to one backend, named in the environment, when it is first imported.
        _restore("PYOPENGL_PLATFORM", named)
        for name in set(sys.modules) - loaded:
            if name.split(".")[0] in ("OpenGL", "OpenGL_accelerate") or name.startswith(f"mujoco.{backend}"):
                del sys.modules[name]
        raise
    finally:
        _restore("MUJOCO_GL", named)


def _restore(name: str, values: dict[str, str | None]) -> None:
    value = values[name]
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value
