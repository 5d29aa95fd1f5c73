"""Messages of openpi's WebSocket protocol: msgpack with arrays of numbers, and nothing that runs code."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec
import numpy as np

from dual_ur10.errors import PolicyServerError

MOST_BYTES: Final = 64 * 1024 * 1024
"""Largest message: twenty images of 1 megapixel."""

DTYPES: Final = frozenset({"|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f2", "<f4", "<f8"})
"""Types of arrays that are read and written."""

MOST_VALUES: Final = 1 << 18
"""Most values in a message, where an array is one: each takes up to a hundred times its bytes once it is read."""

_MOST_AXES, _DEEPEST = 5, 8

_SIZED: Final = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xC7: 1, 0xC8: 2, 0xC9: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
"""Bytes of the length of binaries, extensions and texts, by the first byte of msgpack."""

_FIXED: Final = {
    0xCA: 4,
    0xCB: 8,
    0xCC: 1,
    0xCD: 2,
    0xCE: 4,
    0xCF: 8,
    0xD0: 1,
    0xD1: 2,
    0xD2: 4,
    0xD3: 8,
    0xD4: 2,
    0xD5: 3,
    0xD6: 5,
    0xD7: 9,
    0xD8: 17,
}
"""Bytes of numbers and short extensions, likewise."""

_COUNTED: Final = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
"""Bytes of the count of lists and dicts, and values for each, likewise."""


def packed(value: Any) -> bytes:
    """Return a message of nested dicts, lists, texts, numbers and arrays.

    Raises:
        PolicyServerError: It holds something else.
    """
    try:
        return msgspec.msgpack.encode(_written(value, 0))
    except (TypeError, ValueError, OverflowError) as error:
        raise PolicyServerError(f"this cannot be sent: {error}") from None


def unpacked(message: bytes, whose: str) -> Any:
    """Return the content of a message.

    Args:
        message: As received.
        whose: Name of the sender, for messages.

    Raises:
        PolicyServerError: It is not msgpack, has too many values, or holds arrays of another type or shape than it
            states.
    """
    if _has_many_values(message):
        raise PolicyServerError(f"{whose} sent more than {MOST_VALUES} values: send numbers as arrays")
    try:
        found = msgspec.msgpack.decode(message)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise PolicyServerError(f"{whose} sent {len(message)} bytes that are no msgpack: {error}") from None
    return _read(found, 0, whose)


def _has_many_values(message: bytes) -> bool:
    """Return True if a message announces more than `MOST_VALUES`. One that is cut off is the decoder's to refuse."""
    at, end, left, found = 0, len(message), 1, 0
    while left and at < end:
        first, at, left, found = message[at], at + 1, left - 1, found + 1
        if 0x80 <= first < 0xA0:
            left += (first & 0x0F) * (1 if first >= 0x90 else 2)
        elif 0xA0 <= first < 0xC0:
            at += first & 0x1F
        elif size := _SIZED.get(first):
            at += size + int.from_bytes(message[at : at + size]) + (0xC7 <= first <= 0xC9)
        elif counted := _COUNTED.get(first):
            size, each = counted
            left, at = left + each * int.from_bytes(message[at : at + size]), at + size
        else:
            at += _FIXED.get(first, 0)
        if found + left > MOST_VALUES:
            return True
    return False


def _written(value: Any, depth: int) -> Any:
    if depth > _DEEPEST:
        raise TypeError(f"more than {_DEEPEST} levels")
    if isinstance(value, Mapping):
        return {key: _written(each, depth + 1) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_written(each, depth + 1) for each in value]
    if isinstance(value, np.ndarray):
        array = value.astype(value.dtype.newbyteorder("<"), order="C", copy=False)
        if array.dtype.str not in DTYPES:
            raise TypeError(f"an array of {value.dtype}")
        return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}
    if isinstance(value, np.generic):
        return value.item()
    return value


def _read(value: Any, depth: int, whose: str) -> Any:
    if depth > _DEEPEST:
        raise PolicyServerError(f"{whose} sent more than {_DEEPEST} levels of lists and dicts")
    if isinstance(value, list):
        return [_read(each, depth + 1, whose) for each in value]
    if not isinstance(value, dict):
        return value
    if b"__ndarray__" in value:
        return _array(value, whose)
    if b"__npgeneric__" in value:
        number = value.get(b"data")
        if not isinstance(number, int | float):
            raise PolicyServerError(f"{whose} sent a number that is {type(number).__name__}")
        return number
    return {key: _read(each, depth + 1, whose) for key, each in value.items()}


def _array(value: dict[Any, Any], whose: str) -> Any:
    """Return the array that a dict describes."""
    data, dtype, shape = (value.get(key) for key in (b"data", b"dtype", b"shape"))
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise PolicyServerError(f"{whose} sent an array of {dtype!r:.40}: read are {', '.join(sorted(DTYPES))}")
    axes = shape if isinstance(shape, list) else [None]
    if len(axes) > _MOST_AXES or not all(type(n) is int and n >= 0 for n in axes):
        raise PolicyServerError(f"{whose} sent an array of shape {shape!r:.80}: at most {_MOST_AXES} axes are read")
    kind = np.dtype(dtype)
    if not isinstance(data, bytes) or len(data) != math.prod(axes) * kind.itemsize:
        size = len(data) if isinstance(data, bytes) else type(data).__name__
        raise PolicyServerError(f"{whose} sent an array of {dtype} and shape {shape}, but {size} bytes of it")
    try:
        return np.frombuffer(bytearray(data), dtype=kind).reshape(axes)  # a policy may write into its observation
    except ValueError as error:  # of no numbers, beside an axis of any length
        raise PolicyServerError(f"{whose} sent an array of shape {shape!r:.80}: {error}") from None
