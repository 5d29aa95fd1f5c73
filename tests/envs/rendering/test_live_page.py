"""The live page without a browser: its memory, its guards, and who commands."""

import asyncio
import contextlib
import dataclasses
import http.client
import os
import signal
import subprocess
import sys
import threading
import time
import types
import urllib.parse
from unittest.mock import MagicMock

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.visuals import FIXED_CAMERAS
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.buttons import BUTTONS, EPISODES, POLICIES, SPEEDS, TAKES
from dual_ur10.envs.rendering.live.commander import GRIP_S, Commander
from dual_ur10.envs.rendering.live.drag_handles import DragHandles
from dual_ur10.envs.rendering.live.drawing import Pictures
from dual_ur10.envs.rendering.live.guard import LOOPBACK, bind, make_server
from dual_ur10.envs.rendering.live.history import History
from dual_ur10.envs.rendering.live.live_page import HANGS_S, LivePage
from dual_ur10.envs.rendering.live.memory import RING, STALE_S, Handles, LiveMemory
from dual_ur10.envs.rendering.live.overlay import STOP_PATH, Overlay
from dual_ur10.envs.rendering.live.page import Page
from dual_ur10.envs.rendering.live.panel import LOOKS, Panel, end_of
from dual_ur10.envs.rendering.live.plots import _known
from dual_ur10.envs.rendering.live.scene import Poser, parts_of, swollen
from dual_ur10.envs.rendering.live.viewpoints import CAMERA, NARROW_CAMERA, look_from
from dual_ur10.errors import DeviceUnpluggedError, MissingExtraError, SettingsError
from dual_ur10.policies.operators.device import checked
from dual_ur10.policies.operators.page import PageDevice
from dual_ur10.sim2real.cameras.camera_memory import CameraMemory, described
from dual_ur10.sim2real.cameras.camera_source import Exposure
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.live_view import LiveView
from tests.policies.operators.rigs import RawPage
from tests.waiting import until
from ur_core.processes.system import LOCAL

viser = pytest.importorskip("viser")
websockets = pytest.importorskip("websockets.asyncio.client")
msgspec = pytest.importorskip("msgspec")

POSE = np.array([0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0])


class FakeClock:
    def __init__(self):
        self.at_s = 100.0

    def now_s(self):
        return self.at_s


@pytest.fixture
def memory():
    memory = LiveMemory(3, 1)
    yield memory
    memory.close()


@pytest.fixture(scope="module")
def setup():
    return EnvSetup.resolve("Handover", {})


@pytest.fixture(scope="module")
def about(setup):
    speeds = tuple(setup.limits.speed_rad_s)
    return About("test", setup.config.scene, (speeds, speeds), buttons=BUTTONS, handles=True, grippers=True)


# The shared record.


def _put(memory, number):
    q = np.full((2, 6), float(number))
    memory.put({"step": number, "late_s": 0.001}, q, q + 0.5, np.full(3, number), np.full((1, 7), number))


def test_another_process_reads_what_the_program_wrote(memory):
    other = LiveMemory(3, 1, memory.name)
    _put(memory, 7)
    memory.say({"gate": "releases all", "text": "µ" * 10_000})
    (row,), count = other.rows()
    assert (count, row.scalars["step"], row.q_rad[1, 5], row.commanded_rad[0, 0]) == (1, 7.0, 7.0, 7.5)
    assert np.isnan(row.scalars["reward"])
    assert row.mocap.shape == (1, 7)
    assert other.words["gate"] == "releases all"
    other.close()


def test_a_reader_that_lags_gets_whole_rows_alone(memory):
    for number in range(RING + 10):
        _put(memory, number)
    rows, count = memory.rows()
    assert count == RING + 10
    assert [row.scalars["step"] for row in rows] == list(range(count - len(rows), count))
    assert 0 < len(rows) < RING


