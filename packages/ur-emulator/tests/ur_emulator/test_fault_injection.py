"""Fault injection: each request has its effect, and no input disturbs the cell."""

import json
import math
import re
import socket
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import SOAK, scaled
from tests.ur_emulator import rtde_bytes
from tests.ur_emulator.pairs import Pair
from tests.ur_emulator.ticking import program
from tests.waiting import until
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.protocol.modes import RobotMode
from ur_emulator.ports.link_faults import LinkFaults
from ur_emulator.script import parse

DOCS = Path(__file__).parents[4] / "docs" / "reference"
PAGES = (("emulator.md", "## Fault injection"), ("emulated-cell.md", "## Requests of a cell"))
REQUESTS = sorted(
    ["info", "state", "pose", "positions", "place", "set_joints", "setpoints", "received", "clients", "stop", "release",
     "reduce", "press", "slider", "remote", "input", "program", "push", "link", "heal", "drop", "refuse", "override",
     "watchdog", "script_delay", "pretend", "calibration", "shutdown"]
)  # fmt: skip


@pytest.fixture
def cell():
    made = Pair()
    yield made
    made.close()


class Client:
    """Client in the same thread: the cell is served while the client waits."""

    def __init__(self, cell, arm, port):
        server = cell.emulator.servers[arm]
        self.cell = cell
        self.sock = socket.create_connection((server.host, server.ports[port].address[1]), timeout=2.0)
        self.sock.setblocking(False)
        cell.serve()

    def read(self, ticks=2):
        self.cell.serve(ticks)
        try:
            return self.sock.recv(1 << 20)
        except BlockingIOError:
            return None
        except ConnectionResetError:
            return "reset"

    def answer(self, data):
        self.read()
        self.sock.sendall(data)
        return self.read()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.sock.close()


def packets(stream):
    """Return the packages of the primary interface by type."""
    found = {}
    while len(stream) >= 5:
        size, kind = struct.unpack_from(">iB", stream)
        found.setdefault(kind, []).append(stream[5:size])
        stream = stream[size:]
    return found


def test_the_documentation_lists_all_requests():
    text = "".join((DOCS / page).read_text().split(section)[1].split("\n##")[0] for page, section in PAGES)
    listed = [row.split() for row in re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)]
    cell = Pair()
    try:
        there = cell.emulator._injection._requests
        assert sorted(each[0] for each in listed) == sorted(there) == REQUESTS
        for name, *arguments in listed:
            code = there[name].__code__
            takes = set(code.co_varnames[1 : code.co_argcount])
            takes |= set(LinkFaults.__dataclass_fields__) if name == "link" else set()
            named = {each.strip("[]") for each in arguments} - {"name=value", "..."}
            assert named == takes, name
    finally:
        cell.close()


def test_info(cell):
    cell.tick(3)
    info = cell.get("info")
    assert (info["ticks"], info["tick_s"]) == (3, 0.008)
    assert info["time_s"] == pytest.approx(0.024)
    assert info["physics_failed"] is False
    assert info["cpu_s"] > 0.0
    assert info["plant"] == {}
    mild = Pair(plant="mild", seed=3)
    assert "lookahead_scale" in mild.get("info")["plant"]
    mild.close()


def test_state(cell):
    cell.tick()
    reported = cell.get("state", arm="right", names=["actual_q", "safety_mode"])
    assert set(reported) == {"actual_q", "safety_mode"}
    assert reported["actual_q"] == pytest.approx(cell.emulator.servers[1].controller.values["actual_q"])
    assert set(cell.get("state", arm="left")) == set(cell.emulator.servers[0].controller.values)
    assert "'actual_q'" in cell.refused("state", arm="left", names=["actual_qq"])
    assert "'left', 'right'" in cell.refused("state", arm="middle")


