"""Viewer of a running simulation: MuJoCo's window, or its web viewer where there is no display."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import struct
import subprocess
import sys
from typing import Any

import numpy as np

from ur_core.errors import RenderError

AZIMUTH_DEG, ELEVATION_DEG = 136.0, -24.0
"""Initial viewpoint, in front of the arms and to their left."""

LENGTH = struct.Struct("<Q")
"""Length of a frame, before its bytes, on the way to the web viewer."""

_END_S = 10.0

logger = logging.getLogger(__name__)


def has_display() -> bool:
    """Return True if a window can be expected to open: on Linux, if a display is named."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Viewer:
    """Live view of MuJoCo's model and data. It opens with the first `show`.

    Args:
        web: Use the web viewer even where there is a display.

    Attributes:
        url: Address of the web viewer, for a browser on this machine; None with a window, or before the first `show`.
    """

    def __init__(self, *, web: bool = False) -> None:
        self._web = web
        self.url: str | None = None
        self._shown: Any = None  # MuJoCo's window or `_WebViewer`

    def show(self, model: Any, data: Any) -> None:
        """Show the current data. Do nothing once the user has closed the viewer.

        Args:
            model: The same object at every call.
            data: The same object at every call.

        Raises:
            RenderError: There is neither a display nor a web viewer.
        """
        if self._shown is None:
            self._open(model, data)
        if self._shown.is_running():
            self._shown.sync()

    def _open(self, model: Any, data: Any) -> None:
        if has_display() and not self._web:
            try:
                self._shown = _window(model, data)
                return
            except Exception as error:  # a named display may be unreachable, and each system reports that differently
                logger.info("no window could be opened (%s): using the web viewer", error)
        self._shown = _WebViewer(model, data)
        self.url = self._shown.url
        logger.info("the viewer is at %s", self.url)

    def is_running(self) -> bool:
        """Return True while the viewer is open: not before the first `show`, nor after the user has closed it."""
        return self._shown is not None and bool(self._shown.is_running())

    def close(self) -> None:
        """Close window or server. May be called twice."""
        shown, self._shown, self.url = self._shown, None, None
        if shown is not None:
            shown.close()


def _window(model: Any, data: Any) -> Any:
    import mujoco.viewer

    window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    with window.lock():
        window.cam.lookat, window.cam.distance = model.stat.center, 1.5 * model.stat.extent
        window.cam.azimuth, window.cam.elevation = AZIMUTH_DEG, ELEVATION_DEG
    return window


class _WebViewer:
    """Process of `ur_core.viewing.web_viewer`, and the model and data that it shows."""

    def __init__(self, model: Any, data: Any) -> None:
        import mujoco

        self._model, self._data = model, data
        self._kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        self._state = np.empty(mujoco.mj_stateSize(model, self._kind))
        binary = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, binary)
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ur_core.viewing.web_viewer"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # It has the same import path, and Ctrl-C is for this program alone.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        self._send(binary.tobytes())
        reply = json.loads(self._answer() or '{"error": "its process ended"}')
        if "error" in reply:
            self.close()
            raise RenderError(f"there is no display, and the web viewer did not start: {reply['error']}")
        self.url: str = reply["url"]

    def _answer(self) -> bytes:
        return self.process.stdout.readline() if self.process.stdout is not None else b""

    def _send(self, frame: bytes) -> None:
        if self.process.stdin is None:
            return
        # The user may just have closed it, which `is_running` reports.
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(LENGTH.pack(len(frame)) + frame)
            self.process.stdin.flush()

    def sync(self) -> None:
        import mujoco

        mujoco.mj_getState(self._model, self._data, self._state, self._kind)
        self._send(self._state.tobytes())

    def is_running(self) -> bool:
        return self.process.poll() is None

    def close(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
