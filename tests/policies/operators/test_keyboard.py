"""Keyboards: a pseudo terminal, and SDL's events without a display."""

import contextlib
import os
import pty
import random
import select
import termios

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import DeviceAbsentError, DeviceUnpluggedError, SettingsError, StopPressedError
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.keyboard import KEYS, MOTIONS, Keyboard, WithKeys
from dual_ur10.policies.operators.terminal_keys import TerminalKeys
from tests.policies.operators.hands import Hand, led, twist
from tests.policies.operators.key_streams import SEQUENCES, TYPED, stops_lost


class Clock:
    now_s = 10.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def terminal():
    """Return both ends of a pseudo terminal."""
    own, other = pty.openpty()
    yield own, other
    for each in (own, other):
        with contextlib.suppress(OSError):
            os.close(each)


def write(terminal, data):
    """Type, and wait until that has come."""
    os.write(terminal[0], data)
    select.select([terminal[1]], [], [], 10.0)


def test_a_key_of_a_terminal_gives_a_speed_that_decays(terminal):
    own, other = terminal
    clock = Clock()
    keyboard = Keyboard(file=other, clock=clock, speed=0.5)
    assert not keyboard.read().twist.any()
    os.write(own, b"wJ")
    share = keyboard.read().twist[0] / FULL_TWIST
    np.testing.assert_allclose(share, [0.5, 0, 0, 0, 0, 0.5])
    clock.now_s += 0.075
    np.testing.assert_allclose(keyboard.read().twist[0] / FULL_TWIST, share / 2)
    clock.now_s += 0.08
    assert not keyboard.read().twist.any()


def test_opposite_keys_cancel_and_every_axis_has_both_directions(terminal):
    own, other = terminal
    keyboard = Keyboard(file=other)
    os.write(own, "".join(MOTIONS).encode())
    assert not keyboard.read().twist.any()
    assert sorted(MOTIONS.values()) == sorted((axis, sign) for axis in range(6) for sign in (-1.0, 1.0))
    assert not {*MOTIONS} & {*KEYS}


def test_other_keys_are_buttons(terminal):
    own, other = terminal
    keyboard = Keyboard(file=other)
    os.write(own, b" \t2zq\xc3\xa4")
    assert keyboard.read().buttons == {"grip", "switch", "take_right"}
    assert not keyboard.read().buttons


@given(st.lists(st.sampled_from([*TYPED, *SEQUENCES, b"\xc3\xa4"])), st.lists(st.integers(0, 60)))
def test_what_is_typed_comes_through_and_no_letter_of_a_sequence(tokens, cuts):
    data, ends = b"".join(tokens), sorted(cuts)
    parser = TerminalKeys()
    found = "".join(parser.keys(data[a:b]) for a, b in zip([0, *ends], [*ends, len(data)], strict=True))
    assert found == b"".join(each for each in tokens if each in TYPED).decode().lower()


@given(st.lists(st.binary(max_size=6), max_size=6))
def test_no_bytes_hide_the_stop_key(pieces):
    parser = TerminalKeys()
    found = "".join(map(parser.keys, pieces))
    assert found.count("x") == b"".join(pieces).lower().count(b"x")


def test_whole_answers_of_a_terminal_are_no_keys():
    parser = TerminalKeys()
    assert parser.keys(b"w\x1b]11;rgb:1e1e/1e1e/1e1e\x1b\\s\x1b]0;we\x07d\x1bP1$r0m\x1b\\") == "wsd"
    assert parser.keys(b"\x1bPwas") == "pwas"  # typed, with Alt


def test_no_stop_is_lost_among_keys_on_a_terminal():
    assert stops_lost(200, random.Random(0)) == 0  # of 10,000 in benchmarks/operators.py


@pytest.mark.parametrize("with_keys", [False, True])
def test_keys_typed_before_an_episode_count_for_nothing_but_stop(terminal, with_keys):
    own, other = terminal
    os.write(own, b"w2")
    select.select([own], [], [], 10.0)  # the echo
    keyboard = Keyboard(file=other)
    device = WithKeys(Hand(1, **twist(0, 0, 0, 0, 0, 0)), keyboard) if with_keys else keyboard
    early = keyboard.read()  # typed before the program
    assert not early.buttons
    assert not early.twist.any()
    env, operator = led(device)
    observation, _ = env.reset(seed=0)
    for _ in range(2):
        operator.reset()
        write(terminal, b"ww1")  # while the arms move to the start
        action = operator(observation)
        assert not operator.buttons
        assert not np.any(action.reshape(2, -1)[:, :6])
        write(terminal, b"2")
        operator(observation)
        assert operator.buttons == {"take_right"}
    operator.reset()
    write(terminal, b"wx2")
    device.begin()
    device.begin()
    with pytest.raises(StopPressedError):
        operator(observation)
    env.close()