@pytest.mark.parametrize(
    ("do", "values", "text"),
    [
        ("stop", {"arm": "left", "mode": 300}, "request 'stop': mode is 300: allowed are 0 to 255"),
        ("stop", {"arm": "left"}, "request 'stop': mode is missing"),
        ("push", {"arm": "left", "wrench": [0.0] * 5, "seconds": 1.0}, "wrench is .* at least 6 items"),
        ("push", {"arm": "left", "wrench": [0.0, 0.0, -201.0, 0.0, 0.0, 0.0], "seconds": 1.0}, "allowed are ±200 N"),
        ("push", {"arm": "left", "wrench": [0.0, 0.0, 0.0, 21.0, 0.0, 0.0], "seconds": 1.0}, "allowed are ±20 N·m"),
        ("push", {"arm": "left", "wrench": [0.0] * 6, "seconds": 61.0}, "seconds is 61.0: allowed are 0 to 60"),
        ("stop", {"arm": "left", "modus": 3}, "'modus'.*'mode'"),
        ("reduce", {"arm": "left", "on": 1}, "on is 1: it must be a valid boolean"),
        ("link", {"arm": "left", "port": "all", "lose": -1}, "lose is -1: it must be greater than or equal to 0"),
        ("link", {"arm": "left", "port": "all", "delay_s": 61}, "delay_s is 61: allowed are 0 to 60"),
        ("pretend", {"arm": "left", "version": [1, 2, "3", 4]}, "version is '3': it must be a valid integer"),
    ],
)
def test_refusals_name_found_and_allowed_values(cell, do, values, text):
    assert re.search(text, cell.refused(do, **values))


def test_a_hand_pushes_an_arm_for_a_time_and_only_a_compliant_one_yields(cell):
    def state(arm, name):
        return np.array(cell.get("state", arm=arm, names=[name])[name])

    wrench, home = [0.0, 20.0, 0.0, 0.0, 0.0, 0.0], state("left", "actual_q")
    cell.get("push", arm="left", wrench=wrench, seconds=0.2)
    cell.tick(10)
    assert state("left", "actual_TCP_force")[1] == pytest.approx(20.0, abs=0.1)
    assert state("right", "actual_TCP_force")[1] == pytest.approx(0.0, abs=0.1)
    cell.tick(20)
    assert state("left", "actual_TCP_force")[1] == pytest.approx(0.0, abs=0.1)
    np.testing.assert_allclose(state("left", "actual_q"), home, atol=1e-4)
    before = state("left", "actual_TCP_pose")
    for arm in ARMS:
        cell.emulator.servers[ARMS.index(arm)].controller.run_script(program("freedrive_mode()\nsleep(9)"))
        cell.tick(2)
    cell.get("push", arm="left", wrench=wrench, seconds=1.0)
    cell.tick(200)
    # (20 N - 4 N) / 100 N s/m for 1 s
    np.testing.assert_allclose((state("left", "actual_TCP_pose") - before)[:3], [0.0, 0.16, 0.0], atol=5e-3)
    np.testing.assert_allclose(state("right", "actual_qd"), 0.0, atol=1e-4)
    assert np.abs(state("left", "actual_qd")).max() < 1e-3


def test_setpoints_are_numbered(cell):
    controller = cell.emulator.servers[0].controller
    home = [float(each) for each in controller.motion.q]
    line = f"servoj([{home[0]} + 0.001 * k, {', '.join(map(str, home[1:]))}], t=0.008, lookahead_time=0.05, gain=400)"
    controller.run_script(program(f"k = 0\nwhile k < 40:\n  {line}\n  k = k + 1\nend\nstopj(5)"))
    cell.tick(60)
    all_of_it = cell.get("setpoints", arm="left")
    assert (all_of_it["first"], all_of_it["count"], len(all_of_it["setpoints"])) == (0, 40, 40)
    tick, q, t, lookahead, gain = all_of_it["setpoints"][7]
    assert q[0] == pytest.approx(home[0] + 0.007)
    assert (t, lookahead, gain) == (0.008, 0.05, 400.0)
    assert [each[0] for each in all_of_it["setpoints"]] == list(range(tick - 7, tick + 33))
    some = cell.get("setpoints", arm="left", since=30)
    assert some["first"] == 30
    assert some["setpoints"] == all_of_it["setpoints"][30:]
    assert cell.get("setpoints", arm="left", since=40)["setpoints"] == []
    assert cell.get("setpoints", arm="right")["count"] == 0
    kept = controller.setpoints.maxlen
    for _ in range(kept):
        controller.note_setpoint(home, 0.008, 0.1, 300)
    late = cell.get("setpoints", arm="left")
    assert (late["first"], late["count"]) == (40, 40 + kept)
    assert len(late["setpoints"]) == 1000  # at most
    some = cell.get("setpoints", arm="left", since=kept)  # numbers stay, also of those that are forgotten
    assert (some["first"], len(some["setpoints"])) == (kept, 40)
    for bad in (float("nan"), "x", None, 10**30):
        cell.refused("setpoints", arm="left", since=bad)