def test_a_row_is_never_torn(memory):
    over, torn = threading.Event(), []

    def read():
        other, seen = LiveMemory(3, 1, memory.name), 0
        while not over.is_set():
            rows, seen = other.rows(seen)
            torn.extend(row for row in rows if len({*row.q_rad.ravel(), *row.qpos, *row.mocap.ravel()}) > 1)
        other.close()

    reader = threading.Thread(target=read)
    reader.start()
    for number in range(5 * RING):
        _put(memory, number)
    over.set()
    reader.join()
    assert torn == []


def test_memory_of_another_scene_is_refused(memory):
    with pytest.raises(SettingsError, match="is another's"):
        LiveMemory(4, 1, memory.name)


def test_handles_of_a_page_without_sign_of_life_are_released(memory):
    handles = Handles(np.tile(POSE, (2, 1)), np.array([True, False]), np.array([np.nan, 1.0]), 5.0)
    memory.put_handles(handles)
    assert not memory.handles(5.0).clutch.any()  # it has not begun
    memory.beat(5.0)
    found = memory.handles(5.0 + STALE_S / 2)
    np.testing.assert_array_equal(found.poses, handles.poses)
    assert found.clutch.tolist() == [True, False]
    assert found.gripper[1] == 1.0
    assert not memory.handles(5.0 + 2 * STALE_S).clutch.any()


def test_presses_arrive_once_and_in_order(memory):
    for name in ("take_left", "pause", "reset"):
        memory.press(name)
    names, count = memory.pressed(0)
    assert names == ["take_left", "pause", "reset"]
    assert memory.pressed(count) == ([], count)


def test_a_stop_survives_all_later_presses():
    with contextlib.closing(RawPage("SineTracking")) as raw:
        raw.press("stop", *["reset"] * 100)
        assert "stop" in raw.page.pressed()
        raw.press("reset")
        assert raw.page.pressed() == ["reset"]


def test_every_button_has_a_look_and_a_label_and_a_key_of_its_own():
    assert {*LOOKS} == {*BUTTONS} - {*SPEEDS, *POLICIES, "stop"}
    for field in ("label", "key"):
        assert len({getattr(each, field) for each in LOOKS.values()}) == len(LOOKS)
    assert not {each.key for each in LOOKS.values()} & {*"WASDQE"}  # they move the viewpoint


@pytest.mark.parametrize(("buttons", "has"), [(EPISODES, True), (("stop", *TAKES), False)])
def test_a_folder_without_buttons_is_left_out(about, buttons, has):
    gui = MagicMock()
    Panel(gui, dataclasses.replace(about, buttons=buttons), MagicMock(), MagicMock())
    folders = [call.args[0] for call in gui.add_folder.call_args_list]
    assert folders == [*(["Episode"] if has else []), "Lead the arms", "Who commands"]


class _Camera:
    """Viewpoint of a page, which moves as a whole with its position."""

    def __init__(self, aspect):
        self.aspect, self._position, self.look_at = aspect, np.zeros(3), np.ones(3)

    @property
    def position(self):
        return self._position

    @position.setter
    def position(self, position):
        self.look_at = self.look_at + np.subtract(position, self._position)
        self._position = position


@pytest.mark.parametrize(
    ("aspect", "camera", "expected"),
    [(1.6, None, CAMERA), (0.5, None, NARROW_CAMERA), (0.5, FIXED_CAMERAS[0], FIXED_CAMERAS[0])],
)
def test_a_page_looks_from_a_camera_or_from_where_it_began(aspect, camera, expected):
    client = types.SimpleNamespace(camera=_Camera(aspect), atomic=contextlib.nullcontext)
    look_from(client, camera)
    position, at = expected if camera is None else (expected.position_m, expected.target_m)
    np.testing.assert_array_equal([client.camera.position, client.camera.look_at], [position, at])