def test_the_terminal_is_restored(terminal):
    _, other = terminal
    before = termios.tcgetattr(other)
    keyboard = Keyboard(file=other)
    assert termios.tcgetattr(other) != before
    assert os.get_blocking(other)  # the standard output is the same terminal
    keyboard.close()
    keyboard.close()
    assert termios.tcgetattr(other) == before


def test_a_terminal_that_hangs_up_is_named(terminal):
    own, other = terminal
    keyboard = Keyboard(file=other)
    os.close(own)
    with pytest.raises(DeviceUnpluggedError, match="keyboard of the terminal"):
        keyboard.read()
    keyboard.close()


def test_what_is_no_terminal_is_refused(tmp_path):
    with open(tmp_path / "file", "w") as file, pytest.raises(DeviceAbsentError, match="no terminal"):
        Keyboard(file=file.fileno())


@pytest.mark.parametrize("arguments", [{"speed": 0.0}, {"speed": "fast"}, {"window": "yes"}])
def test_wrong_arguments_are_named(arguments):
    with pytest.raises(SettingsError, match="of a keyboard is"):
        Keyboard(**arguments)


class TestWindow:
    @pytest.fixture
    def sdl(self, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        return pytest.importorskip("sdl2")

    @pytest.fixture
    def keyboard(self, sdl):
        made = Keyboard(window=True, speed=1.0)
        made.read()
        yield made
        made.close()
        made.close()

    def test_a_window_that_nobody_sees_is_refused(self, sdl, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")  # what SDL takes where there is no display
        with pytest.raises(DeviceAbsentError, match="no display for its window"):
            Keyboard(window=True)
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        Keyboard(window=True).close()

    @staticmethod
    def key(sdl, key, kind, repeat=0):
        event = sdl.SDL_Event()
        event.type = event.key.type = kind
        event.key.keysym.sym, event.key.repeat = ord(key), repeat
        sdl.SDL_PushEvent(event)

    def test_a_key_moves_while_it_is_held(self, sdl, keyboard):
        self.key(sdl, "w", sdl.SDL_KEYDOWN)
        self.key(sdl, "l", sdl.SDL_KEYDOWN)
        for _ in range(2):
            np.testing.assert_allclose(keyboard.read().twist[0] / FULL_TWIST, [1, 0, 0, 0, 0, -1])
        self.key(sdl, "w", sdl.SDL_KEYUP)
        np.testing.assert_allclose(keyboard.read().twist[0] / FULL_TWIST, [0, 0, 0, 0, 0, -1])

    def test_buttons_count_once(self, sdl, keyboard):
        self.key(sdl, " ", sdl.SDL_KEYDOWN)
        assert keyboard.read().buttons == {"grip"}
        self.key(sdl, " ", sdl.SDL_KEYDOWN, repeat=1)
        assert not keyboard.read().buttons

    def test_what_was_pressed_before_an_episode_counts_only_if_it_stops(self, sdl, keyboard):
        for key in "2xw":
            self.key(sdl, key, sdl.SDL_KEYDOWN)
        keyboard.begin()
        reading = keyboard.read()
        assert reading.buttons == {"stop"}
        assert reading.twist.any()  # a key is held
        assert not keyboard.read().buttons

    def test_without_the_focus_nothing_is_held(self, sdl, keyboard):
        self.key(sdl, "w", sdl.SDL_KEYDOWN)
        assert keyboard.read().twist.any()
        self.window(sdl, sdl.SDL_WINDOWEVENT_FOCUS_LOST)
        assert not keyboard.read().twist.any()

    def test_a_closed_window_is_named(self, sdl, keyboard):
        self.window(sdl, sdl.SDL_WINDOWEVENT_CLOSE)
        with pytest.raises(DeviceUnpluggedError, match="window was closed"):
            keyboard.read()

    @staticmethod
    def window(sdl, kind):
        event = sdl.SDL_Event()
        event.type = event.window.type = sdl.SDL_WINDOWEVENT
        event.window.event = kind
        sdl.SDL_PushEvent(event)
