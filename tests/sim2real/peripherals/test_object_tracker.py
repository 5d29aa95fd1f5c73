"""Trackers of the object: on a flange, at a fixed pose, seen by a camera whose loss is named; and its placer."""

import json
import math

import numpy as np
import pytest

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.props import BAR, BLOCK, TARGET
from dual_ur10.errors import CellFileError, EmulatorError, LinkError, SettingsError
from dual_ur10.sim2real.cell_file.tables import (
    AttachedTrackerEntry,
    EmulatedTrackerEntry,
    GivenTrackerEntry,
    OwnTrackerEntry,
)
from dual_ur10.sim2real.peripherals.object_tracker import (
    STALE_S,
    CameraTracker,
    Flanges,
    ObjectPose,
    ObjectTracker,
    placer_of,
    trackers_of,
)
from dual_ur10.testing import VirtualCell
from tests import waiting
from tests.links.fake_servers import serving
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, rotate
from ur_core.links.json_link import JsonLink

HERE = "127.0.0.1"
FLANGES = Flanges(
    np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]]), quat_from_rotvec([[0.1, 0.2, 0.3], [0.0, 0.0, math.pi / 2]])
)
CASE = Prop(
    name="case",
    mjcf="<mujoco><worldbody><body><body><joint name='lid'/><geom size='.1'/></body></body></worldbody></mujoco>",
)
AWAY = np.array([0.3, -0.2, 0.8])
QUARTER = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])


def failure(tracker, clock):
    try:
        tracker.pose(clock.now_s(), FLANGES)
    except LinkError as error:
        return str(error)
    return ""


def tracker_of(file, system, prop=BLOCK):
    return trackers_of(file, (prop,), system)[prop.name]


def tracked(file, entry, system):
    return tracker_of(file.replace(tracker=(entry,)), system)


# Trackers without a camera.


@pytest.mark.parametrize("arm", [0, 1])
def test_an_object_on_a_flange_moves_with_it(file, arm, system):
    entry = AttachedTrackerEntry(
        prop="block", arm=("left", "right")[arm], position_m=(0.0, 0.1, 0.2), rotation_rad=(0.0, 0.0, math.pi / 2)
    )
    found = tracked(file, entry, system).pose(7.0, FLANGES)
    position, quat = FLANGES.position_m[arm], FLANGES.quat[arm]
    assert found.position_m == pytest.approx(position + rotate(quat, [0.0, 0.1, 0.2]))
    assert found.quat == pytest.approx(quat_multiply(quat, QUARTER))
    assert found.measured_s == 7.0


def test_an_object_at_a_fixed_pose(file, system):
    entry = GivenTrackerEntry(prop="block", position_m=(0.1, 0.2, 0.3), rotation_rad=(0.0, 0.0, math.pi / 2))
    tracker = tracked(file, entry, system)
    found = tracker.pose(7.0, FLANGES)
    assert found.position_m.tolist() == [0.1, 0.2, 0.3]
    assert found.quat == pytest.approx(QUARTER)
    assert found.measured_s == 7.0
    found.position_m[:] = 0.0  # a copy
    assert tracker.pose(8.0, FLANGES).position_m.tolist() == [0.1, 0.2, 0.3]
    tracker.close()


def test_nothing_to_track(file, system):
    assert trackers_of(file, (), system) == {}
    assert trackers_of(file.replace(emulator=None), (TARGET,), system) == {}  # its pose is that of the start


def test_a_file_without_a_tracker(file, system):
    given = GivenTrackerEntry(prop="bar", position_m=(0.1, 0.2, 0.3), rotation_rad=(0.0, 0.0, 0.0))
    bare = file.replace(emulator=None, tracker=(given,))
    with pytest.raises(CellFileError, match=r"handles block, case, and .* they are: .*\[\[tracker\]\].*emulator"):
        trackers_of(bare, (BAR, BLOCK, TARGET, CASE), system)
    assert list(trackers_of(bare, (BAR, TARGET), system)) == ["bar"]