def test_a_long_name_of_a_policy_is_cut_where_that_is_clear():
    names = ["zero", "runs/a_long_name_of_a_run/policy", "runs/b/a_long_name_of_a_run/policy"]
    assert [end_of(each, names) for each in names] == names
    assert end_of(names[1], names[:2]) == "…ong_name_of_a_run/policy"


# Who commands.


@pytest.fixture
def commander(memory):
    return Commander(memory, FakeClock())


def _now(commander, memory):
    memory.beat(commander._clock.at_s)
    return memory.handles(commander._clock.at_s)


def test_only_the_first_page_commands(commander, memory):
    assert commander.enter(1)
    assert not commander.enter(2)
    assert not commander.press(2, "reset")
    assert not commander.drag(2, 0, POSE, held=True)
    assert not commander.take(2)
    assert commander.press(1, "reset")
    assert memory.pressed(0)[0] == ["reset"]
    assert not _now(commander, memory).clutch.any()


@pytest.mark.parametrize("asks", [False, True])
def test_a_page_that_opens_after_all_were_closed_takes_the_controls_of_controllers(memory, asks):
    commander = Commander(memory, FakeClock(), asks=asks)
    assert commander.enter(1)
    commander.leave(1)
    assert commander.enter(2) is not asks
    assert commander.press(2, "reset") is not asks
    assert commander.take(2)
    assert commander.press(2, "reset")


@pytest.mark.parametrize("end", ["leave", "give_up"])
def test_a_page_that_leaves_releases_its_clutch(commander, memory, end):
    commander.enter(1)
    commander.enter(2)
    commander.drag(1, 1, POSE, held=True)
    assert _now(commander, memory).clutch.tolist() == [False, True]
    assert getattr(commander, end)(1)
    assert not _now(commander, memory).clutch.any()
    assert not commander.press(2, "reset")  # a page that watches does not command by itself
    assert commander.take(2)
    assert commander.press(2, "reset")


def test_a_page_that_watches_leaves_the_clutch_alone(commander, memory):
    commander.enter(1)
    commander.enter(2)
    commander.drag(1, 0, POSE, held=True)
    assert not commander.leave(2)
    assert _now(commander, memory).clutch[0]


def test_a_press_of_a_gripper_holds_its_arm_for_a_moment(commander, memory):
    commander.enter(1)
    commander.grip(1, 0, 0.0, POSE)
    found = _now(commander, memory)
    assert (found.clutch.tolist(), found.gripper[0]) == ([True, False], 0.0)
    np.testing.assert_array_equal(found.poses[0], POSE)
    commander._clock.at_s += 2 * GRIP_S
    commander.poll()
    found = _now(commander, memory)
    assert not found.clutch.any()
    assert np.isnan(found.gripper).all()  # who takes the arm later did not ask for it


def test_a_press_of_a_gripper_does_not_end_a_drag(commander, memory):
    commander.enter(1)
    commander.drag(1, 0, POSE, held=True)
    commander.grip(1, 0, 1.0, np.zeros(7))
    commander._clock.at_s += 2 * GRIP_S
    commander.poll()
    found = _now(commander, memory)
    assert found.clutch[0]
    assert np.isnan(found.gripper).all()
    np.testing.assert_array_equal(found.poses[0], POSE)


class _Handle:
    """Drag handle of a page, which notes what it is told."""

    def __init__(self, position, wxyz):
        self.position, self.wxyz = position, wxyz
        self.drag = None

    def on_update(self, function):
        self.drag = function