def test_motion_commands_of_all_clients_are_counted(cell):
    doubles = [f"input_double_register_{k}" for k in range(6)]
    with Client(cell, 0, "rtde") as rtde:
        rtde.answer(
            rtde_bytes.VERSION_2
            + rtde_bytes.inputs(["input_int_register_0", *doubles])
            + rtde_bytes.inputs(["input_int_register_24", "input_double_register_24"])
            + rtde_bytes.inputs(["input_int_register_1"])
        )
        sent = cell.emulator.servers[0].controller.ticks
        rtde.answer(rtde_bytes.data(1, "i6d", 11, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
        rtde.answer(rtde_bytes.data(1, "i6d", 16, *[9.0] * 6))  # servoStop
        rtde.answer(rtde_bytes.data(1, "i6d", 0, *[9.0] * 6) + rtde_bytes.data(1, "i6d", 255, *[9.0] * 6))
        rtde.answer(rtde_bytes.data(3, "i", 11))  # another register
        rtde.answer(rtde_bytes.data(2, "id", 9, 0.7))
    with Client(cell, 0, "realtime") as one, Client(cell, 0, "secondary") as other:
        one.answer(program("sync()").encode())
        other.answer(b"this is none\n")
    cell.serve(2)
    found = cell.get("received", arm="left")
    assert found["motion"] == found["count"] == 2
    (at, command, target), (later, speed, _) = found["packages"]
    assert (command, target, speed) == (11, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], 9)
    assert sent <= at < later == found["motion_tick"] < found["upload_tick"] <= found["tick"]
    assert found["uploads"] == 2
    assert cell.get("received", arm="left", since=1)["packages"] == found["packages"][1:]
    assert cell.get("received", arm="right")["motion"] == cell.get("received", arm="right")["uploads"] == 0


def test_stops_ends_and_watchdogs_are_noted(cell):
    found = cell.get("received", arm="left")
    assert [found[name] for name in ("stop_tick", "ended_tick", "watchdog", "upload_tick")] == [None] * 4
    controller = cell.emulator.servers[0].controller
    controller.run_script(program('rtde_set_watchdog("input_int_register_0", 10, "stop")\nwhile True:\n  sync()\nend'))
    cell.tick(3)
    assert cell.get("received", arm="left")["watchdog"] == [1, 10.0, "stop"]
    cell.get("stop", arm="left", mode=9)
    cell.tick(3)
    found = cell.get("received", arm="left")
    assert (found["stop_tick"], found["ended_tick"], found["tick"]) == (4, 4, 6)


def test_a_watchdog_can_be_kept_from_acting(cell):
    controller = cell.emulator.servers[0].controller
    cell.get("watchdog", arm="left", on=False)
    controller.run_script(program('rtde_set_watchdog("input_int_register_0", 10, "stop")\nwhile True:\n  sync()\nend'))
    cell.tick(40)
    assert cell.get("state", arm="left", names=["runtime_state"]) == {"runtime_state": 2}
    cell.get("watchdog", arm="left", on=True)
    cell.tick(2)
    assert cell.get("state", arm="left", names=["runtime_state"])["runtime_state"] != 2


def test_clients_are_counted(cell):
    assert all(each == [] for each in cell.get("clients", arm="left").values())
    with Client(cell, 0, "rtde") as rtde, Client(cell, 0, "primary"):
        rtde.answer(rtde_bytes.VERSION_2 + rtde_bytes.inputs(["input_int_register_3"]))
        rtde.answer(rtde_bytes.data(1, "i", 5) + rtde_bytes.data(1, "i", 6))
        found = cell.get("clients", arm="left")
        assert len(found["primary"]) == 1
        assert found["rtde"][0]["data_packages"] == 2
        assert found["rtde"][0]["dropped"] == 0
    # The process that compiles programs holds copies of the connections while it starts.
    until(lambda: cell.serve() or all(each == [] for each in cell.get("clients", arm="left").values()))


def test_stop_release_and_reduce(cell):
    def modes():
        cell.tick()
        return [cell.get("state", arm=arm, names=["safety_mode"])["safety_mode"] for arm in ("left", "right")]

    for mode in (3, 5, 12, 99, 255, 0):
        cell.get("stop", arm="left", mode=mode, reason="a test")
        assert modes() == [mode, 1]
        cell.get("release", arm="left", mode=mode)
        assert modes() == [1, 1]
    cell.get("reduce", arm="right", on=True)
    assert modes() == [1, 2]
    cell.get("reduce", arm="right", on=False)
    assert modes() == [1, 1]
    for bad in (-1, 256, 2**40, float("inf"), float("nan"), "x", None, 1, 2):
        cell.refused("stop", arm="left", mode=bad)
    assert modes() == [1, 1]


def test_press(cell):
    controller = cell.emulator.servers[0].controller
    controller.program.prepare(parse(program("while True:\n  sync()\nend"), controller.program.builtins))

    def pressed(button, ticks=40):
        cell.get("press", arm="left", button=button)
        cell.tick(ticks)
        return controller.values["runtime_state"], controller.values["robot_mode"]

    assert pressed("play") == (2, 7)
    assert pressed("pause") == (4, 7)
    assert pressed("play") == (2, 7)
    assert "paused" in cell.refused("press", arm="left", button="resume")
    assert pressed("pause") == (4, 7)
    assert pressed("resume") == (2, 7)
    assert pressed("stop") == (1, 7)
    assert "paused" in cell.refused("press", arm="left", button="resume")
    assert pressed("power_off") == (1, RobotMode.POWER_OFF)
    assert cell.refused("press", arm="left", button="play")
    assert pressed("power_on", 200) == (1, RobotMode.IDLE)
    assert pressed("release_brakes", 100) == (1, RobotMode.RUNNING)
    cell.get("stop", arm="left", mode=3)
    assert "5s" in cell.refused("press", arm="left", button="unlock_protective_stop")
    cell.tick(626)
    assert pressed("unlock_protective_stop") == (1, 7)
    assert controller.values["safety_mode"] == 1
    assert "'unlock_protective_stop'" in cell.refused("press", arm="left", button="shutdown")


def test_slider_and_input(cell):
    cell.get("slider", arm="left", fraction=0.25)
    cell.get("input", arm="left", bit=17, on=True)
    cell.get("input", arm="left", bit=3, on=True)
    cell.get("input", arm="left", bit=3, on=False)
    cell.tick(40)
    values = cell.emulator.servers[0].controller.values
    assert values["target_speed_fraction"] == values["speed_scaling"] == 0.25
    assert values["actual_digital_input_bits"] == 1 << 17
    for bad in (18, -1, 1e30, None):
        cell.refused("input", arm="left", bit=bad, on=True)
    cell.refused("slider", arm="left", fraction="fast")
    cell.get("slider", arm="left", fraction=7)
    cell.tick()
    assert values["target_speed_fraction"] == 1.0


def test_remote_control_of_an_e_series():
    cell = Pair(robot="ur10e")
    try:
        controller = cell.emulator.servers[0].controller
        cell.get("remote", arm="left", on=False)
        with Client(cell, 0, "dashboard") as client:
            client.read()
            assert b"Remote Control" in client.answer(b"power off\n")
        controller.run_script(program("while True:\n  sync()\nend"))
        cell.tick(2)
        assert controller.values["runtime_state"] == 1
        cell.get("remote", arm="left", on=None)
        with Client(cell, 0, "dashboard") as client:
            client.read()
            assert client.answer(b"is in remote control\n") == b"false\n"
            assert client.answer(b"power on\n") == b"Powering on\n"
        cell.get("remote", arm="left", on=True)
        controller.run_script(program("while True:\n  sync()\nend"))
        cell.tick(2)
        assert controller.values["runtime_state"] == 2
    finally:
        cell.close()


def test_a_program_is_loaded_by_the_dashboard(cell):
    text = program("while True:\n  sync()\nend", "kept")
    cell.get("program", arm="left", name="kept.urp", text=text)
    with Client(cell, 0, "dashboard") as client:
        client.read()
        assert client.answer(b"load other.urp\n") == b"File not found: other.urp\n"
        assert client.answer(b"load kept.urp\n") == b"Loading program: kept.urp\n"
        assert client.answer(b"play\n") == b"Starting program\n"
        assert client.answer(b"programState\n") == b"PLAYING kept.urp\n"
    for index in range(200):
        cell.get("program", arm="left", name=f"{index}", text=text)
    assert len(cell.emulator.servers[0].pendant.programs) == 64


def test_links_go_wrong_and_heal(cell):
    with Client(cell, 0, "realtime") as client, Client(cell, 0, "dashboard") as lines:
        assert len(client.read(4)) % 1220 == 0
        cell.get("link", arm="left", port="realtime", mute=True)
        client.read()
        assert client.read() is None
        lines.read()
        assert lines.answer(b"running\n")  # only that port
        cell.get("heal", arm="left")
        assert len(client.read(3)) == 3 * 1220
        cell.get("link", arm="left", port="realtime", lose=2)
        assert len(client.read(3)) == 1220
        cell.get("link", arm="left", port="dashboard", corrupt=1)
        wrong, right = (lines.answer(b"running\n") for _ in range(2))
        assert right == b"Program running: false\n"
        assert sum(a != b for a, b in zip(wrong, right, strict=True)) == 1
        cell.get("link", arm="left", port="dashboard", frozen=True)
        assert lines.answer(b"running\n") is None
        cell.get("heal", arm="left", port="dashboard")
        assert b"running" in lines.read()
        cell.get("link", arm="left", port="dashboard", delay_s=0.03)
        assert lines.answer(b"running\n") is None
        for _ in range(2):  # there, and back
            time.sleep(0.04)
            late = lines.read()
        assert late == right
        cell.get("heal", arm="left")
        cell.get("link", arm="left", port="dashboard", half_open=True)
        with Client(cell, 0, "dashboard") as other:
            assert other.answer(b"running\n") is None
        cell.get("heal", arm="left")
    for bad in ({"delay_s": -1}, {"delay_s": 1e9}, {"lose": "x"}, {"corrupt": float("inf")}, {"no": 1}):
        cell.refused("link", arm="left", port="all", **bad)
    assert "'rtde'" in cell.refused("link", arm="left", port="gripper", mute=True)
    assert cell.emulator.servers[0].ports["rtde"].faults == LinkFaults()


@pytest.mark.parametrize("reset", [False, True])
def test_drop_and_refuse(cell, reset):
    with Client(cell, 0, "realtime") as client, Client(cell, 1, "realtime") as other:
        cell.get("drop", arm="left", port="realtime", reset=reset)
        ends = []
        until(lambda: ends.append(client.read()) or ends[-1] in (b"", "reset"))
        assert ends[-1] == ("reset" if reset else b"")
        assert other.read()
    cell.get("refuse", arm="left", port="realtime")
    with pytest.raises(ConnectionRefusedError):
        Client(cell, 0, "realtime")
    cell.get("heal", arm="left")
    with Client(cell, 0, "realtime") as client:
        assert client.read()


def test_a_port_taken_meanwhile_is_named(cell):
    cell.get("refuse", arm="left", port="realtime")
    with socket.create_server((cell.emulator.servers[0].host, 30003)):
        assert "taken" in cell.refused("heal", arm="left")
    cell.get("heal", arm="left")


def test_values_are_overridden_until_null(cell):
    controller = cell.emulator.servers[0].controller
    cell.tick()
    true = dict(controller.values)
    wrong = {"robot_mode": 5, "actual_q": [1.0, 2.0, 3.0, 4.0, 5.0, float("nan")], "joint_temperatures": [90.0] * 6}
    cell.get("override", arm="left", **wrong)
    cell.tick(2)
    for name, value in wrong.items():
        assert np.array_equal(controller.values[name], value, equal_nan=True)
    assert controller.safety.robot_mode == RobotMode.RUNNING  # only reported so
    assert cell.emulator.servers[1].controller.values["robot_mode"] == 7
    cell.get("override", arm="left", joint_temperatures=[91.0] * 6)
    cell.get("override", arm="left", **dict.fromkeys(wrong))
    cell.tick()
    for name in wrong:
        assert controller.values[name] == pytest.approx(true[name])


@pytest.mark.parametrize(
    "values",
    [
        {"actual_q": [0.0] * 5},
        {"actual_q": 1.0},
        {"actual_q": ["x"] * 6},
        {"actual_q": {"a": 1}},
        {"robot_mode": [1]},
        {"robot_mode": "RUNNING"},
        {"robot_mode": 1.5},
        {"timestamp": 1e300},
        {"timestamp": -1.0},
        {"timestamp": float("nan")},
        {"joint_temperatures": [1e300] * 6},
        {"actual_digital_input_bits": -1},
        {"no_such_value": 1},
        {"robot_mode": 5, "safety_mode": "x"},
    ],
)
def test_values_that_cannot_be_encoded_are_refused(cell, values):
    cell.refused("override", arm="left", **values)
    with Client(cell, 0, "realtime"), Client(cell, 0, "primary"):
        cell.serve(15)
    assert cell.emulator.servers[0].controller.values["robot_mode"] == RobotMode.RUNNING


def test_programs_start_late(cell, cb3):
    cb3.ask("script_delay", arm="left", seconds=0.16)
    client = cb3.system.connect(cb3.left, 30002, 1.0)
    client.send_now(program("while True:\n  sync()\nend").encode())
    sent_s = cb3.clock.now_s()
    cb3.wait_until("left", "runtime_state", 2)
    assert 0.15 <= cb3.clock.now_s() - sent_s <= 0.19
    for bad in (-1, 61, float("nan"), "x", None):
        cell.refused("script_delay", arm="left", seconds=bad)


def test_another_controller_is_reported_to_clients(cell):
    cell.get("pretend", arm="left", version=[5, 9, 4, 77], model="UR5", serial_number="12345", robot_type=1)

    def versions(arm):
        with Client(cell, arm, "rtde") as rtde:
            rtde.answer(rtde_bytes.VERSION_2)
            answer = rtde.answer(rtde_bytes.message("v"))
        with Client(cell, arm, "dashboard") as dashboard:
            dashboard.read()
            lines = dashboard.answer(b"polyscopeversion\nget robot model\nget serial number\n").decode().splitlines()
        with Client(cell, arm, "primary") as primary:
            found = packets(primary.read(30))
        (hello,) = found[20]
        name = 11 + hello[10]
        body = found[16][0]
        return struct.unpack(">4I", answer[3:]), lines, struct.unpack_from(">BBii", hello, name), body

    rtde, lines, primary, body = versions(0)
    assert rtde == primary == (5, 9, 4, 77)
    assert lines[0].startswith("URSoftware 5.9.4.77")
    assert lines[1:] == ["UR5", "12345"]
    true = versions(1)
    assert true[0] == true[2] == (3, 15, 8, 106339)
    assert true[1][1:] == ["UR10", "2010300002"]  # each has its own
    configurations = [each[each.index(struct.pack(">iB", 445, 6)) :][:445] for each in (body, true[3])]
    assert [struct.unpack_from(">I", each, 445 - 8) for each in configurations] == [(1,), (2,)]
    for bad in (
        {"version": [1, 2, 3]}, {"version": [300, 1, 1, 1]}, {"version": [-1, 1, 1, 1]}, {"version": "abcd"},
        {"version": 5}, {"version": [5, 1, 1, 2**70]}, {"model": 5}, {"serial_number": [1]}, {"robot_type": "x"},
        {"robot_type": -1}, {"robot_type": 2**40}, {"safety_checksum": -1}, {"safety_checksum": 2**32},
    ):  # fmt: skip
        cell.refused("pretend", arm="left", **bad)
    assert versions(0)[:3] == (rtde, lines, primary)
    cell.get("pretend", arm="left", version=[3, 3, 0, 1])  # unnamed values stay; this version lacks the commands
    with Client(cell, 0, "dashboard") as dashboard:
        dashboard.read()
        assert b"could not understand" in dashboard.answer(b"get robot model\n")


def test_another_calibration_is_reported_to_clients(cell):
    def kinematics(arm):
        with Client(cell, arm, "primary") as primary:
            body = packets(primary.read(30))[16][0]
        return struct.unpack_from(">6I24d", body, body.index(struct.pack(">iB", 225, 5)) + 5)

    def flange(reported, q_rad):
        theta, a, d, alpha = (reported[start : start + 6] for start in range(6, 30, 6))
        return flange_pose(q_rad, DHParameters(a, d, alpha, theta, robot="ur10"))[0]

    true = kinematics(0)
    assert kinematics(1) == true
    cell.get("calibration", arm="left", error_m=0.004)
    off = kinematics(0)
    assert [one != other for one, other in zip(off[:6], true[:6], strict=True)] == [False, True, *[False] * 4]
    for q_rad in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
        assert math.dist(flange(off, q_rad), flange(true, q_rad)) == pytest.approx(0.004)
    assert kinematics(1) == true
    cell.get("pretend", arm="left", serial_number="1")  # does not end it
    assert kinematics(0) == off
    cell.get("calibration", arm="left", error_m=0.0)
    assert kinematics(0) == true
    for bad in (float("nan"), "x", None, [1]):
        cell.refused("calibration", arm="left", error_m=bad)


def test_a_pretended_version_frees_no_inputs(cell):
    with Client(cell, 0, "rtde") as first, Client(cell, 0, "rtde") as second:
        wanted = rtde_bytes.VERSION_2 + rtde_bytes.inputs(["input_int_register_3"])
        assert b"INT32" in first.answer(wanted)
        cell.get("pretend", arm="left", model="UR5")
        assert b"IN_USE" in second.answer(wanted)
        with Client(cell, 0, "rtde") as third:
            assert b"IN_USE" in third.answer(wanted)


def test_shutdown(cell):
    assert not cell.emulator.ended
    cell.get("shutdown")
    assert cell.emulator.ended


def test_requests_come_over_a_socket(cell):
    with Client(cell, 0, "dashboard") as any_client:
        any_client.read()
        sock = socket.create_connection((cell.emulator.servers[0].host, cell.emulator._port.number), timeout=2.0)
        with sock:
            sock.sendall(b'{"do": "info"}\nnonsense\n{"do": "pose", "body": "\\ud800"}\n\xff\xfe\n')
            cell.serve(2)
            answers = [json.loads(line) for line in sock.recv(1 << 16).splitlines()]
    assert [each["ok"] for each in answers] == [True, False, False, False]


def test_invalid_unicode_disturbs_nothing(cell):
    cell.get("pretend", arm="left", model="\ud800")
    with Client(cell, 0, "dashboard") as client:
        client.read()
        assert client.answer(b"get robot model\n") == b"?\n"
    for text in (program('textmsg("\ud800")'), "\ud800", program("x = \ud800"), "def \ud800():\nend\n"):
        cell.ask("program", arm="left", name="p", text=text)
        with Client(cell, 0, "dashboard") as client:
            client.read()
            client.answer(b"load p\n")
            client.answer(b"play\n")
            assert client.answer(b"programState\n")
        cell.serve(3)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([2**31, 2**63, -1, 10**400, 0, 3, 7, 255])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["left", "right", "all", "rtde", "primary", "block", "actual_q", "play", "robot_mode", "x"]),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