class LidCamera(ObjectTracker):
    """Tracker of a laboratory, which measures a joint, too."""

    def __init__(self, prop, lid_rad=0.0):
        self.prop, self.lid_rad = prop, lid_rad

    def pose(self, now_s, flanges):
        return ObjectPose(np.array([0.0, 0.1, 0.2]), QUARTER, now_s, {"lid": self.lid_rad})


class NoTracker:
    def __init__(self, prop):
        self.prop = prop


def test_a_tracker_of_ones_own(file, system):
    entry = OwnTrackerEntry(prop="case", tracker=f"{__name__}:LidCamera", options="lid_rad=0.5")
    tracker = trackers_of(file.replace(emulator=None, tracker=(entry,)), (CASE,), system)["case"]
    assert (tracker.tracker.prop, tracker.pose(7.0, FLANGES).joints) == ("case", {"lid": 0.5})
    for changes, text in (
        ({"tracker": "no_such_module_here:X"}, "the tracker of the prop 'case', .* cannot be imported"),
        ({"options": "colour=red"}, "cannot be made of the name of the prop and the options colour=red"),
        ({"tracker": f"{__name__}:NoTracker", "options": ""}, "is no subclass of ObjectTracker"),
    ):
        with pytest.raises(SettingsError, match=text):
            trackers_of(file.replace(emulator=None, tracker=(entry.replace(**changes),)), (CASE,), system)


class AnyCamera(ObjectTracker):
    """Tracker whose answers are given."""

    answer = None

    def __init__(self, prop):
        pass

    def pose(self, now_s, flanges):
        return self.answer(now_s)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (lambda now: 1 / 0, "ZeroDivisionError"),
        (lambda now: None, "TypeError"),
        (lambda now: ObjectPose(np.zeros(2), QUARTER, now, {"lid": 0.0}), "expected are"),
        (lambda now: ObjectPose(np.full(3, np.nan), QUARTER, now, {"lid": 0.0}), "finite"),
        (lambda now: ObjectPose(np.zeros(3), 2 * QUARTER, now, {"lid": 0.0}), "unit quaternion"),
        (lambda now: ObjectPose(np.zeros(3), np.full(4, np.nan), now, {"lid": 0.0}), "unit quaternion"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, now, {"lid": np.inf}), "finite"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, now), "found the joints none; expected are lid"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, now, {"door": 0.0}), "found the joints door"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, now - 0.6, {"lid": 0.0}), "0.60 s old"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, np.nan, {"lid": 0.0}), "s old"),
        (lambda now: ObjectPose(np.zeros(3), QUARTER, 1.7e9, {"lid": 0.0}), "no time to come"),  # time.time()
    ],
)
def test_what_a_tracker_of_ones_own_gets_wrong_is_a_lost_tracker(file, system, monkeypatch, answer, text):
    monkeypatch.setattr(AnyCamera, "answer", staticmethod(answer))
    entry = OwnTrackerEntry(prop="case", tracker=f"{__name__}:AnyCamera")
    tracker = trackers_of(file.replace(emulator=None, tracker=(entry,)), (CASE,), system)["case"]
    with pytest.raises(LinkError, match=f"the tracker .*AnyCamera of the prop 'case': .*{text}"):
        tracker.pose(7.0, FLANGES)


# The emulated camera.


def test_the_camera_sees_where_the_object_was_placed(file, until, clock, system):
    with placer_of(file, system) as placer, tracker_of(file, system) as tracker:
        for x_m in (0.3, -0.1):
            placer.place("block", np.array([x_m, -0.2, 0.8]), QUARTER)
            placed_s = clock.now_s()
            found = until(lambda x_m=x_m: near(tracker.pose(clock.now_s(), FLANGES), x_m))
            assert abs(found.quat @ QUARTER) == pytest.approx(1.0, abs=1e-3)
            assert found.measured_s > placed_s - 0.1
        first = tracker.pose(clock.now_s(), FLANGES)
        until(lambda: tracker.pose(clock.now_s(), FLANGES).measured_s > first.measured_s + 0.1)


