"""MuJoCo's web viewer in a process of its own: `python -m ur_core.viewing.web_viewer`, started by `Viewer`.

A second viewer in the same process crashes MuJoCo 4.0, and a running one hooks into the logging and the exceptions of
its program: hence a process of its own. It reads frames from its input, each a length of eight bytes and its content:
first the model, then states of the simulation. It writes one line of JSON, with its address or an error, and ends with
its input, so that it never outlives the program that started it.
"""

from __future__ import annotations

import importlib
import io
import json
import logging
import os
import socket
import sys
import threading
import time
from typing import Any, BinaryIO

import numpy as np

from ur_core.errors import RenderError
from ur_core.viewing.viewer import AZIMUTH_DEG, ELEVATION_DEG, LENGTH

LOOPBACK = "127.0.0.1"
"""Only address of the web viewer: it has neither passwords nor encryption."""

_STUDIOS = (("mujoco.studio", "app", "App", "Config"), ("mujoco.experimental.studio", "viewer_app", "ViewerApp", ""))
"""Packages of MuJoCo's web viewer: since 4.0, and in 3.17."""

_START_S = 30.0
_FRAME_S = 1 / 60


def studio() -> tuple[dict[str, Any], Any]:
    """Return the modules of MuJoCo's web viewer, and its user interface.

    Raises:
        RenderError: This MuJoCo has none.
    """
    for package, app_module, app_class, config_class in _STUDIOS:
        try:
            names = ("viewer_protocol", "web_viewer", "launch_thread")
            modules = {name: importlib.import_module(f"{package}.{name}") for name in names}
            app = importlib.import_module(f"{package}.{app_module}")
        except ImportError:
            continue
        # The panels of the model start closed, as the motion matters here.
        settings = [getattr(app, config_class)(show_options=False, show_inspector=False)] if config_class else []
        return modules, getattr(app, app_class)(*settings)
    raise RenderError(
        "there is neither a display nor MuJoCo's web viewer: use render_mode='rgb_array', or install MuJoCo 4.0 or "
        "later, which brings the web viewer"
    )


def on_loopback(web_viewer: Any) -> Any:
    """Return MuJoCo's web viewer, restricted to the loopback interface.

    MuJoCo listens on all interfaces and offers no setting for it. The returned class overrides the host of the socket,
    checks the socket before it listens, and raises an error if a later MuJoCo chooses another address.

    Args:
        web_viewer: The class `WebViewer` of MuJoCo.
    """

    class LoopbackWebViewer(web_viewer):  # type: ignore[misc]  # the base is known at run time only
        _http_sock: socket.socket

        @property
        def _host(self) -> str:
            return LOOPBACK

        @_host.setter
        def _host(self, host: str) -> None:
            """Ignore "::", which MuJoCo sets here."""

        def _start_server(self) -> None:
            self._check()
            try:
                self._http_sock.listen()
            except OSError:  # another viewer took the same port at the same moment: any other will do
                self._http_sock.close()
                self._http_sock = socket.create_server((LOOPBACK, 0))
            super()._start_server()

        def _check(self) -> tuple[str, int]:
            address: tuple[str, int] = self._http_sock.getsockname()[:2]
            if address[0] != LOOPBACK:
                raise RenderError(
                    f"this version of MuJoCo would open its web viewer to the network, at {address[0]}: it was not "
                    "started. Use a machine with a display, or render_mode='rgb_array'"
                )
            return address

        @property
        def loopback_url(self) -> str:
            host, port = self._check()
            return f"http://{host}:{port}/"

    return LoopbackWebViewer


def open_viewer(model: Any) -> tuple[Any, str]:
    """Start the web viewer in a thread, and return MuJoCo's handle of it and its address.

    Raises:
        RenderError: It did not start.
    """
    modules, app = studio()
    protocol, kind = modules["viewer_protocol"], on_loopback(modules["web_viewer"].WebViewer)
    config = protocol.ViewerConfig(title="dual-ur10", gfx="web")
    started, address, failures = threading.Event(), [], []

    def target(endpoint: Any) -> None:
        try:
            # With the model from the start: after a later change of model, every browser would load its page again.
            viewer = kind(config, endpoint, model=model, plugins=[app])
            address.append(viewer.loopback_url)
        except Exception as error:
            failures.append(error)
            return
        finally:
            started.set()
        protocol.run_viewer_loop(viewer)

    handle = modules["launch_thread"].launch_thread(target)
    if not started.wait(_START_S):
        raise RenderError(f"MuJoCo's web viewer did not start within {_START_S:g} s")
    if failures:
        raise RenderError(f"MuJoCo's web viewer did not start: {failures[0]}") from failures[0]
    return handle, address[0]


class Latest:
    """Last frame of an input, read in a thread.

    Attributes:
        ended: True once the input has ended.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._frame: bytes | None = None
        self.ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while (frame := read_frame(self._stream)) is not None:
            self._frame = frame
        self.ended = True

    def take(self) -> bytes | None:
        """Return the last frame since the last call, if there was one."""
        frame, self._frame = self._frame, None
        return frame


def read_frame(stream: BinaryIO) -> bytes | None:
    """Return the next frame, or None at the end of the input."""
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (length,) = LENGTH.unpack(head)
    frame = stream.read(length)
    return frame if len(frame) == length else None


def serve(stream: BinaryIO, answer: io.TextIOBase) -> None:
    """Show the model and the states from `stream`, until it ends or the user closes the viewer."""
    import mujoco

    binary = read_frame(stream)
    if binary is None:
        return
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": binary})
    model.vis.global_.azimuth, model.vis.global_.elevation = AZIMUTH_DEG, ELEVATION_DEG
    # The browser's renderer makes a darker picture of the same lights.
    model.vis.headlight.ambient, model.vis.headlight.diffuse = (0.6,) * 3, (0.7,) * 3
    model.light_diffuse *= 2.0
    data = mujoco.MjData(model)
    kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    try:
        handle, url = open_viewer(model)
        reply = {"url": url}
    except RenderError as error:
        reply = {"error": str(error)}
    answer.write(json.dumps(reply) + "\n")
    answer.flush()
    if "error" in reply:
        return
    # The viewer started with this model and these data, so no change is announced.
    handle.model, handle.data = model, data
    latest = Latest(stream)
    while not latest.ended and handle.is_running():
        state = latest.take()
        if state is not None:
            mujoco.mj_setState(model, data, np.frombuffer(state), kind)
        handle.sync(model, data)
        time.sleep(_FRAME_S)
    handle.close()


def main() -> None:
    """Run the process."""
    # MuJoCo prints a banner and logs its visitors, but the output is for the answer alone.
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    logging.getLogger().setLevel(logging.ERROR)
    serve(sys.stdin.buffer, answer)
    os._exit(0)  # threads of the viewer may still use MuJoCo, whose modules would be unloaded


if __name__ == "__main__":
    main()
