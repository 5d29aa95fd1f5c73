"""Input validation of motion commands. Every function raises `MotionError` for a value that it refuses."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

from ur_core.errors import MotionError
from ur_emulator.motion.tool_kinematics import Frame, frame_of

_MAX_DISTANCE_M: Final = 100.0
_MAX_ROTVEC_RAD: Final = 100.0


def number(value: Any, what: str) -> float:
    """Return a finite number."""
    try:
        found = float(0.0 + value)  # which text does not pass
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise MotionError(f"{what} is {value!r}: it must be a finite number")
    return found


def six(values: Iterable[Any], what: str) -> tuple[float, ...]:
    """Return six finite numbers."""
    try:
        found = tuple([float(0.0 + each) for each in values])
    except (TypeError, ValueError, OverflowError):
        found = ()
    if len(found) != 6 or not all(map(math.isfinite, found)):
        raise MotionError(f"{what} must be six finite numbers, found {values!r}")
    return found


def positive(value: Any, what: str) -> float:
    """Return a number greater than zero."""
    found = number(value, what)
    if found <= 0.0:
        raise MotionError(f"{what} is {value!r}: it must be greater than zero")
    return found


def not_negative(value: Any, what: str) -> float:
    """Return a number of at least zero."""
    found = number(value, what)
    if found < 0.0:
        raise MotionError(f"{what} is {value!r}: it must not be negative")
    return found


def checked_frame(pose: Iterable[Any], what: str) -> Frame:
    """Return position and rotation of a pose within any arm's range."""
    numbers = six(pose, what)
    if max(map(abs, numbers[:3])) > _MAX_DISTANCE_M or max(map(abs, numbers[3:])) > _MAX_ROTVEC_RAD:
        raise MotionError(f"{what} is {numbers}: that is out of any arm's range")
    return frame_of(numbers)