def near(pose, x_m):
    return pose if abs(pose.position_m[0] - x_m) < 1e-4 else None


def test_noise_and_delay_come_from_the_file(cell, file, clock, system):
    cell.ask("place", position_m=[0.3, 0.0, 0.0], quat=[1.0, 0.0, 0.0, 0.0])
    entry = EmulatedTrackerEntry(prop="block", noise_m=0.02, noise_rad=0.1, delay_s=0.2)
    with tracked(file, entry, system) as tracker:
        found = {}
        while len(found) < 40:
            pose = tracker.pose(clock.now_s(), FLANGES)
            assert 0.2 <= clock.now_s() - pose.measured_s <= STALE_S + 0.1
            found[pose.measured_s] = pose
            clock.sleep(0.002)
    positions = np.array([each.position_m for each in found.values()])
    assert 0.01 < positions.std(axis=0)[:2].mean() < 0.03
    assert np.std([each.quat[3] for each in found.values()]) > 0.02


def test_a_delay_that_makes_every_pose_too_old(file, system):
    assert STALE_S > 0.499
    with pytest.raises(SettingsError, match=r"delay_s is 0\.5: allowed is a number, 0 to 0\.499"):
        tracked(file, EmulatedTrackerEntry(prop="block").replace(delay_s=0.5), system)


def test_an_object_that_is_not_in_this_cell(file, system):
    with pytest.raises(LinkError, match=r"looking for 'bar'.*unknown body.*scene of this task"):
        tracker_of(file, system, BAR)


def test_no_cell_there(file, system):
    entry = file.emulator.replace(port=1)
    with pytest.raises(LinkError, match=r"emulated camera at .*:1.*no connection"):
        tracker_of(file.replace(emulator=entry), system)


def test_a_cell_that_ends_is_reported_at_once():
    with VirtualCell(task="Handover") as cell, tracker_of(cell.file, cell.system) as tracker:
        clock = cell.clock
        tracker.pose(clock.now_s(), FLANGES)
        cell.ask("shutdown")
        text = waiting.until(lambda: failure(tracker, clock), clock=clock)
        assert "emulated camera" in text
        assert "expected is a pose" in text
        assert failure(tracker, clock) == text


def test_a_cell_that_stalls_makes_poses_old(cell, file, clock, system):
    with tracker_of(file, system) as tracker:
        last = tracker.pose(clock.now_s(), FLANGES)
        cell.stall("emulated cell", 1.0)
        clock.sleep(STALE_S)
        assert not failure(tracker, clock)
        clock.sleep(0.1)
        assert "s old; expected is at most 0.5 s" in failure(tracker, clock)
        assert clock.now_s() - last.measured_s > STALE_S
        clock.sleep(1.0)
        assert not failure(tracker, clock)


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
        CameraTracker(JsonLink("emulated camera", HERE, port), "block", EmulatedTrackerEntry(prop="block"))
    assert len(str(found.value)) < 500


# The placer.


def test_an_object_that_cannot_be_placed(file, system):
    with placer_of(file, system) as placer:
        with pytest.raises(EmulatorError, match=r"not placed: .*allowed are"):
            placer.place("block", (99.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        placer.place("block", (0.3, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0))  # the connection goes on


def test_a_placer_that_does_not_answer(file, system):
    gone = file.replace(emulator=file.emulator.replace(port=1))
    with placer_of(gone, system) as placer, pytest.raises(EmulatorError, match=r"object placer at .*:1: no connection"):
        placer.place("block", (0.3, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0))


def test_a_cell_whose_objects_a_person_places(file, system):
    assert placer_of(file.replace(emulator=None), system) is None
