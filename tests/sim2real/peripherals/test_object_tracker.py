"""Where the object is: held, given, or seen by the emulated camera, whose loss is named; and the injection' client."""

import dataclasses
import json
import math
import os
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import CellFileError, EmulatorError, LinkError, SettingsError
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply, rotate
from dual_ur10.sim2real.config import cell_file_entries as entries
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell
from dual_ur10.sim2real.peripherals.object_placer import FaultInjectionClient
from dual_ur10.sim2real.peripherals.object_tracker import STALE_S, EmulatedTracker, Flanges, tracker_of
from tests.sim2real.links.fake_servers import serving

HERE = "127.0.0.1"
FLANGES = Flanges(
    np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]]), quat_from_rotvec([[0.1, 0.2, 0.3], [0.0, 0.0, math.pi / 2]])
)
AWAY = np.array([0.3, -0.2, 0.8])
TURN = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("cell") / "cell.toml"
    with EmulatedCell(task="Handover", plant="nominal", cell=str(path)) as cell:
        yield cell, load_cell_file(path)


@pytest.fixture
def cell(made):
    return made[0]


@pytest.fixture
def file(made):
    return made[1]


def until(condition, within_s=10.0):
    end = time.monotonic() + within_s
    while not (found := condition()):
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.005)
    return found


def failure(tracker):
    try:
        tracker.pose(time.monotonic(), FLANGES)
    except LinkError as error:
        return str(error)
    return ""


def tracked(file, entry, prop="block"):
    return tracker_of(dataclasses.replace(file, tracker=entry), prop)


# What needs no camera.


@pytest.mark.parametrize("arm", [0, 1])
def test_an_object_that_is_held_goes_with_the_flange(file, arm):
    entry = entries.AttachedTracker(
        arm=("left", "right")[arm], position_m=(0.0, 0.1, 0.2), rotation_rad=(0.0, 0.0, math.pi / 2)
    )
    found = tracked(file, entry).pose(7.0, FLANGES)
    position, quat = FLANGES.position_m[arm], FLANGES.quat[arm]
    assert found.position_m == pytest.approx(position + rotate(quat, [0.0, 0.1, 0.2]))
    assert found.quat == pytest.approx(quat_multiply(quat, TURN))
    assert found.measured_s == 7.0


def test_an_object_that_stands_somewhere(file):
    entry = entries.GivenTracker(position_m=(0.1, 0.2, 0.3), rotation_rad=(0.0, 0.0, math.pi / 2))
    tracker = tracked(file, entry)
    found = tracker.pose(7.0, FLANGES)
    assert found.position_m.tolist() == [0.1, 0.2, 0.3]
    assert found.quat == pytest.approx(TURN)
    assert found.measured_s == 7.0
    found.position_m[:] = 0.0  # who changes what was given changes nothing here
    assert tracker.pose(8.0, FLANGES).position_m.tolist() == [0.1, 0.2, 0.3]
    tracker.close()


def test_nothing_to_track(file):
    assert tracker_of(file, "") is None


def test_a_file_that_does_not_say_where_the_object_is(file):
    with pytest.raises(CellFileError, match=r"handles a block.*\[tracker\].*\[emulator\]"):
        tracker_of(dataclasses.replace(file, emulator=None), "block")


# The emulated camera.


def test_the_camera_sees_where_the_object_was_put(cell, file):
    with FaultInjectionClient(cell.left, cell.port) as injection, tracker_of(file, "block") as tracker:
        for x_m in (0.3, -0.1):
            injection.place(np.array([x_m, -0.2, 0.8]), TURN)
            placed_s = time.monotonic()
            found = until(lambda x_m=x_m: near(tracker.pose(time.monotonic(), FLANGES), x_m))
            assert abs(found.quat @ TURN) == pytest.approx(1.0, abs=1e-3)
            assert found.measured_s > placed_s - 0.1
        first = tracker.pose(time.monotonic(), FLANGES)
        until(lambda: tracker.pose(time.monotonic(), FLANGES).measured_s > first.measured_s + 0.1)


def near(pose, x_m):
    return pose if abs(pose.position_m[0] - x_m) < 1e-4 else None


def test_noise_and_delay_come_from_the_file(cell, file):
    cell.ask("place", position_m=[0.3, 0.0, 0.0], quat=[1.0, 0.0, 0.0, 0.0])
    entry = entries.EmulatedTracker(noise_m=0.02, noise_rad=0.1, delay_s=0.2)
    with tracked(file, entry) as tracker:
        found = {}
        while len(found) < 40:
            pose = tracker.pose(time.monotonic(), FLANGES)
            assert 0.2 <= time.monotonic() - pose.measured_s <= STALE_S + 0.1
            found[pose.measured_s] = pose
            time.sleep(0.002)
    positions = np.array([each.position_m for each in found.values()])
    assert 0.01 < positions.std(axis=0)[:2].mean() < 0.03
    assert np.std([each.quat[3] for each in found.values()]) > 0.02


