"""Operators by name, and the arguments in one text."""

import os
import pty
import sys
import termios
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from dual_ur10.envs.rendering.live import buttons
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.operators import gamepad, keyboard
from dual_ur10.policies.operators.catalog import DEVICES, arguments_in, device_class, load_operator, make_device
from dual_ur10.policies.operators.device import BUTTONS
from dual_ur10.policies.operators.mapping import Mapping
from tests.policies.operators.rigs import RawMouse


def test_names_and_classes_are_told_apart():
    assert device_class("spacemouse") == (DEVICES["spacemouse"], "")
    assert device_class("leader:left=/dev/ttyUSB0,baud=1000000") == (
        DEVICES["leader"],
        "left=/dev/ttyUSB0,baud=1000000",
    )
    assert device_class("my.module:Wheel") == ("my.module:Wheel", "")
    assert device_class("my.module:Wheel:gain=2,name=a:b") == ("my.module:Wheel", "gain=2,name=a:b")
    with pytest.raises(UnknownNameError, match="did you mean 'spacemouse'"):
        device_class("spacemous")


def test_an_installed_package_brings_devices_by_name(monkeypatch):
    found = [EntryPoint(name, "my_lab.wheel:Wheel", "dual_ur10.devices") for name in ("wheel", "keyboard")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: found)
    assert device_class("wheel:gain=2") == ("my_lab.wheel:Wheel", "gain=2")
    assert device_class("keyboard") == (DEVICES["keyboard"], "")  # none takes the name of another
    with pytest.raises(SettingsError, match=r"the operator's device, 'my_lab.wheel:Wheel', cannot be imported"):
        make_device("wheel")


def test_every_button_of_a_device_is_known_by_one_name():
    assert {*keyboard.KEYS.values(), *gamepad._BUTTONS.values()} <= {*BUTTONS}
    assert {*BUTTONS} & {*buttons.BUTTONS} == {*buttons.EPISODES, *buttons.TAKES, "stop"}


def test_arguments_are_numbers_truths_texts_and_tuples():
    text = "left=/dev/hidraw3,scale=0.5,mirror=true,offsets_rad=0/1.5/-3,frame=tool,index=2"
    assert arguments_in(text) == {
        "left": "/dev/hidraw3",
        "scale": 0.5,
        "mirror": True,
        "offsets_rad": (0, 1.5, -3),
        "frame": "tool",
        "index": 2,
    }
    assert arguments_in("") == {}
    for wrong in ("left", "=3", "a-b=3"):
        with pytest.raises(SettingsError, match="KEY=VALUE"):
            arguments_in(wrong)
    with pytest.raises(SettingsError, match="given twice"):
        arguments_in("a=1,a=2")


def test_a_device_is_made_with_its_arguments_and_its_mapping(tmp_path):
    left, right = RawMouse(tmp_path, "left"), RawMouse(tmp_path, "right")
    device, mapping = make_device(f"spacemouse:left={left.path},right={right.path},frame=tool,scale=0.5")
    assert mapping == Mapping(frame="tool", scale=0.5)
    assert device.hands == 2
    device.close()


def test_unknown_arguments_are_named_with_those_that_exist(tmp_path):
    with pytest.raises(UnknownNameError, match=r"operator spacemouse 'lefty' \(did you mean 'left'\?\).*'frame'"):
        make_device("spacemouse:lefty=/dev/hidraw3")
    with pytest.raises(UnknownNameError, match="'clock'"):
        make_device("keyboard:clock=3")
    with pytest.raises(SettingsError, match="cannot be imported"):
        make_device("no_such_module:Wheel")
    with pytest.raises(SettingsError, match="no input device"):
        load_operator("fractions:Fraction", "SineTracking", {})
    with pytest.raises(SettingsError, match="cannot be made"):
        make_device("dual_ur10.policies.operators.device:Device")


def test_buttons_are_also_keys_of_the_terminal(tmp_path, monkeypatch):
    own, other = pty.openpty()
    raw = RawMouse(tmp_path, "mouse")
    with os.fdopen(other) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(other)
        operator = load_operator(f"spacemouse:path={raw.path}", "SineTracking", {}, keys=True)
        os.write(own, b"w1")
        raw.press(1)
        reading = operator.device.read()
        assert reading.buttons == {"take_left", "grip"}
        assert not reading.twist.any()
        assert (operator.device.hands, operator.device.name) == (1, f"spacemouse at {raw.path}")
        operator.close()
        assert termios.tcgetattr(other) == before
    os.close(own)
    monkeypatch.setattr(sys, "stdin", None)
    load_operator(f"spacemouse:path={raw.path}", "SineTracking", {}, keys=True).close()


def test_an_operator_knows_its_environment_and_is_paced_in_simulation_alone(tmp_path):
    raw = RawMouse(tmp_path, "mouse")
    text = f"spacemouse:path={raw.path},arms=right"
    operator = load_operator(text, "Handover", {"action_mode": "tcp_delta", "policy_rate_hz": 12.5}, paced=True)
    assert (operator.timing.period_s, operator.grippers, operator._clock is None) == (0.08, True, False)
    assert operator.__name__ == f"operator with spacemouse at {raw.path}"
    operator.close()
    assert load_operator(text, "SineTracking", {})._clock is None
    assert not load_operator(text, "SyncCarry", {"grasp": "rigid"}).grippers
    assert np.array_equal(operator.opening, [1, 1])
