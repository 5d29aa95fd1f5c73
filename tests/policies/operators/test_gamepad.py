"""Gamepads as SDL's virtual joysticks. Real ones were not tried."""

import subprocess
import sys

import numpy as np
import pytest

from dual_ur10.errors import DeviceAbsentError, DeviceUnpluggedError, SettingsError
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.gamepad import Gamepad

sdl2 = pytest.importorskip("sdl2")

LEFT_X, LEFT_Y, RIGHT_X, RIGHT_Y = 0, 1, 2, 3
A, SHOULDER_RIGHT, CROSS_UP = 0, 10, 11


class VirtualPad:
    """Virtual gamepad, as long as the block runs."""

    def __enter__(self):
        sdl2.SDL_InitSubSystem(sdl2.SDL_INIT_GAMECONTROLLER)
        self._index = sdl2.SDL_JoystickAttachVirtual(sdl2.SDL_JOYSTICK_TYPE_GAMECONTROLLER, 6, 21, 0)
        assert self._index >= 0
        self._stick, self._attached = sdl2.SDL_JoystickOpen(self._index), True
        return self

    def axis(self, number, value):
        sdl2.SDL_JoystickSetVirtualAxis(self._stick, number, round(value * 32767))

    def button(self, number, held):
        sdl2.SDL_JoystickSetVirtualButton(self._stick, number, held)

    def unplug(self):
        if self._attached:
            self._attached = False
            sdl2.SDL_JoystickDetachVirtual(self._index)

    def __exit__(self, *_):
        self.unplug()
        sdl2.SDL_JoystickClose(self._stick)
        sdl2.SDL_QuitSubSystem(sdl2.SDL_INIT_GAMECONTROLLER)


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def test_sticks_and_cross_are_speeds():
    with VirtualPad() as raw:
        pad = Gamepad()
        raw.axis(LEFT_Y, -1.0)  # forward
        raw.axis(LEFT_X, 0.5)  # right
        raw.axis(RIGHT_Y, 1.0)  # down
        raw.axis(RIGHT_X, -1.0)  # left: anticlockwise
        raw.button(CROSS_UP, 1)
        reading = pad.read()
        np.testing.assert_allclose(reading.twist[0] / FULL_TWIST, [1, -0.5, -1, 0, 0.5, 1], atol=1e-3)
        assert reading.clutch.tolist() == [True, False]
        pad.close()
        pad.close()


def test_buttons_count_once_when_pressed():
    with VirtualPad() as raw:
        pad = Gamepad()
        raw.button(A, 1)
        raw.button(SHOULDER_RIGHT, 1)
        assert pad.read().buttons == {"grip", "switch"}
        assert not pad.read().buttons
        raw.button(A, 0)
        assert not pad.read().buttons
        raw.button(A, 1)
        assert pad.read().buttons == {"grip"}
        raw.button(SHOULDER_RIGHT, 0)
        pad.read()
        raw.button(SHOULDER_RIGHT, 1)
        pad.begin()
        assert not pad.read().buttons  # before the episode
        pad.close()


def test_unplugging_is_named():
    with VirtualPad() as raw:
        pad = Gamepad()
        raw.axis(LEFT_Y, -1.0)
        assert pad.read().twist.any()
        raw.unplug()
        with pytest.raises(DeviceUnpluggedError, match="gamepad 0 was unplugged"):
            pad.read()
        pad.close()


def test_absent_ones_and_wrong_numbers_are_named():
    with pytest.raises(DeviceAbsentError, match=r"no gamepad 0: found none.*ID_INPUT_JOYSTICK"):
        Gamepad()
    with VirtualPad(), pytest.raises(DeviceAbsentError, match=r"no gamepad 1: found \w+"):
        Gamepad(index=1)
    with pytest.raises(SettingsError, match="whole number"):
        Gamepad(index=-1)


@pytest.mark.parametrize(
    ("package", "device"),
    [
        ("sdl2", "gamepad:Gamepad()"),
        ("sdl2", "keyboard:Keyboard(window=True)"),
        ("serial", "leader:Leader('/dev/ttyUSB0')"),
    ],
)
def test_a_missing_extra_is_named(package, device):
    module, made = device.split(":")
    code = f"import sys; sys.modules[{package!r}] = None\nfrom dual_ur10.policies.operators.{module} import *\n{made}"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert 'pip install "dual-ur10[teleop]"' in found.stderr
