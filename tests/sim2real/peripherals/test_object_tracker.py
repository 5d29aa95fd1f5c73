"""Trackers of the object: on a flange, at a fixed pose, seen by a camera whose loss is named; and its placer."""

import json
import math
import os
import signal
import time

import numpy as np
import pytest

from dual_ur10.errors import CellFileError, EmulatorError, LinkError, SettingsError
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply, rotate
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.config.cell_file_tables import AttachedTrackerEntry, EmulatedTrackerEntry, GivenTrackerEntry
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell
from dual_ur10.sim2real.links.json_link import JsonLink
from dual_ur10.sim2real.peripherals.object_placer import placer_of
from dual_ur10.sim2real.peripherals.object_tracker import STALE_S, CameraTracker, Flanges, tracker_of
from tests.sim2real.links.fake_servers import serving
from tests.waiting import until

HERE = "127.0.0.1"
FLANGES = Flanges(
    np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]]), quat_from_rotvec([[0.1, 0.2, 0.3], [0.0, 0.0, math.pi / 2]])
)
AWAY = np.array([0.3, -0.2, 0.8])
QUARTER = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])


def failure(tracker):
    try:
        tracker.pose(time.monotonic(), FLANGES)
    except LinkError as error:
        return str(error)
    return ""


def tracked(file, entry, prop="block"):
    return tracker_of(file.replace(tracker=entry), prop)


# Trackers without a camera.


@pytest.mark.parametrize("arm", [0, 1])
def test_an_object_on_a_flange_moves_with_it(file, arm):
    entry = AttachedTrackerEntry(
        arm=("left", "right")[arm], position_m=(0.0, 0.1, 0.2), rotation_rad=(0.0, 0.0, math.pi / 2)
    )
    found = tracked(file, entry).pose(7.0, FLANGES)
    position, quat = FLANGES.position_m[arm], FLANGES.quat[arm]
    assert found.position_m == pytest.approx(position + rotate(quat, [0.0, 0.1, 0.2]))
    assert found.quat == pytest.approx(quat_multiply(quat, QUARTER))
    assert found.measured_s == 7.0


def test_an_object_at_a_fixed_pose(file):
    entry = GivenTrackerEntry(position_m=(0.1, 0.2, 0.3), rotation_rad=(0.0, 0.0, math.pi / 2))
    tracker = tracked(file, entry)
    found = tracker.pose(7.0, FLANGES)
    assert found.position_m.tolist() == [0.1, 0.2, 0.3]
    assert found.quat == pytest.approx(QUARTER)
    assert found.measured_s == 7.0
    found.position_m[:] = 0.0  # a copy
    assert tracker.pose(8.0, FLANGES).position_m.tolist() == [0.1, 0.2, 0.3]
    tracker.close()


def test_nothing_to_track(file):
    assert tracker_of(file, "") is None


def test_a_file_without_a_tracker(file):
    with pytest.raises(CellFileError, match=r"handles a block.*\[tracker\].*\[emulator\]"):
        tracker_of(file.replace(emulator=None), "block")


# The emulated camera.


def test_the_camera_sees_where_the_object_was_placed(file):
    with placer_of(file) as placer, tracker_of(file, "block") as tracker:
        for x_m in (0.3, -0.1):
            placer.place(np.array([x_m, -0.2, 0.8]), QUARTER)
            placed_s = time.monotonic()
            found = until(lambda x_m=x_m: near(tracker.pose(time.monotonic(), FLANGES), x_m))
            assert abs(found.quat @ QUARTER) == pytest.approx(1.0, abs=1e-3)
            assert found.measured_s > placed_s - 0.1
        first = tracker.pose(time.monotonic(), FLANGES)
        until(lambda: tracker.pose(time.monotonic(), FLANGES).measured_s > first.measured_s + 0.1)


def near(pose, x_m):
    return pose if abs(pose.position_m[0] - x_m) < 1e-4 else None


def test_noise_and_delay_come_from_the_file(cell, file):
    cell.ask("place", position_m=[0.3, 0.0, 0.0], quat=[1.0, 0.0, 0.0, 0.0])
    entry = EmulatedTrackerEntry(noise_m=0.02, noise_rad=0.1, delay_s=0.2)
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
        tracked(file, EmulatedTrackerEntry().replace(delay_s=0.5))


def test_an_object_that_is_not_in_this_cell(file):
    with pytest.raises(LinkError, match=r"looking for 'bar'.*unknown body.*scene of this task"):
        tracker_of(file, "bar")


def test_no_cell_there(file):
    entry = file.emulator.replace(port=1)
    with pytest.raises(LinkError, match=r"emulated camera at .*:1.*no connection"):
        tracker_of(file.replace(emulator=entry), "block")


def test_a_cell_that_ends_is_reported_at_once(tmp_path):
    path = tmp_path / "cell.toml"
    with EmulatedCell(task="Handover", cell=str(path)) as cell, tracker_of(load_cell_file(path), "block") as tracker:
        tracker.pose(time.monotonic(), FLANGES)
        cell.ask("shutdown")
        text = until(lambda: failure(tracker))
        assert "emulated camera" in text
        assert "expected is a pose" in text
        assert failure(tracker) == text


def test_a_cell_that_stalls_makes_poses_old(tmp_path):
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
        {"position_m": [0.0, 0.0, 0.0], "quat": ["1", 0.0, 0.0, 0.0]},
        {"position_m": [0.0, 0.0, 0.0]},
        [1.0] * 100_000,
        None,
    ],
)
def test_answers_that_are_no_pose(value):
    def talk(connection):
        connection.recv(1000)
        connection.sendall(json.dumps({"ok": True, "value": value}).encode() + b"\n")

    with serving(talk) as port, pytest.raises(LinkError, match=r"emulated camera.*expected") as found:
        CameraTracker(JsonLink("emulated camera", HERE, port), "block", EmulatedTrackerEntry())
    assert len(str(found.value)) < 500


# The placer.


def test_an_object_that_cannot_be_placed(file):
    with placer_of(file) as placer:
        with pytest.raises(EmulatorError, match=r"not placed: .*allowed are"):
            placer.place((99.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        placer.place((0.3, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0))  # the connection goes on


def test_a_placer_that_does_not_answer(file):
    gone = file.replace(emulator=file.emulator.replace(port=1))
    with placer_of(gone) as placer, pytest.raises(EmulatorError, match=r"object placer at .*:1: no connection"):
        placer.place((0.3, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0))


def test_a_cell_whose_objects_a_person_places(file):
    assert placer_of(file.replace(emulator=None)) is None
