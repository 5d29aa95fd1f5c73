"""Gamepads, by SDL's mapping of their sticks and buttons."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np

from dual_ur10.errors import DeviceAbsentError, DeviceUnpluggedError, SettingsError
from dual_ur10.policies.operators import sdl as _sdl
from dual_ur10.policies.operators.device import FULL_TWIST, Reading

UDEV_RULE: Final = 'SUBSYSTEM=="input", ENV{ID_INPUT_JOYSTICK}=="1", MODE="0660", TAG+="uaccess"'
"""Rule of udev that permits the person at the screen to read a gamepad. Most systems have it."""

_FULL: Final = 32767.0
_STICKS: Final = {"LEFTY": (0, -1.0), "LEFTX": (1, -1.0), "RIGHTY": (2, -1.0), "RIGHTX": (5, -1.0)}
_PADS: Final = {"DPAD_RIGHT": (3, 1.0), "DPAD_LEFT": (3, -1.0), "DPAD_UP": (4, 1.0), "DPAD_DOWN": (4, -1.0)}
_BUTTONS: Final = {
    "A": "grip",
    "RIGHTSHOULDER": "switch",
    "LEFTSHOULDER": "record",
    "START": "success",
    "BACK": "discard",
    "B": "hand_back",
    "X": "take_left",
    "Y": "take_right",
    "GUIDE": "reset",
}


class Gamepad:
    """Gamepad for one hand.

    The left stick moves forward, back, left and right, the right one up and down, and rotates about the vertical. The
    cross rotates about the other axes at half speed. A: gripper; right shoulder: the other arm; left shoulder: record;
    start: success; back: discard; X, Y: take the left or the right arm; B: hand back; guide: reset.

    Args:
        index: Number of the gamepad among those of this machine, from 0.
        clock: Not used, since sticks at rest report nothing.

    Raises:
        MissingExtraError: PySDL2 is not installed.
        DeviceAbsentError: There is no such gamepad.
        SettingsError: The number is none.
    """

    hands = 1

    def __init__(self, index: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        if isinstance(index, bool) or not isinstance(index, int) or index < 0:
            raise SettingsError(f"index of a gamepad is {index!r}: it must be a whole number from 0")
        self._sdl = sdl = _sdl.load("a gamepad")
        self.name, self._pad, self._held = f"gamepad {index}", None, frozenset[str]()
        self._parts = sdl.SDL_INIT_GAMECONTROLLER
        _sdl.begin(sdl, self._parts)
        pads = [k for k in range(sdl.SDL_NumJoysticks()) if sdl.SDL_IsGameController(k)]
        self._pad = sdl.SDL_GameControllerOpen(pads[index]) if index < len(pads) else None
        if not self._pad:
            names = [sdl.SDL_GameControllerNameForIndex(k) or b"without a name" for k in pads]
            self._pad = None
            _sdl.end(sdl, self._parts)
            raise DeviceAbsentError(
                f"there is no gamepad {index}: found {', '.join(each.decode() for each in names) or 'none'}. If one is "
                f"plugged in, this user may not read it; put into /etc/udev/rules.d/60-dual-ur10.rules: {UDEV_RULE}"
            )

    def begin(self) -> None:
        """See `Device`."""
        self.read()

    def read(self) -> Reading:
        """See `Device`."""
        sdl, pad = self._sdl, self._pad
        sdl.SDL_GameControllerUpdate()
        if pad is None or not sdl.SDL_GameControllerGetAttached(pad):
            raise DeviceUnpluggedError(f"{self.name} was unplugged: plug it in, and start again")
        share = np.zeros(6)
        for name, (axis, sign) in _STICKS.items():
            share[axis] += (
                sign * sdl.SDL_GameControllerGetAxis(pad, getattr(sdl, f"SDL_CONTROLLER_AXIS_{name}")) / _FULL
            )
        for name, (axis, sign) in _PADS.items():
            share[axis] += sign / 2 * self._is_held(name)
        held = frozenset(name for name in _BUTTONS if self._is_held(name))
        pressed, self._held = held - self._held, held
        twist = np.zeros((2, 6))
        twist[0] = np.clip(share, -1.0, 1.0) * FULL_TWIST
        return Reading(
            twist=twist, clutch=np.array([True, False]), buttons=frozenset(_BUTTONS[each] for each in pressed)
        )

    def _is_held(self, button: str) -> bool:
        return bool(
            self._sdl.SDL_GameControllerGetButton(self._pad, getattr(self._sdl, f"SDL_CONTROLLER_BUTTON_{button}"))
        )

    def close(self) -> None:
        """See `Device`."""
        if self._pad is not None:
            self._sdl.SDL_GameControllerClose(self._pad)
            self._pad = None
            _sdl.end(self._sdl, self._parts)
