"""Functions of URScript that need no robot.

Parameter names are those of UR's script manual, since programs may pass arguments by name.
"""

from __future__ import annotations

import math
import random as _random
import re
from collections.abc import Callable
from typing import Any, Final

from ur_emulator.script import pose_arithmetic as poses
from ur_emulator.script.machine import machine_functions
from ur_emulator.script.values import INT_MAX, TEXT_MAX, Builtins, fitting, integer, kind, number, text

_BITS: Final = 32
_SHOWN: Final = 40  # characters of a wrong number
_NUMBER: Final = re.compile(
    r"\s*+(?P<sign>[+-]?)(?:(?P<decimal>\d++)|0x(?P<hexadecimal>[\da-f]++)"
    r"|(?P<float>(?:\d++\.?\d*+|\.\d++)(?:e[+-]?\d++)?)|inf(?:inity)?|nan)",
    re.IGNORECASE | re.ASCII,
)


def library(tick_s: float) -> Builtins:
    """Return all functions that need no robot, by name; `sleep` counts control periods of `tick_s`."""
    return {**_FUNCTIONS, **machine_functions(tick_s)}


def atan2(x: float, y: float) -> float:
    """Arc tangent of x / y, in the quadrant of both."""
    return math.atan2(number(x), number(y))


def pow(base: float, exponent: float) -> float:  # noqa: A001
    """Power, always a float."""
    return math.pow(number(base), number(exponent))


def log(b: float, f: float) -> float:
    """Logarithm of f to the base b."""
    return math.log(number(f), number(b))


def ceil(f: float) -> int:
    """Round up to an integer."""
    return fitting(math.ceil(number(f)))


def floor(f: float) -> int:
    """Round down to an integer."""
    return fitting(math.floor(number(f)))


def d2r(d: float) -> float:
    """Degrees to radians."""
    return math.radians(number(d))


def r2d(r: float) -> float:
    """Radians to degrees."""
    return math.degrees(number(r))


def random() -> float:
    """Return a number from 0 to 1."""
    return _random.random()


def norm(a: float | list[float]) -> float:
    """Absolute value of a number, length of a vector, or norm of all six numbers of a pose."""
    if isinstance(a, list):
        return math.hypot(*map(number, a))
    return abs(number(a))


def length(v: list[Any] | str) -> int:
    """Count the elements of a list, or the characters of a string."""
    if isinstance(v, (list, str)):
        return len(v)
    raise TypeError(f"expected a list or a string, found {kind(v)}")


def get_list_length(v: list[Any]) -> int:
    """Count the elements of a list."""
    return len(_list(v))


def binary_list_to_integer(l: list[bool]) -> int:  # noqa: E741
    """Return the integer of up to 32 bits, lowest bit first."""
    bits = [bool(number(bit)) for bit in _list(l)]
    if len(bits) > _BITS:
        raise ValueError(f"expected at most {_BITS} bits, found {len(bits)}")
    value = sum(1 << index for index, bit in enumerate(bits) if bit)
    return value - (1 << _BITS) if value > INT_MAX else value


def integer_to_binary_list(x: int) -> list[bool]:
    """32 bits of an integer, lowest bit first."""
    value = integer(x)
    return [bool(value >> bit & 1) for bit in range(_BITS)]


def str_at(src: str, index: int) -> str:
    """Return one character of a string."""
    if not 0 <= integer(index) < len(_text(src)):
        raise IndexError(f"the index {index} is outside of 0 to {len(src) - 1}")
    return src[index]


def str_cat(op1: Any, op2: Any) -> str:
    """Concatenate two strings, or other values as `to_str` formats them."""
    return _limited(text(op1) + text(op2))


def str_empty(str: str) -> bool:  # noqa: A002
    """Return True if a string has no characters."""
    return not _text(str)


def str_find(src: str, target: str, start_from: int = 0) -> int:
    """Find `target` in `src` from an index on; -1 if it is not there."""
    if integer(start_from) < 0:
        raise IndexError(f"start_from must be at least 0, found {start_from}")
    return _text(src).find(_text(target), start_from)


def str_len(str: str) -> int:  # noqa: A002
    """Count the characters of a string."""
    return len(_text(str))


def str_sub(src: str, index: int, len: int | None = None) -> str:  # noqa: A002
    """Substring of `len` characters from an index on, or of all that follow."""
    if not 0 <= integer(index) <= str_len(src):
        raise IndexError(f"the index {index} is outside of 0 to {str_len(src)}")
    if len is not None and integer(len) < 0:
        raise IndexError(f"the length must be at least 0, found {len}")
    return src[index:] if len is None else src[index : index + len]


def to_num(str: str) -> float | int:  # noqa: A002
    """Parse a number, a float if it has a decimal point or an exponent."""
    found = _NUMBER.fullmatch(_text(str))
    if found is None:
        raise ValueError(f"this is no number: {str[:_SHOWN]!r}")
    whole = found["decimal"] or found["hexadecimal"]
    if whole is None:
        value = float(str)
        if math.isinf(value) and found["float"]:
            raise OverflowError(f"this number is too large for a float: {str[:_SHOWN]!r}")
        return value
    if len(whole) > _SHOWN:  # of which Python refuses thousands
        raise OverflowError(f"an integer has at most 32 bits: {whole[:_SHOWN]}... is too large")
    return fitting(int(found["sign"] + whole, 10 if found["decimal"] else 16))


def to_str(val: Any) -> str:
    """Format a value."""
    return _limited(text(val))


def _text(value: object) -> str:
    if isinstance(value, str):
        return value
    raise TypeError(f"expected a string, found {kind(value)}")


def _list(value: object) -> list[Any]:
    if isinstance(value, list):
        return value
    raise TypeError(f"expected a list, found {kind(value)}")


def _limited(value: str) -> str:
    if len(value) > TEXT_MAX:
        raise ValueError(f"a string has at most {TEXT_MAX} characters, found {len(value)}")
    return value


def _of_one_number(function: Callable[[float], float]) -> Callable[..., Any]:
    def call(f: float) -> float:
        return function(number(f))

    return call


_FUNCTIONS: Final[Builtins] = {
    name: _of_one_number(getattr(math, name)) for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sqrt")
} | {
    function.__name__: function
    for function in (
        *(atan2, pow, log, ceil, floor, d2r, r2d, random, norm),
        *(length, get_list_length, binary_list_to_integer, integer_to_binary_list),
        *(str_at, str_cat, str_empty, str_find, str_len, str_sub, to_num, to_str),
        *(poses.pose_trans, poses.pose_inv, poses.pose_add, poses.pose_sub, poses.interpolate_pose),
        *(poses.point_dist, poses.rpy2rotvec, poses.rotvec2rpy),
    )
}
