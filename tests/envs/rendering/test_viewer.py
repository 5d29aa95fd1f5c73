"""Viewer without a display: a server on the loopback interface alone."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import psutil
import pytest
from gymnasium.utils.env_checker import check_env

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import RenderError
from ur_core.viewing import viewer as module
from ur_core.viewing import web_viewer
from ur_core.viewing.viewer import Viewer

ENV_ID = "DualUR10/SineTracking-v0"
WAIT_S = 10.0


@pytest.fixture(autouse=True)
def _no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "has_display", lambda: False)


@pytest.fixture
def scene() -> tuple[Any, Any]:
    import mujoco

    model = build_model(SceneSettings())
    return model, mujoco.MjData(model)


@pytest.fixture
def opened(scene: tuple[Any, Any]) -> Iterator[Viewer]:
    viewer = Viewer()
    viewer.show(*scene)
    yield viewer
    viewer.close()


def listening() -> set[tuple[str, int]]:
    """Return the addresses on which this process and its viewers listen."""
    me = psutil.Process()
    found = [each for process in (me, *me.children()) for each in process.net_connections(kind="inet")]
    return {tuple(each.laddr) for each in found if each.status == psutil.CONN_LISTEN}


def test_it_listens_on_the_loopback_interface_only(scene: tuple[Any, Any]) -> None:
    before, viewer = listening(), Viewer()
    assert viewer.url is None
    viewer.show(*scene)
    try:
        new = listening() - before
        assert viewer.url in {f"http://{host}:{port}/" for host, port in new}
        assert {host for host, _ in new} == {"127.0.0.1"}
    finally:
        viewer.close()
    assert not (listening() & new)


def test_two_viewers_at_once_and_another_afterwards(scene: tuple[Any, Any]) -> None:
    first, second = Viewer(), Viewer()
    try:
        for viewer in (first, second):
            viewer.show(*scene)
        assert first.url != second.url
        first.close()
        second.show(*scene)
        assert second.is_running()
        first.show(*scene)
        assert first.is_running()
    finally:
        first.close()
        second.close()


def test_a_viewer_that_ended_by_itself_stops_nothing(opened: Viewer, scene: tuple[Any, Any]) -> None:
    opened._shown.process.kill()
    opened._shown.process.wait(WAIT_S)
    for _ in range(3):
        opened._shown.sync()  # as when it ends between the question and the sending
    opened.show(*scene)
    assert not opened.is_running()


def test_the_server_ends_with_the_program_that_opened_it(scene: tuple[Any, Any]) -> None:
    viewer = Viewer()
    viewer.show(*scene)
    viewer._shown.process.stdin.close()  # as when the program is killed
    assert viewer._shown.process.wait(WAIT_S) == 0
    viewer.close()


def test_it_serves_the_page_and_the_model(opened: Viewer) -> None:
    assert opened.url is not None
    assert opened.is_running()
    with urllib.request.urlopen(opened.url, timeout=WAIT_S) as page:
        assert page.status == 200
        assert b"<html" in page.read().lower()
    with urllib.request.urlopen(opened.url + "model", timeout=WAIT_S) as model:
        assert len(model.read()) > 10_000  # not the empty model that a viewer begins with


def test_showing_again_keeps_the_server(opened: Viewer, scene: tuple[Any, Any]) -> None:
    url = opened.url
    for _ in range(3):
        opened.show(*scene)
    assert opened.url == url
    assert opened.is_running()


def test_closing_ends_the_server(opened: Viewer) -> None:
    url = opened.url
    assert url is not None
    opened.close()
    opened.close()
    assert not opened.is_running()
    assert opened.url is None
    with pytest.raises((urllib.error.URLError, ConnectionError)):
        urllib.request.urlopen(url, timeout=WAIT_S)


def test_it_prints_nothing(opened: Viewer, capfd: pytest.CaptureFixture[str]) -> None:
    assert opened.url is not None
    with urllib.request.urlopen(opened.url, timeout=WAIT_S):
        pass
    assert capfd.readouterr().out == ""


def test_a_later_mujoco_that_ignores_the_host_is_refused_before_it_listens() -> None:
    class Open:
        """Web viewer that opens its socket on all interfaces, whatever its host is."""

        def __init__(self) -> None:
            self._host = "::"
            self._http_sock = socket.socket()
            self._http_sock.bind(("0.0.0.0", 0))
            self.started = False
            self._start_server()

        def _start_server(self) -> None:
            self.started = True

    made = []

    class Kept(Open):
        def __init__(self) -> None:
            made.append(self)
            super().__init__()

    with pytest.raises(RenderError, match="network"):
        web_viewer.on_loopback(Kept)()
    assert not made[0].started
    made[0]._http_sock.close()


def test_without_any_viewer_the_error_names_the_remedy(
    scene: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # Python runs this file when the viewer's process starts: a MuJoCo without a web viewer.
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\nfor name in ('mujoco.studio', 'mujoco.experimental'):\n    sys.modules[name] = None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    viewer = Viewer()
    with pytest.raises(RenderError, match="rgb_array"):
        viewer.show(*scene)
    assert not viewer.is_running()


def test_an_unreachable_display_leads_to_the_web_viewer(
    scene: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:

    def fail(*_: Any) -> None:
        raise RuntimeError("no such display")

    monkeypatch.setattr(module, "has_display", lambda: True)
    monkeypatch.setattr(module, "_window", fail)
    viewer = Viewer()
    viewer.show(*scene)
    try:
        assert viewer.url is not None
    finally:
        viewer.close()


def test_render_mode_human_works_without_a_display() -> None:
    env = gym.make(ENV_ID, render_mode="human")
    try:
        env.reset(seed=0)
        viewer = env.unwrapped.viewer  # type: ignore[attr-defined]
        assert viewer.is_running()
        assert env.render() is None
    finally:
        env.close()
    assert not viewer.is_running()


def test_gymnasium_checks_the_human_mode_without_a_warning() -> None:
    env = gym.make(ENV_ID, render_mode="human")
    env.unwrapped.metadata = {**env.unwrapped.metadata, "render_modes": ["human"]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()