def test_a_handle_returns_to_its_tool_once_nobody_drags_it(commander, memory):
    found, tools = [], np.tile(POSE, (2, 1))

    def add(name, *, position, wxyz, **looks):
        found.append(_Handle(position.copy(), wxyz.copy()))
        return found[-1]

    handles = DragHandles(
        types.SimpleNamespace(handles=True), commander, types.SimpleNamespace(tool_targets=lambda: tools)
    )
    client = types.SimpleNamespace(client_id=1, scene=types.SimpleNamespace(add_transform_controls=add))
    commander.enter(1)
    handles.add(client)
    left = found[0]
    moved, turned = np.array([0.2, *POSE[1:]]), np.array([*POSE[:3], 0.5, 0.5, 0.5, 0.5])
    for dragged in (moved, turned):
        left.position, left.wxyz = dragged[:3], dragged[3:]
        for phase, at in (("update", dragged), ("end", POSE)):
            asyncio.run(left.drag(types.SimpleNamespace(target=left, client_id=1, phase=phase)))
            assert _now(commander, memory).clutch.tolist() == [phase == "update", False]
            handles.follow()
            np.testing.assert_array_equal(np.concatenate([left.position, left.wxyz]), at)


# The scene.


def test_meshes_are_closed_and_look_outwards():
    xml = """<mujoco><worldbody><geom type="box" size=".1 .2 .3"/><geom type="cylinder" size=".1 .5"/>
      <geom type="capsule" size=".1 .5"/><geom type="ellipsoid" size=".1 .2 .3" pos="1 0 0" rgba="1 0 0 1"/>
      <geom type="sphere" size=".1" group="3"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    volumes = {}
    for part in parts_of(model):
        volumes[part.rgb] = _volume(part.vertices, part.faces)
        larger = swollen(part.vertices, part.faces, 1e-3)
        np.testing.assert_allclose(np.linalg.norm(larger - part.vertices, axis=1), 1e-3)
        assert _volume(larger, part.faces) > volumes[part.rgb]  # outwards
    grey, red = volumes[(128, 128, 128)], volumes[(255, 0, 0)]
    whole = 0.048 + np.pi * 0.01 + (np.pi * 0.01 + 4 / 3 * np.pi * 1e-3)
    assert grey == pytest.approx(whole, rel=0.06)  # a polygon is smaller than its circle
    assert red == pytest.approx(4 / 3 * np.pi * 0.006, rel=0.1)


def _volume(vertices, faces):
    corners = vertices[faces]
    return np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6


def test_tools_and_targets_are_where_mujoco_has_them(setup):
    model = build_model(setup.config.scene)
    data, poser = mujoco.MjData(model), Poser(model)
    rng = np.random.default_rng(0)
    q, commanded = rng.uniform(-1, 1, (2, 2, 6))
    data.qpos[poser._joints] = commanded.reshape(12)
    mujoco.mj_kinematics(model, data)
    qpos = data.qpos.copy()
    qpos[poser._joints] = q.reshape(12)
    poser.pose(qpos, np.hstack([data.mocap_pos, data.mocap_quat]), commanded)
    np.testing.assert_allclose(poser.tool_targets()[1, :3], data.site("right/tcp").xpos, atol=1e-12)
    assert poser.away_m()[0] > 0.01


# The guards.


@pytest.fixture(scope="module")
def served(about):
    """A page's server in this process: port, token, page and memory."""
    model = build_model(about.scene, visuals=False)
    memory = LiveMemory(model.nq, model.nmocap)
    listener = bind(0)
    overlay = Overlay("stop" in about.buttons)
    server = make_server(listener, "secret", "test", overlay)
    page = Page(server, memory, about, overlay)
    yield listener.getsockname()[1], page, memory, server
    server.stop()
    memory.close()


def _get(port, path, headers=None):
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=10)
    connection.putrequest("GET", path, skip_accept_encoding=True)
    for name, value in (headers or {}).items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    found = response.status, response.headers, response.read()
    connection.close()
    return found


def _connect(port, *, origin, token=None, cookie=None, then=None):
    """Return the status with which a handshake ends; 101: it is through."""

    async def run():
        path = "" if token is None else f"/?token={token}"
        headers = {} if cookie is None else {"Cookie": f"dual_ur10_live_{port}={cookie}"}
        try:
            async with websockets.connect(
                f"ws://{LOOPBACK}:{port}{path}",
                origin=origin,
                additional_headers=headers,
                subprotocols=[f"viser-v{viser.__version__}"],
                compression=None,
            ) as connection:
                if then is not None:
                    await then(connection)
                return 101
        except websockets.InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(run())


