"""Keyboard: in a terminal, where keys have no release, or in a window of its own, where they are held."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any, Final

import numpy as np

from dual_ur10.errors import DeviceAbsentError, DeviceUnpluggedError, SettingsError
from dual_ur10.policies.operators import sdl as _sdl
from dual_ur10.policies.operators.device import FULL_TWIST, Device, Reading
from dual_ur10.policies.operators.hands import unplugged
from dual_ur10.policies.operators.terminal_keys import TerminalKeys
from ur_core.types import Array

MOTIONS: Final = {
    "w": (0, 1.0),
    "s": (0, -1.0),
    "a": (1, 1.0),
    "d": (1, -1.0),
    "r": (2, 1.0),
    "f": (2, -1.0),
    "o": (3, 1.0),
    "u": (3, -1.0),
    "i": (4, 1.0),
    "k": (4, -1.0),
    "j": (5, 1.0),
    "l": (5, -1.0),
}
"""Axis and direction of each key: forward and back, left and right, up and down, and rotations about these axes."""

KEYS: Final = {
    " ": "grip",
    "\t": "switch",
    "b": "record",
    "\r": "success",
    "\n": "success",
    "\x7f": "discard",
    "\b": "discard",
    "1": "take_left",
    "2": "take_right",
    "3": "take_both",
    "0": "hand_back",
    "n": "reset",
    "x": "stop",
}
"""Buttons of keys: space, tabulator, return and backspace are among them."""

_DECAY_S: Final = 0.15  # after a key, in which a terminal says nothing of its release
_READ_BYTES: Final = 4096  # as many as Linux keeps of a terminal
_READS: Final = 4  # in a row: what its other end still keeps comes after them


class Keyboard:
    """Keyboard for one hand.

    In a terminal a key gives a speed that decays in 0.15 s: terminals report no release, and repeat a held key only
    after about half a second. Tap, or use the window, where held keys move and released ones stop at once.

    Args:
        window: Open a window of its own for held keys; it needs the extra `teleop` and a display.
        speed: Speed of a key, as a fraction of full deflection, 0.01 to 1.
        file: Descriptor of the terminal; None: that of the standard input.
        clock: Clock of the decay.

    Raises:
        DeviceAbsentError: The standard input is no terminal, or there is no display for the window.
        DeviceError: SDL cannot be initialised.
        MissingExtraError: PySDL2 is not installed, for a window.
        SettingsError: A value is not legal.
    """

    hands = 1

    def __init__(
        self,
        window: bool = False,
        speed: float = 0.4,
        file: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not isinstance(window, bool):
            raise SettingsError(f"window of a keyboard is {window!r}: it must be True or False")
        if isinstance(speed, bool) or not isinstance(speed, int | float) or not 0.01 <= speed <= 1.0:
            raise SettingsError(f"speed of a keyboard is {speed!r}: it must be a number, 0.01 to 1")
        self._speed = float(speed)
        self._keys: _Terminal | _Window = _Window() if window else _Terminal(file, clock)
        self._stops: frozenset[str] = frozenset()  # pressed before the episode
        self.name = self._keys.name
        try:
            self.begin()
        except BaseException:
            self.close()
            raise

    def begin(self) -> None:
        """See `Device`. Keys held in a window are held still."""
        self._stops |= self._keys.read()[1] & {"stop"}
        self._keys.forget()

    def read(self) -> Reading:
        """See `Device`."""
        share, buttons = self._keys.read()
        buttons, self._stops = buttons | self._stops, frozenset()
        twist = np.zeros((2, 6))
        twist[0] = np.clip(share, -1.0, 1.0) * (self._speed * FULL_TWIST)
        return Reading(twist=twist, clutch=np.array([True, False]), buttons=buttons)

    def close(self) -> None:
        """See `Device`."""
        self._keys.close()


class WithKeys:
    """Device whose buttons are also on the keyboard of the terminal, which moves nothing.

    Args:
        device: Device; it is closed with this one.
        keys: Keyboard.
    """

    def __init__(self, device: Device, keys: Keyboard) -> None:
        self.device, self._keys = device, keys
        self.name, self.hands = device.name, device.hands

    def begin(self) -> None:
        """See `Device`."""
        self.device.begin()
        self._keys.begin()

    def read(self) -> Reading:
        """See `Device`."""
        reading = self.device.read()
        return replace(reading, buttons=frozenset(reading.buttons) | self._keys.read().buttons)

    def close(self) -> None:
        """See `Device`."""
        try:
            self.device.close()
        finally:
            self._keys.close()


class _Terminal:
    """Keys of a terminal, which shows none of them meanwhile."""

    name = "keyboard of the terminal"

    def __init__(self, file: int | None, clock: Callable[[], float]) -> None:
        self._file = _standard_input() if file is None else file
        if not os.isatty(self._file):
            raise DeviceAbsentError(
                "keyboard: the standard input is no terminal. Run this in one, or with keyboard:window=true"
            )
        self._clock, self._parser = clock, TerminalKeys()
        self.forget()
        self._before: list[Any] | None = termios.tcgetattr(self._file)
        tty.setcbreak(self._file, termios.TCSANOW)  # Ctrl-C still interrupts

    def read(self) -> tuple[Array, frozenset[str]]:
        """Return shares of full speed, (6,), and buttons."""
        now, buttons = self._clock(), set()
        for key in self._text():
            if key in MOTIONS:
                self._pressed_s[key] = now
            elif key in KEYS:
                buttons.add(KEYS[key])
        share = np.zeros(6)
        for key, (axis, sign) in MOTIONS.items():
            share[axis] += sign * max(0.0, 1.0 - (now - self._pressed_s[key]) / _DECAY_S)
        return share, frozenset(buttons)

    def forget(self) -> None:
        """Let no key that was read move anything."""
        self._pressed_s = dict.fromkeys(MOTIONS, -np.inf)

    def _text(self) -> str:
        """Return the keys since the last reading."""
        data = b""
        for _ in range(_READS):
            # Without blocking set off, which would concern the standard output, too: it is the same open terminal.
            if not select.select([self._file], [], [], 0.0)[0]:
                break
            try:
                piece = os.read(self._file, _READ_BYTES)
            except OSError as error:
                unplugged(self.name, error)
            if not piece:
                unplugged(self.name)
            data += piece
        return self._parser.keys(data)

    def close(self) -> None:
        """Restore the terminal. May be called twice."""
        before, self._before = self._before, None
        if before is not None:
            with contextlib.suppress(OSError, termios.error):  # it is gone
                termios.tcsetattr(self._file, termios.TCSANOW, before)


def _standard_input() -> int:
    try:
        return sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):
        raise DeviceAbsentError("keyboard: there is no standard input. Run this in a terminal") from None


_UNSEEN: Final = b"offscreen"  # SDL's driver where there is no display


class _Window:
    """Keys that are held in a window."""

    name = "keyboard of the window"

    def __init__(self) -> None:
        self._sdl = sdl = _sdl.load("a keyboard's window")
        self._held: set[str] = set()
        self._parts = sdl.SDL_INIT_VIDEO
        _sdl.begin(sdl, self._parts)
        title = b"dual_ur10: keys move the arms while this window has the focus"
        middle = sdl.SDL_WINDOWPOS_CENTERED
        is_seen = sdl.SDL_GetCurrentVideoDriver() != _UNSEEN
        shown = sdl.SDL_WINDOW_SHOWN
        self._window: Any = sdl.SDL_CreateWindow(title, middle, middle, 480, 120, shown) if is_seen else None
        if not self._window:
            _sdl.end(sdl, self._parts)
            raise DeviceAbsentError(
                "keyboard: there is no display for its window. Run this where there is one, or in a terminal with "
                "keyboard alone"
            )

    def read(self) -> tuple[Array, frozenset[str]]:
        """Return shares of full speed, (6,), and buttons."""
        sdl, buttons = self._sdl, set()
        for event in _sdl.events(sdl, sdl.SDL_QUIT, sdl.SDL_KEYUP):
            if event.type == sdl.SDL_QUIT or self._is_window(event, {sdl.SDL_WINDOWEVENT_CLOSE}):
                raise DeviceUnpluggedError(f"{self.name} was closed")
            if self._is_window(event, {sdl.SDL_WINDOWEVENT_FOCUS_LOST, sdl.SDL_WINDOWEVENT_HIDDEN}):
                self._held.clear()
            if event.type not in (sdl.SDL_KEYDOWN, sdl.SDL_KEYUP):
                continue
            code = event.key.keysym.sym
            key = chr(code) if 0 <= code < 128 else ""
            if event.type == sdl.SDL_KEYUP:
                self._held.discard(key)
            elif not event.key.repeat:
                self._held.add(key)
                if key in KEYS:
                    buttons.add(KEYS[key])
        share = np.zeros(6)
        for key in self._held & MOTIONS.keys():
            axis, sign = MOTIONS[key]
            share[axis] += sign
        return share, frozenset(buttons)

    def forget(self) -> None:
        """Keep the keys that are held: that they are is no matter of the past."""

    def _is_window(self, event: Any, kinds: Collection[int]) -> bool:
        return event.type == self._sdl.SDL_WINDOWEVENT and event.window.event in kinds

    def close(self) -> None:
        """Close the window. May be called twice."""
        if self._window is not None:
            self._sdl.SDL_DestroyWindow(self._window)
            self._window = None
            _sdl.end(self._sdl, self._parts)
