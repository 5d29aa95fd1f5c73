"""Frames of RTDE, UR's real-time data exchange: a length, a letter for the kind, and a payload, all big-endian."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import Final

from dual_ur10.errors import ProtocolError

HEADER: Final = struct.Struct(">HB")
"""Size of the frame with its header, and kind."""


class Kind(IntEnum):
    """Kinds of packages: UR's RTDE guide."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    GET_URCONTROL_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA_PACKAGE = ord("U")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class TextKind(IntEnum):
    """How serious a text message is."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFO = 3


LARGEST: Final = 0xFFFF
"""Most bytes of a frame: its length is two bytes."""


class Frames:
    """Cuts a stream of bytes into frames. It keeps less than one frame, so less than 64 KiB.

    Args:
        largest: Most bytes that a frame may have, for whoever knows what can come.
    """

    def __init__(self, largest: int = LARGEST) -> None:
        self.largest = largest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Kind and payload of each frame that `data` completes.

        Raises:
            ProtocolError: A frame claims to be shorter than its header, so that where the next one begins cannot be
                known, or larger than what can come.
        """
        buffer = self._buffer
        buffer += data
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
        del buffer[:start]


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame.

    Args:
        kind: Its letter.
        payload: At most 65532 bytes.
    """
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def split_names(payload: bytes) -> list[str]:
    """The variables in a setup request: separated by commas, after the last of which there may be nothing."""
    return [name for name in payload.decode("latin-1").split(",") if name]


def text_payload(message: str, source: str, kind: int, version: int) -> bytes:
    """Payload of a text message to a client.

    Args:
        message: The text; what does not fit into 255 bytes is cut off.
        source: Who says it; version 1 does not tell.
        kind: How serious it is.
        version: Of the protocol, 1 or 2.
    """
    text = message.encode("utf-8")[:255]
    if version == 1:
        return bytes([kind]) + text
    origin = source.encode("utf-8")[:255]
    return bytes([len(text)]) + text + bytes([len(origin)]) + origin + bytes([kind])