def test_a_page_needs_the_token(served):
    port = served[0]
    for path in ("/", "/?token=wrong", "/index.html", "/?token=", "/?token=%FF%FE", STOP_PATH):
        status, headers, body = _get(port, path)
        assert (status, "Set-Cookie" in headers) == (403, False)
        assert b"token" in body
    status, headers, body = _get(port, "/?token=secret")
    assert status == 200
    assert b"<html" in body[:500].lower()
    assert "HttpOnly; SameSite=Strict" in headers["Set-Cookie"]
    assert _get(port, "/", {"Cookie": headers["Set-Cookie"].split(";")[0]})[0] == 200
    assert _get(port, "/", {"Cookie": f"dual_ur10_live_{port}=\xff"})[0] == 403


def test_a_connection_needs_its_own_origin_and_the_token(served):
    port = served[0]
    own = f"http://{LOOPBACK}:{port}"
    assert _connect(port, origin=own, cookie="secret") == 101
    assert _connect(port, origin=f"http://localhost:{port}", cookie="secret") == 101
    for origin in ("http://evil.example", None, f"http://{LOOPBACK}:{port + 1}", "null"):
        assert _connect(port, origin=origin, cookie="secret") == 403
        assert _connect(port, origin=origin, token="secret") == 403
    for wrong in (None, "wrong", ""):
        assert _connect(port, origin=own, cookie=wrong) == 403


def test_arms_are_drawn_at_home_before_anything_is_known_of_them(served, setup):
    _, page, _, _ = served
    tools = page._poser.tool_targets()
    assert tools[:, 2].min() > 0.1
    assert np.ptp(tools[:, 1]) > 1.0
    for (body, target), sent in page._drawing._sent.items():
        np.testing.assert_allclose(sent, np.concatenate(page._poser.body(body, target=target)))
    page._say(0.0)
    assert "both arms at home: nothing is known of them yet" in page._panel._words.content


def test_asking_for_a_tunnel_does_nothing(served, monkeypatch):
    port = served[0]
    opened = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_, **__: opened.append(True))

    async def ask(connection):
        message = viser._messages.ShareUrlRequest().as_serializable_dict()
        await connection.send(msgspec.msgpack.encode(message))
        await asyncio.sleep(0.3)

    assert _connect(port, origin=f"http://{LOOPBACK}:{port}", cookie="secret", then=ask) == 101
    assert opened == []


def test_it_listens_on_the_loopback_interface_alone(served):
    port, _, _, server = served
    assert server.get_port() == port
    assert server.get_host() == LOOPBACK


def test_a_busy_port_is_named():
    with bind(0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SettingsError, match=f"port {port} of 127.0.0.1 is busy"):
            bind(port)


# The page in its own process.


@pytest.fixture(scope="module")
def live(about):
    page = LivePage(about, port=0)
    page.wait_until_ready()
    yield page
    page.close()


def test_the_program_shows_a_cell_and_reads_what_is_pressed(live):
    core = Core("Handover", {})
    core.reset([np.random.default_rng(0)])
    live.show(core, np.zeros((2, 6)), {"step": 3})
    live.say({"gate": "<b>none</b>"})
    (row, *_), _ = live.memory.rows()
    assert row.scalars["step"] == 3
    assert row.scalars["spare_m"] >= 0
    assert np.isfinite(row.qpos).all()
    live.memory.press("reset")
    assert live.pressed() == ["reset"]
    assert live.pressed() == []
    core.close()
    query = urllib.parse.parse_qs(urllib.parse.urlsplit(live.url).query)
    assert len(query["token"][0]) > 20


