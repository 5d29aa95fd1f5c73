"""SDL, as far as gamepads and a window with held keys need it: PySDL2, from the extra `teleop`."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

from dual_ur10.errors import DeviceError, MissingExtraError

_users = 0


def load(purpose: str) -> Any:
    """Return the module `sdl2`.

    Raises:
        MissingExtraError: PySDL2 is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it tells where it found its library
            import sdl2
    except ImportError:
        raise MissingExtraError("PySDL2", "teleop", purpose) from None
    return sdl2


def begin(sdl: Any, parts: int) -> None:
    """Initialise parts of SDL; `end` undoes it after the last user.

    Raises:
        DeviceError: It fails, for example because there is no display.
    """
    global _users  # SDL is one for each process
    sdl.SDL_SetHint(sdl.SDL_HINT_JOYSTICK_ALLOW_BACKGROUND_EVENTS, b"1")
    sdl.SDL_SetHint(sdl.SDL_HINT_NO_SIGNAL_HANDLERS, b"1")
    if sdl.SDL_InitSubSystem(parts) != 0:
        raise DeviceError(f"SDL cannot begin: {sdl.SDL_GetError().decode()}. A window needs a display")
    _users += 1


def end(sdl: Any, parts: int) -> None:
    """Undo `begin`."""
    global _users
    sdl.SDL_QuitSubSystem(parts)
    _users -= 1
    if not _users:
        sdl.SDL_Quit()


def events(sdl: Any, first: int, last: int) -> Iterator[Any]:
    """Yield the events of some kinds that have come since the last call."""
    sdl.SDL_PumpEvents()
    event = sdl.SDL_Event()
    while sdl.SDL_PeepEvents(event, 1, sdl.SDL_GETEVENT, first, last) == 1:
        yield event
