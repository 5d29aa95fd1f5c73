"""Values of URScript: numbers, True and False, strings, lists, poses.

Lists and poses are values: an assignment copies them. Here no list is ever changed in place; an assignment to an
element makes a new one. So a builtin must change neither a list that it received nor one that it returned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, TypeVar

Number = TypeVar("Number", int, float)

Builtins = dict[str, Callable[..., Any]]
"""Functions that programs may call, by name. A generator function blocks its thread until it ends."""


class VersionBuiltins(Builtins):
    """Functions of one version of a controller.

    Args:
        functions: Functions by name.
        absent: Reason why the version lacks a function, by name.
    """

    def __init__(self, functions: Builtins, absent: Mapping[str, str]) -> None:
        super().__init__(functions)
        self.absent = absent


INT_MAX: Final = 2**31 - 1
"""Largest integer of 32 bits."""

POSE_LENGTH: Final = 6

LIST_MAX: Final = 512
"""Most elements of a list, or of all rows of a matrix together."""

TEXT_MAX: Final = 1023
"""Most characters of a string made by a program (UR's script manual)."""


class Pose(list[float]):
    """Pose p[x, y, z, rx, ry, rz] in m and rad: a position and a rotation vector.

    Raises:
        ValueError: It does not have six elements.
        TypeError: An element is no number.
    """

    __slots__ = ()

    def __init__(self, elements: Iterable[float]) -> None:
        super().__init__(elements)
        if len(self) != POSE_LENGTH:
            raise ValueError(f"a pose has 6 numbers, found {len(self)}")
        for index, element in enumerate(self):
            if element.__class__ is not float:
                self[index] = float(number(element))


def kind(value: object) -> str:
    """Name the kind of a value, for messages."""
    names = {bool: "a boolean", int: "an integer", float: "a float", str: "a string", list: "a list", Pose: "a pose"}
    return "nothing" if value is None else names.get(type(value), f"a {type(value).__name__}")


def number(value: object) -> float:
    """Return the value if it is a number.

    Raises:
        TypeError: It is none.
    """
    if isinstance(value, (int, float)):
        return value
    raise TypeError(f"expected a number, found {kind(value)}")


def integer(value: object) -> int:
    """Return the value if it is an integer.

    Raises:
        TypeError: It is none.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    raise TypeError(f"expected an integer, found {kind(value)}")


def fitting(value: Number) -> Number:
    """Return a number, unless it is an integer of more than 32 bits.

    Raises:
        OverflowError: It is one.
    """
    if isinstance(value, int) and not -INT_MAX - 1 <= value <= INT_MAX:
        raise OverflowError(f"an integer has at most 32 bits: {value} is too large (floats, like 1.0, are not limited)")
    return value


def text(value: object) -> str:
    """Format a value as `textmsg` and `to_str` do: floats with at most six decimals (UR's script manual)."""
    if isinstance(value, list):
        return f"{'p' if isinstance(value, Pose) else ''}[{', '.join(map(text, value))}]"
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.6f}".rstrip("0").rstrip(".")
    return str(value)
