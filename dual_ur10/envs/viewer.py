"""A viewer of a running simulation: MuJoCo's window, or its web viewer where there is no display."""

from __future__ import annotations

import contextlib
import copy
import importlib
import io
import logging
import os
import sys
import threading
from typing import Any

from dual_ur10.errors import RenderError

LOOPBACK = "127.0.0.1"
"""The only address that the web viewer listens on: it has neither passwords nor encryption."""

_STUDIOS = (("mujoco.studio", "app", "App", "Config"), ("mujoco.experimental.studio", "viewer_app", "ViewerApp", ""))
"""Where MuJoCo keeps its web viewer since 4.0, and where it was in 3.17."""

_AZIMUTH_DEG, _ELEVATION_DEG = 136.0, -24.0  # of the camera "perspective" of `dual_ur10.assets.scene`
_START_S = 30.0

logger = logging.getLogger(__name__)


def has_display() -> bool:
    """Whether a window can be expected to open: on Linux, whether a display is named."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Viewer:
    """Shows MuJoCo's model and data while they change. It opens with the first `show`.

    Attributes:
        url: Address of the web viewer, for a browser on this machine; None with a window, or before the first `show`.
    """

    def __init__(self) -> None:
        self.url: str | None = None
        self._shown: Any = None  # MuJoCo's window or `_WebViewer`

    def show(self, model: Any, data: Any) -> None:
        """Show the data as they are now. Does nothing once the viewer was closed by hand.

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
        if has_display():
            try:
                self._shown = _window(model, data)
                return
            except Exception as error:  # a display that is named may still be out of reach, and each system says so
                logger.info("no window could be opened (%s): using the web viewer", error)
        self._shown = _WebViewer(model, data)
        self.url = self._shown.url
        logger.info("the viewer is at %s", self.url)

    def is_running(self) -> bool:
        """Whether the viewer is open. False before the first `show`, and after it was closed by hand."""
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
        window.cam.azimuth, window.cam.elevation = _AZIMUTH_DEG, _ELEVATION_DEG
    return window


class _WebViewer:
    """MuJoCo's web viewer in a thread, on the loopback interface."""

    def __init__(self, model: Any, data: Any) -> None:
        studio, app = _studio()
        drawn = copy.deepcopy(model)
        drawn.vis.global_.azimuth, drawn.vis.global_.elevation = _AZIMUTH_DEG, _ELEVATION_DEG
        config = studio["viewer_protocol"].ViewerConfig(title="dual-ur10", gfx="web")
        kind = _on_loopback(studio["web_viewer"].WebViewer)
        started = threading.Event()
        self.url = ""

        def target(endpoint: Any) -> None:
            try:
                viewer = kind(config, endpoint, model=drawn, plugins=[app])
                self.url = viewer.loopback_url
            finally:
                started.set()
            studio["viewer_protocol"].run_viewer_loop(viewer)

        # MuJoCo prints a banner about an address for everybody; this program says itself where its viewer is.
        logging.getLogger("WebServer").setLevel(logging.WARNING)
        with contextlib.redirect_stdout(io.StringIO()):
            self._handle = studio["launch_thread"].launch_thread(target)
            started.wait(_START_S)
        if not self.url:
            try:
                self._handle.close()
            except Exception as error:
                raise RenderError(f"MuJoCo's web viewer did not start: {error}") from error
            raise RenderError(f"MuJoCo's web viewer did not start within {_START_S:g} s")
        # The viewer has this model already: what it would be told of a new one makes every browser load it again.
        self._handle.model, self._handle.data = model, data
        self._own = model, data

    def sync(self) -> None:
        self._handle.sync(*self._own)

    def is_running(self) -> bool:
        try:
            return bool(self._handle.is_running())
        except Exception as error:  # what ended the viewer's thread comes out here
            logger.warning("the web viewer ended: %s", error)
            return False

    def close(self) -> None:
        with contextlib.suppress(Exception):  # what ended the viewer's thread; there is nothing left to close
            self._handle.close()


def _studio() -> tuple[dict[str, Any], Any]:
    """The modules of MuJoCo's web viewer, and its user interface.

    Raises:
        RenderError: This MuJoCo has none.
    """
    for package, app_module, app_class, config_class in _STUDIOS:
        try:
            names = ("viewer_protocol", "web_viewer", "launch_thread")
            modules = {name: importlib.import_module(f"{package}.{name}") for name in names}
            app = importlib.import_module(f"{package}.{app_module}")
        except ImportError as error:
            logger.debug("%s: %s", package, error)
            continue
        settings = () if not config_class else (getattr(app, config_class)(show_options=False, show_inspector=False),)
        return modules, getattr(app, app_class)(*settings)
    raise RenderError(
        "render_mode='human' needs a display or MuJoCo's web viewer, and found neither: use 'rgb_array', or install "
        "MuJoCo 4.0 or later, which brings the web viewer"
    )


def _on_loopback(web_viewer: Any) -> Any:
    """MuJoCo's web viewer, kept to the loopback interface.

    MuJoCo listens on all interfaces and offers no setting for it. This narrows the host that it takes its socket
    from, looks at the socket before anything listens on it, and refuses to go on if a later MuJoCo does otherwise.
    """

    class LoopbackWebViewer(web_viewer):  # type: ignore[misc]
        @property
        def _host(self) -> str:
            return LOOPBACK

        @_host.setter
        def _host(self, host: str) -> None:
            """MuJoCo sets "::" here."""

        def _start_server(self) -> None:
            self._check()
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