def test_the_page_is_a_device(live):
    device = PageDevice(live)
    reading = checked(device.read(), device.name)
    assert reading.kind == "poses"
    assert not reading.clutch.any()
    live.memory.press("take_left")
    live.memory.press("pause")
    assert device.read().buttons == {"take_left", "pause"}
    assert device.read().buttons == frozenset()


def test_a_busy_port_is_an_error_of_the_program(about):
    with bind(0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SettingsError, match=f"port {port} of .* is busy"):
            LivePage(about, port=port).wait_until_ready()


def test_without_viser_the_extra_is_named(about, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"dual-ur10\[live\]"):
        LivePage(about, port=0)


def test_a_killed_page_releases_the_clutch_and_is_named(about):
    page = LivePage(about, port=0)
    page.wait_until_ready()
    until(lambda: page.memory.beat_s)
    handles = Handles(np.tile(POSE, (2, 1)), np.array([True, True]), np.full(2, np.nan), 0.0)
    page.memory.put_handles(handles)
    assert page.handles().clutch.all()
    os.kill(page.pid, signal.SIGKILL)
    until(lambda: not page.handles().clutch.any())
    until(lambda: page.lost)
    with pytest.raises(DeviceUnpluggedError, match="its process has ended"):
        PageDevice(page).read()
    page.close()


@pytest.mark.parametrize("unattended", [False, True])
def test_a_page_that_hangs_while_it_commands_controllers_is_lost(about, unattended):
    page = LivePage(dataclasses.replace(about, controllers=True, unattended=unattended), port=0)
    page.wait_until_ready()
    until(lambda: page.memory.beat_s)
    assert not page.lost
    os.kill(page.pid, signal.SIGSTOP)
    page.memory.beat(LOCAL.clock.now_s() - HANGS_S - 1.0)
    assert page.lost == ("" if unattended else "its process has shown no sign of life for 10 s")
    os.kill(page.pid, signal.SIGKILL)
    page.close()


