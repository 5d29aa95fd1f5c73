"""Images of a cell. OpenGL is loaded with the first image, never before."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import math
import os
import sys
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.visuals import CAMERAS
from dual_ur10.errors import RenderError, SettingsError, UnknownNameError
from ur_core.viewing.viewer import Viewer, has_display

RENDER_MODES = ("rgb_array", "human")

_MAX_PIXELS = (1920, 1080)

_BACKENDS = ("egl", "osmesa")  # without a display, in this order

_MAX_GEOMS = 10_000  # of a scene, as in MuJoCo's own renderer

# Faces of a cylinder around and along it. MuJoCo draws 28 and 16: outlines need the former, and along it faces matter
# only for the light on it.
_MOST_SLICES, _MOST_STACKS = 28, 8

_NO_GL = (
    "no OpenGL backend was found for drawing. On Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 "
    "libgl1-mesa-dri libopengl0 (or libosmesa6)"
)


_open: weakref.WeakSet[Canvas] = weakref.WeakSet()


class Canvas:
    """OpenGL context with the buffers for images of one model. One thread at a time may use it.

    It draws twice the width and height, and averages. Without a GPU this costs half as much as multisampling. A
    cylinder has only as many faces as its outline can show: most of the time without a GPU went into their corners.

    Args:
        model: MuJoCo's model. Its settings of visual quality are changed to fit the images.
        width, height: Size of images in pixels.
        shadows: Draw shadows and reflections.

    Attributes:
        parallel: True if several canvases may draw at the same time, each in a thread of its own.

    Raises:
        RenderError: No OpenGL backend was found; the message names the package to install.
    """

    def __init__(self, model: Any, width: int, height: int, *, shadows: bool = False) -> None:
        import mujoco

        size = 2 * width, 2 * height
        buffer, quality = model.vis.global_, model.vis.quality
        buffer.offwidth, buffer.offheight = size
        quality.offsamples = 0
        # The error of an outline is inversely proportional to the square of the number of faces: 0.25 pixels here for
        # a radius of a twentieth of the image.
        quality.numslices = min(_MOST_SLICES, math.ceil(1.25 * math.sqrt(height)))
        quality.numstacks = min(_MOST_STACKS, math.ceil(quality.numslices / 2))
        if not shadows:
            quality.shadowsize = 0  # saves 64 MiB
        self._gl, self._context = _contexts(model, *size)
        if not _open:
            atexit.unregister(_close_all)
            atexit.register(_close_all)  # before MuJoCo's own end of OpenGL, which is registered by now
        _open.add(self)
        self.parallel = type(self._gl).__module__ == "mujoco.egl"
        self._model, self._size = model, (height, width, 3)
        self._rect = mujoco.MjrRect(0, 0, *size)
        self._scene, self._option = mujoco.MjvScene(model, _MAX_GEOMS), mujoco.MjvOption()
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = shadows
        self._cameras: dict[str, Any] = {}
        self._read = np.empty((size[1], size[0], 3), np.uint8)

    def image(
        self,
        data: Any,
        camera: str,
        out: NDArray[np.uint8] | None = None,
        mark: Callable[[Any], None] | None = None,
    ) -> NDArray[np.uint8]:
        """Return an image, (height, width, 3).

        Args:
            data: Data of the model, with the poses of geoms, cameras and lights.
            camera: Name of a camera of the model.
            out: Array for the image; None: a new one.
            mark: Function that adds geoms to MuJoCo's scene before it is drawn; None: there are no more.
        """
        import mujoco

        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera(camera), mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        if mark is not None:
            mark(self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._read, None, self._rect, self._context)
        image = np.empty(self._size, np.uint8) if out is None else out
        image[...] = _halved(self._read)[::-1]  # OpenGL's first row is the lowest
        return image

    def _camera(self, name: str) -> Any:
        import mujoco

        if name not in self._cameras:
            camera = mujoco.MjvCamera()
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._model.camera(name).id
            self._cameras[name] = camera
        return self._cameras[name]

    def release(self) -> None:
        """Detach the context from the calling thread, so that another one may use it."""
        if self.parallel:
            egl = importlib.import_module("mujoco.egl")
            none = egl.EGL.EGL_NO_SURFACE
            egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, none, none, egl.EGL.EGL_NO_CONTEXT)

    def close(self) -> None:
        """Release OpenGL. May be called twice."""
        gl, self._gl = self._gl, None
        if gl is not None:
            gl.make_current()
            self._context.free()
            gl.free()

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # nobody can catch them here
            self.close()


def _close_all() -> None:
    """Close what nobody closed, at the end of the program."""
    for canvas in list(_open):
        canvas.close()


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the rounded mean of each square of 2 × 2 pixels."""
    rows = np.add(image[0::2], image[1::2], dtype=np.uint16).reshape(len(image) // 2, -1)
    halved = np.empty((len(rows), image.shape[1] // 2, 3), np.uint16)
    for color in range(3):  # one at a time: loops over three colours take four times as long
        np.add(rows[:, color::6], rows[:, color + 3 :: 6], out=halved[..., color])
    halved += 2
    halved >>= 2
    return halved


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
        check_size(width, height)
        self.camera, self.width, self.height, self.shadows = camera, width, height, shadows
        self.viewer = Viewer()
        self._canvas: Canvas | None = None

    def draw(self, mode: str, model: Any, data: Any) -> NDArray[np.uint8] | None:
        """Return an image with "rgb_array"; show the data in the viewer with "human" and return None."""
        if mode == "rgb_array":
            return self.image(model, data)
        self.viewer.show(model, data)
        return None

    def image(self, model: Any, data: Any) -> NDArray[np.uint8]:
        """Return an image of the camera, (height, width, 3).

        Args:
            model: The same object at every call.
            data: Its data.

        Raises:
            RenderError: No OpenGL backend was found; the message names the package to install.
        """
        if self._canvas is None:
            self._canvas = Canvas(model, self.width, self.height, shadows=self.shadows)
        return self._canvas.image(data, self.camera)

    def close(self) -> None:
        """Release viewer and OpenGL. May be called twice."""
        if self._canvas is not None:
            self._canvas.close()
        self._canvas = None
        self.viewer.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_canvas": None, "viewer": Viewer()}


def check_size(width: int, height: int) -> None:
    """Check the size of an image.

    Raises:
        SettingsError: A number is not possible.
    """
    for name, value, most in (("width", width, _MAX_PIXELS[0]), ("height", height, _MAX_PIXELS[1])):
        if not (isinstance(value, int) and 1 <= value <= most):
            raise SettingsError(f"{name} is {value!r}: it must be a whole number of pixels, 1 to {most}")


def _contexts(model: Any, width: int, height: int) -> tuple[Any, Any]:
    """Return OpenGL's context and MuJoCo's; on Linux without a display by EGL, else OSMesa, unless MUJOCO_GL is set."""
    import mujoco

    named = has_display() or os.environ.get("MUJOCO_GL")
    reasons, last = [], None
    for backend in (None,) if named else _BACKENDS:
        try:
            if backend is not None:
                return _contexts_by(backend, model, width, height)
            return _bound(mujoco.GLContext(width, height), model)
        except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, FatalError, ...
            reasons.append(f"{backend}: {error}" if backend else str(error))
            last = error
    raise RenderError(f"{_NO_GL}. MuJoCo reports: {'; '.join(reasons)}") from last


def _contexts_by(backend: str, model: Any, width: int, height: int) -> tuple[Any, Any]:
    """Return the contexts by one backend. A failure leaves nothing behind that hinders the next one."""
    loaded = set(sys.modules)
    named = {name: os.environ.get(name) for name in ("PYOPENGL_PLATFORM", "MUJOCO_GL")}
    try:
        os.environ["MUJOCO_GL"] = backend  # MuJoCo's own library reads it, and otherwise takes another loaded backend
        return _bound(importlib.import_module(f"mujoco.{backend}").GLContext(width, height), model)
    except Exception:
        # PyOpenGL binds to one backend, named in the environment, when it is first imported.
        _restore("PYOPENGL_PLATFORM", named)
        for name in set(sys.modules) - loaded:
            if name.split(".")[0] in ("OpenGL", "OpenGL_accelerate") or name.startswith(f"mujoco.{backend}"):
                del sys.modules[name]
        raise
    finally:
        _restore("MUJOCO_GL", named)


def _bound(gl: Any, model: Any) -> tuple[Any, Any]:
    """Return an OpenGL context and MuJoCo's in it, which draws off the screen."""
    import mujoco

    gl.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context


def _restore(name: str, values: dict[str, str | None]) -> None:
    value = values[name]
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value
