"""SpaceMice as raw reports in a pipe. Real ones were not tried."""

import os

import numpy as np
import pytest

from dual_ur10.errors import (
    DeviceAbsentError,
    DeviceDeniedError,
    DeviceGarbageError,
    DeviceSharedError,
    DeviceUnpluggedError,
    SettingsError,
)
from dual_ur10.policies.operators import spacemouse
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.spacemouse import SpaceMouse, found_here
from tests.policies.operators.rigs import RawMouse


@pytest.fixture
def clock():
    """Return a clock that stands still until it is set."""

    class Clock:
        now_s = 100.0

        def __call__(self):
            return self.now_s

    return Clock()


@pytest.mark.parametrize("new", [False, True])
def test_both_forms_of_reports_give_the_same_speeds(tmp_path, clock, new):
    raw = RawMouse(tmp_path, "mouse", new=new)
    mouse = SpaceMouse(raw.path, clock=clock)
    raw.axes([-70, -350, -175, -35, -350, 350])
    reading = mouse.read()
    np.testing.assert_allclose(reading.twist[0] / FULL_TWIST, [1.0, 0.2, 0.5, 1.0, 0.1, -1.0])
    assert reading.clutch.tolist() == [True, False]
    assert not reading.twist[1].any()


def test_all_waiting_reports_are_taken_in_at_once(tmp_path, clock):
    raw = RawMouse(tmp_path, "mouse")
    mouse = SpaceMouse(raw.path, clock=clock)
    for _ in range(250):
        raw.send(1, 0, 0, 1, 0, 0, 0)
    raw.axes([0] * 6)
    assert not mouse.read().twist.any()


def test_two_mice_are_two_hands(tmp_path, clock):
    left, right = RawMouse(tmp_path, "left"), RawMouse(tmp_path, "right", new=True)
    mouse = SpaceMouse(left=left.path, right=right.path, clock=clock)
    left.deflect([0.25, 0, 0, 0, 0, 0])
    right.deflect([0, 0, -0.125, 0, 0, 0.5])
    left.press(1)
    right.press(2)
    reading = mouse.read()
    np.testing.assert_allclose(reading.twist, [[0.25, 0, 0, 0, 0, 0], [0, 0, -0.125, 0, 0, 0.5]], atol=1e-3)
    assert reading.buttons == {"grip_left", "success"}
    assert reading.clutch.all()
    assert not mouse.read().buttons  # held, and not pressed anew
    left.press(0)
    left.press(1)
    assert mouse.read().buttons == {"grip_left"}
    right.press(0)
    right.press(2)
    mouse.begin()
    assert not mouse.read().buttons  # before the episode


def test_silence_while_deflected_ages_and_rest_does_not(tmp_path, clock):
    raw = RawMouse(tmp_path, "mouse")
    mouse = SpaceMouse(raw.path, clock=clock)
    clock.now_s += 5.0
    assert mouse.read().age_s == 0.0
    raw.axes([0, -350, 0, 0, 0, 0])
    assert mouse.read().age_s == 0.0
    clock.now_s += 0.3
    assert mouse.read().age_s == pytest.approx(0.3)
    raw.axes([0] * 6)
    assert mouse.read().age_s == 0.0


@pytest.mark.parametrize("report", [(1, 0, 0, 1), (2, 1), (1, 0, 0, 0, 0x7F, 0, 0)])
def test_garbage_is_named(tmp_path, report):
    raw = RawMouse(tmp_path, "mouse")
    mouse = SpaceMouse(raw.path)
    raw.send(*report)
    with pytest.raises(DeviceGarbageError, match=r"spacemouse at .* sent 0"):
        mouse.read()


def test_other_reports_are_left_out(tmp_path):
    raw = RawMouse(tmp_path, "mouse")
    mouse = SpaceMouse(raw.path)
    raw.send(23, 80)
    raw.deflect([0.25, 0, 0, 0, 0, 0])
    assert mouse.read().twist[0, 0] == pytest.approx(0.25)


def test_unplugging_is_named(tmp_path):
    raw = RawMouse(tmp_path, "mouse")
    mouse = SpaceMouse(raw.path)
    raw.unplug()
    with pytest.raises(DeviceUnpluggedError, match="was unplugged"):
        mouse.read()
    mouse.close()
    mouse.close()


def test_a_device_that_is_gone_is_named_as_unplugged(tmp_path, monkeypatch):
    mouse = SpaceMouse(RawMouse(tmp_path, "mouse").path)

    def gone(*_):
        raise OSError(19, "No such device")

    monkeypatch.setattr(spacemouse.os, "read", gone)
    with pytest.raises(DeviceUnpluggedError):
        mouse.read()


def test_absent_denied_and_shared_devices_are_named(tmp_path, monkeypatch):
    with pytest.raises(DeviceAbsentError, match=r"there is no .*/none.*Found here: none"):
        SpaceMouse(str(tmp_path / "none"))
    raw = RawMouse(tmp_path, "mouse")
    (tmp_path / "link").symlink_to(raw.path)
    with pytest.raises(DeviceSharedError, match="both hands"):
        SpaceMouse(left=raw.path, right=str(tmp_path / "link"))
    with pytest.raises(SettingsError, match="two as left"):
        SpaceMouse(left=raw.path)

    def denied(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", denied)
    with pytest.raises(DeviceDeniedError, match=r'udev.*SUBSYSTEM=="hidraw".*256f'):
        SpaceMouse(raw.path)


def test_the_mice_of_a_machine_are_found_by_their_vendor(tmp_path):
    for name, identity in (
        ("hidraw0", "0003:0000046D:0000C31C"),  # a keyboard
        ("hidraw3", "0003:0000256F:0000C635"),
        ("hidraw4", "0003:0000046D:0000C626"),
    ):
        (tmp_path / name / "device").mkdir(parents=True)
        (tmp_path / name / "device" / "uevent").write_text(f"DRIVER=hid\nHID_ID={identity}\n")
    assert found_here(tmp_path) == ["/dev/hidraw3", "/dev/hidraw4"]
    assert found_here(tmp_path / "none") == []


def test_without_a_path_it_is_the_only_one(monkeypatch):
    monkeypatch.setattr(spacemouse, "found_here", lambda: ["/dev/hidraw3", "/dev/hidraw4"])
    with pytest.raises(DeviceAbsentError, match="found /dev/hidraw3, /dev/hidraw4"):
        SpaceMouse()