def test_the_page_ends_with_its_program(tmp_path):
    code = (
        "from dual_ur10.envs.core.setup import EnvSetup\n"
        "from dual_ur10.envs.rendering.live.live_page import LivePage\n"
        "from dual_ur10.envs.rendering.live.page import About\n"
        "s = EnvSetup.resolve('SineTracking', {})\n"
        "p = LivePage(About('t', s.config.scene, (s.limits.speed_rad_s,) * 2), port=0)\n"
        "p.wait_until_ready(); print(p.pid, flush=True); import os; os._exit(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    pid = int(done.stdout)
    until(lambda: not _runs(pid), 20)


def _runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rsplit(")", 1)[1].split()[0] != "Z"


# Cells of controllers.

VIEW = "dual_ur10.sim2real.runtime.live_view:LiveView"


@pytest.fixture
def controllers():
    arms, cell = (ArmMemory(), ArmMemory()), CellMemory()
    yield arms, cell, LiveView(arms[0].name, arms[1].name, cell.name)
    for each in (*arms, cell):
        each.close()


def test_the_latch_and_the_supervisor_are_said_in_words(controllers):
    _, cell, found = controllers
    assert found.words(time.monotonic())["supervisor"] == "starts"
    cell.enter_ready()
    cell.note_supervisor(100.0)
    assert found.words(100.1)["supervisor"] == "watches both arms, time scaling 100 %"
    assert found.words(103.0)["supervisor"] == "no sign of life for 3.0 s"
    assert found.words(100.1)["latch"] == "open, arms may move"
    cell.enter_fault("a test")
    assert found.words(100.1)["latch"] == "LATCHED: a test"
    assert found.words(103.0)["supervisor"] == "ended with the stop"


def test_a_stop_is_latched_without_the_program_for_each_page_that_knows_the_token(served, controllers):
    port, page, memory, _ = served
    arms, cell, found = controllers
    memory.attach((VIEW, arms[0].name, arms[1].name, cell.name))
    page.poll()
    cookie = {"Cookie": f"dual_ur10_live_{port}=secret"}
    assert b"STOP BOTH ARMS" in _get(port, "/index.html", {**cookie, "Accept-Encoding": "gzip"})[2]
    assert _get(port, STOP_PATH)[0] == 403
    assert _get(port, STOP_PATH, {**cookie, "Sec-Fetch-Site": "same-site"})[0] == 403  # a page of another port
    assert (cell.fault, memory.stops) == ("", 0)
    assert _get(port, STOP_PATH, cookie)[0] == 200
    assert "live page" in cell.fault
    assert memory.stops == 1
    page.poll()
    assert "LATCHED" in found.words(0.0)["latch"]


def test_a_stop_before_the_arms_are_known_is_latched_once_they_are(served, controllers, monkeypatch):
    port, page, memory, _ = served
    arms, cell, _ = controllers
    monkeypatch.setattr(page, "_arms", None)
    assert _get(port, STOP_PATH, {"Cookie": f"dual_ur10_live_{port}=secret"})[0] == 200
    memory.attach((VIEW, arms[0].name, arms[1].name, cell.name))
    page.poll()
    assert "live page" in cell.fault


def test_images_of_observed_cameras_take_the_place_of_those_of_the_model(controllers):
    arms, cell, _ = controllers
    cameras = {name: CameraMemory((2, 4)) for name in ("front", "left/wrist")}
    texts = [described(name, memory) for name, memory in cameras.items()]
    found = LiveView(arms[0].name, arms[1].name, cell.name, *texts)
    assert found.images(1.0) == {}
    cameras["front"].put(Exposure(np.full((2, 4, 3), 7, np.uint8), 0.5))
    (taken,) = found.images(1.0).items()
    assert taken[0] == "front"
    gui = types.SimpleNamespace(
        add_folder=lambda *_, **__: contextlib.nullcontext(), add_image=lambda *_, **__: types.SimpleNamespace()
    )
    pictures = Pictures(gui, types.SimpleNamespace(cameras=("front", "side")), None)
    asked = []
    pictures._draw = lambda data, names: asked.append(names)
    pictures.draw(None, lambda: 1.0, found.images)
    assert (pictures._shown["front"].image == 7).all()
    assert asked == [["side"]]
    found.close()
    for each in cameras.values():
        each.close()


def test_delays_and_skew_come_from_what_was_sent(controllers):
    arms, _, found = controllers
    for period in range(3):
        arms[0].note_sent(period, period, 1.0 + period, 0.001, np.zeros(6))
        arms[1].note_sent(period, period, 1.0005 + period, 0.002, np.zeros(6))
    late_ms, skew_ms = found.sending()
    assert (late_ms, skew_ms) == (pytest.approx(2.0), pytest.approx(0.5))
    assert all(map(np.isnan, found.sending()))


def test_plots_show_errors_and_speeds(memory):
    history = History(np.full((2, 6), 2.0))
    for step in range(3):
        q = np.full((2, 6), 0.04 * step)
        scalars = {"at_s": 10.0 + step, "time_s": 0.04 * step, "episode": 0, "late_s": 0.003, "spare_m": 0.02}
        memory.put(scalars, q, q + 0.01, np.zeros(3), np.zeros((1, 7)))
    history.add(memory.rows()[0])
    age, left, _, speed, _, spare, late, skew = history.series(12.0)
    assert age.tolist() == [-2.0, -1.0, 0.0]
    np.testing.assert_allclose(left, 10.0)
    np.testing.assert_allclose(speed[1:], 0.5)
    np.testing.assert_allclose([spare[0], late[0]], [20.0, 3.0])
    assert np.isnan(skew).all()


def test_a_plot_shows_the_last_known_value_where_one_is_missing():
    nan = np.nan
    assert _known(np.array([nan, 1.0, nan, 3.0, np.inf])).tolist() == [0.0, 1.0, 1.0, 3.0, 3.0]