ARGUMENTS = [
    "arm", "names", "body", "noise_m", "noise_rad", "delay_s", "position_m", "quat", "since", "mode", "reason",
    "on", "button", "fraction", "bit", "name", "text", "port", "mute", "frozen", "half_open", "jitter_s", "lose",
    "corrupt", "reset", "actual_q", "robot_mode", "timestamp", "joint_temperatures", "tool_mode", "seconds",
    "version", "model", "serial_number", "robot_type", "error_m", "self", "do",
    "wrench",
]  # fmt: skip
ARM = st.sampled_from(["left", "right"])


@st.composite
def requests(draw):
    name = draw(st.sampled_from([each for each in REQUESTS if each != "shutdown"]))
    values = draw(st.dictionaries(st.sampled_from(ARGUMENTS), JSON, max_size=5))
    if draw(st.booleans()):
        values["arm"] = draw(ARM)
        values["port"] = draw(st.sampled_from(["all", "rtde", "primary"]))
        if name not in ("link", "heal", "drop", "refuse"):
            del values["port"]
    return {**values, "do": name}


@pytest.fixture(scope="module")
def fuzzed():
    made = Pair()
    yield made
    made.close()


@settings(max_examples=1500 if SOAK else 15)
@given(st.lists(requests(), min_size=1, max_size=8))
def test_bad_requests_disturb_nothing(fuzzed, asked):
    cell = fuzzed
    ticks = cell.emulator.ticks
    controllers = [server.controller for server in cell.emulator.servers]
    try:
        with Client(cell, 0, "realtime"), Client(cell, 0, "primary"), Client(cell, 0, "rtde") as rtde:
            rtde.answer(rtde_bytes.VERSION_2 + rtde_bytes.outputs(rtde_bytes.RECEIVED) + rtde_bytes.message("S"))
            for request in asked:
                answer = cell.line(json.dumps(request))
                assert answer["ok"] or answer["error"], answer
                cell.serve()
            cell.serve(13)  # the primary packet, too
            for arm in (0, 1):
                for port, server in cell.emulator.servers[arm].ports.items():
                    if server.reads:
                        Client(cell, arm, port).sock.close()
            cell.serve()
    finally:
        for arm in ARMS:
            cell.get("heal", arm=arm)
            cell.get("drop", arm=arm, port="all")
            for mode in list(controllers[ARMS.index(arm)].safety._stopped):
                cell.get("release", arm=arm, mode=mode)
            cell.get("script_delay", arm=arm, seconds=0)
            cell.get("override", arm=arm, **dict.fromkeys(controllers[ARMS.index(arm)].overrides))
    assert cell.emulator.ticks > ticks + 12
    assert not cell.emulator.world.failed
    assert np.isfinite(cell.emulator.world.read(0).q_rad).all()


@settings(max_examples=scaled(3000, 40))
@given(JSON.map(json.dumps) | st.text() | st.binary(max_size=60).map(lambda raw: raw.decode("utf-8", "replace")))
def test_lines_that_are_no_requests_are_refused(fuzzed, line):
    answer = json.loads(fuzzed.emulator._injection.answer(line))
    assert not answer["ok"]
    assert answer["error"]


def test_deeply_nested_lines_are_refused(fuzzed):
    for line in ("[" * 100_000, '{"do":' * 20_000, '{"do": "info", "do": ' + "[" * 5000):
        assert not json.loads(fuzzed.emulator._injection.answer(line))["ok"]
