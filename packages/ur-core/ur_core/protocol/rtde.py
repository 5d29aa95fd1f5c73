"""Wire format of RTDE, UR's real-time data exchange: frames, kinds of packages, and data types of variables.

A frame is a length, a letter for its kind and a payload. All numbers are big-endian, and vectors have no length.
Source: UR's RTDE guide.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from ur_core.errors import ProtocolError, SettingsError

HEADER: Final = struct.Struct(">HB")
"""Header of a frame: size of the whole frame, and kind."""

LARGEST: Final = 0xFFFF
"""Largest frame, bytes: its length has two bytes."""

Value = float | int | tuple[float, ...] | tuple[int, ...]
"""Value of a variable in this program."""


class Kind(IntEnum):
    """Kinds of packages."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    GET_URCONTROL_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA_PACKAGE = ord("U")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class TextKind(IntEnum):
    """Severity of a text message."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFO = 3


class FrameReader:
    """Reader of frames from a byte stream. It keeps less than one frame, so less than 64 KiB.

    Args:
        largest: Largest frame to accept, bytes.
    """

    def __init__(self, largest: int = LARGEST) -> None:
        self.largest = largest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield kind and payload of each frame that `data` completes.

        Raises:
            ProtocolError: A frame claims to be shorter than its header, so that the start of the next one is unknown,
                or larger than `largest`.
        """
        rest = self._buffer
        if rest:
            rest += data
        buffer = rest or data  # nearly always whole frames, which need no copy
        start, available = 0, len(buffer)
        while available - start >= HEADER.size:
            size, kind = HEADER.unpack_from(buffer, start)
            if size < HEADER.size:
                raise ProtocolError(f"RTDE frame of {size} bytes: it must have at least {HEADER.size}, its header")
            if size > self.largest:
                raise ProtocolError(f"RTDE frame of {size} bytes: at most {self.largest} can come here")
            end = start + size
            if end > available:
                break
            yield kind, bytes(buffer[start + HEADER.size : end])
            start = end
        # Once per call, not once per frame: many small frames in one piece stay cheap.
        if rest:
            del rest[:start]
        else:
            rest += data[start:]


def frame(kind: int, payload: bytes = b"") -> bytes:
    """Return a frame.

    Args:
        kind: Letter of its kind.
        payload: At most 65532 bytes.
    """
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def split_names(payload: bytes) -> list[str]:
    """Return the variables of a setup request. They are separated by commas; a trailing comma is allowed."""
    return [name for name in payload.decode("latin-1").split(",") if name]


def text_payload(message: str, source: str, kind: int, version: int) -> bytes:
    """Return the payload of a text message to a client.

    Args:
        message: Text, cut off after 255 bytes.
        source: Sender; version 1 of the protocol does not report it.
        kind: Severity.
        version: Version of the protocol, 1 or 2.
    """
    text = message.encode("utf-8")[:255]
    if version == 1:
        return bytes([kind]) + text
    origin = source.encode("utf-8")[:255]
    return bytes([len(text)]) + text + bytes([len(origin)]) + origin + bytes([kind])


@dataclass(frozen=True)
class DataType:
    """Data type of a variable.

    Attributes:
        name: Name in RTDE's replies.
        code: Format of one element, as in the module `struct`.
        count: Number of elements: 1, or 3 or 6 in vectors.
    """

    name: str
    code: str
    count: int = 1

    @property
    def zero(self) -> Value:
        """Zero of this type."""
        one: Value = 0.0 if self.code == "d" else False if self.code == "?" else 0
        return one if self.count == 1 else (one,) * self.count  # type: ignore[return-value]

    def fit(self, name: str, value: Any) -> list[float | int]:
        """Return the elements of a value in this type. Integers lose excess bits, and are 0 where there is no number.

        Args:
            name: Name of the variable, for the message.
            value: A number, or `count` of them.

        Raises:
            SettingsError: It is not a number, or not `count` of them.
        """
        try:
            elements = list(value) if self.count > 1 else [value]
            if len(elements) == self.count:
                return [_fit(self.code, element) for element in elements]
        except (TypeError, ValueError):
            pass
        raise SettingsError(
            f"value of {name} is {value!r}: it must be {self.count} number(s), to be sent as {self.name}"
        )


def _fit(code: str, value: Any) -> float | int:
    if code == "?":
        return bool(value)
    if code == "d":
        try:
            return float(value)
        except OverflowError:
            return math.inf if value > 0 else -math.inf
    if isinstance(value, float) and not math.isfinite(value):
        return 0
    bits = {"B": 8, "I": 32, "i": 32, "Q": 64}[code]
    masked = int(value) & ((1 << bits) - 1)
    return masked - (1 << bits) if code == "i" and masked >> (bits - 1) else masked


TYPES: Final = {
    kind.name: kind
    for kind in (
        DataType("BOOL", "?"),
        DataType("UINT8", "B"),
        DataType("UINT32", "I"),
        DataType("UINT64", "Q"),
        DataType("INT32", "i"),
        DataType("DOUBLE", "d"),
        DataType("VECTOR3D", "d", 3),
        DataType("VECTOR6D", "d", 6),
        DataType("VECTOR6INT32", "i", 6),
        DataType("VECTOR6UINT32", "I", 6),
    )
}
"""Data types by name."""