def test_a_delay_that_makes_every_pose_too_old(file):
    assert STALE_S > 0.499
    with pytest.raises(SettingsError, match=r"delay_s is 0\.5: allowed is a number, 0 to 0\.499"):
        tracked(file, entries.EmulatedTracker(delay_s=0.5))


def test_an_object_that_is_not_in_this_cell(file):
    with pytest.raises(LinkError, match=r"looking for 'bar'.*unknown body.*scene of this task"):
        tracker_of(file, "bar")


def test_no_cell_there(file):
    entry = dataclasses.replace(file.emulator, port=1)
    with pytest.raises(LinkError, match=r"emulated camera at .*:1.*no connection"):
        tracker_of(dataclasses.replace(file, emulator=entry), "block")


def test_a_cell_that_ends_is_named_at_once(tmp_path):
    path = tmp_path / "cell.toml"
    with EmulatedCell(task="Handover", cell=str(path)) as cell, tracker_of(load_cell_file(path), "block") as tracker:
        tracker.pose(time.monotonic(), FLANGES)
        cell.ask("shutdown")
        text = until(lambda: failure(tracker))
        assert "emulated camera" in text
        assert "expected is a pose" in text
        assert failure(tracker) == text


def test_a_cell_that_stands_still_makes_poses_old(tmp_path):
    path = tmp_path / "cell.toml"
    with EmulatedCell(task="Handover", cell=str(path)) as cell, tracker_of(load_cell_file(path), "block") as tracker:
        os.kill(cell.process.pid, signal.SIGSTOP)
        try:
            last = tracker.pose(time.monotonic(), FLANGES)
            text = until(lambda: failure(tracker))
            assert time.monotonic() - last.measured_s > STALE_S
            assert "s old; expected is at most 0.5 s" in text
        finally:
            os.kill(cell.process.pid, signal.SIGCONT)


@pytest.mark.parametrize(
    "value",
    [
        {"position_m": [0.0, 0.0], "quat": [1.0, 0.0, 0.0, 0.0]},
        {"position_m": [0.0, 0.0, math.nan], "quat": [1.0, 0.0, 0.0, 0.0]},
        {"position_m": [0.0, 0.0, 0.0], "quat": [1.0, 1.0, 0.0, 0.0]},
        {"position_m": [0.0, 0.0, 0.0], "quat": "up"},
        {"position_m": [0.0, 0.0, 0.0]},
        [1.0],
        None,
    ],
)
def test_what_is_no_pose(value):
    def talk(connection):
        connection.recv(1000)
        connection.sendall(json.dumps({"ok": True, "value": value}).encode() + b"\n")

    with serving(talk) as port, pytest.raises(LinkError, match=r"emulated camera.*expected"):
        EmulatedTracker(FaultInjectionClient(HERE, port), "block", entries.EmulatedTracker())


# The injection' client.


def test_the_client_reports_refusals(cell):
    with FaultInjectionClient(cell.left, cell.port) as injection:
        with pytest.raises(EmulatorError, match="allowed are"):
            injection.place((99.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        assert injection.ask("state", arm="left", names=["robot_mode"]) == {"robot_mode": 7}  # the connection goes on
    assert injection.ask("info")["ticks"] > 0  # another connection
    injection.close()


@pytest.mark.parametrize("answer", [b"nonsense\n", b"[1]\n", b'{"ok": false, "error": "no"}\n', b""])
def test_answers_that_are_none(answer):
    def talk(connection):
        connection.recv(1000)
        connection.sendall(answer)

    with serving(talk) as port, pytest.raises(EmulatorError), FaultInjectionClient(HERE, port) as injection:
        injection.ask("info")


def test_an_answer_without_end():
    def talk(connection):
        connection.recv(1000)
        while True:
            connection.sendall(b"x" * 65536)

    with serving(talk) as port, pytest.raises(EmulatorError, match="more than 4194304 bytes"):
        FaultInjectionClient(HERE, port).ask("info")


def test_a_late_answer_is_not_taken_for_the_next():
    def talk(connection):
        connection.recv(1000)
        connection.recv(1000)  # until the client gave up

    with serving(talk) as port:
        injection = FaultInjectionClient(HERE, port, 0.2)
        with pytest.raises(EmulatorError, match="no answer to 'info'"):
            injection.ask("info")
    with pytest.raises(EmulatorError, match="no connection"):
        injection.ask("info")
