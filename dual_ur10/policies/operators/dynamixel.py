"""Dynamixel protocol 2.0, as far as reading the positions of a chain of servos needs it; without I/O."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

POSITION: Final = 132
"""Address of the present position of X-series servos: 4 bytes, signed."""

POSITION_BYTES: Final = 4

COUNTS_PER_TURN: Final = 4096

SYNC_READ: Final = 0x82
STATUS: Final = 0x55
BROADCAST: Final = 0xFE
ERROR_MASK: Final = 0x7F  # the highest bit is an alert of the servo, which still answers

_HEADER: Final = b"\xff\xff\xfd\x00"
_BEFORE_LENGTH: Final = 5
_FRAME: Final = 7  # header, id and length
_MOST_BYTES: Final = 256  # of a packet that is believed


def _table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
        table.append(value)
    return table


_TABLE: Final = _table()


def crc(data: bytes) -> int:
    """Return the checksum of a packet: polynomial 0x8005, from 0, highest bit first."""
    value = 0
    for byte in data:
        value = (value << 8 ^ _TABLE[(value >> 8 ^ byte) & 0xFF]) & 0xFFFF
    return value


def packet(servo: int, instruction: int, body: bytes) -> bytes:
    """Return a packet to or from a servo."""
    stuffed = body.replace(_HEADER[:3], _HEADER[:3] + _HEADER[2:3])
    head = _HEADER + struct.pack("<BHB", servo, len(stuffed) + 3, instruction) + stuffed
    return head + struct.pack("<H", crc(head))


def position_request(servos: Sequence[int]) -> bytes:
    """Return the request of the positions of some servos, which answer one after another."""
    return packet(BROADCAST, SYNC_READ, struct.pack("<HH", POSITION, POSITION_BYTES) + bytes(servos))


class Answer(NamedTuple):
    """Answer of a servo.

    Attributes:
        servo: Its id.
        error: Error that it reports; 0: none.
        body: Data.
    """

    servo: int
    error: int
    body: bytes


class Scanner:
    """Scanner of received bytes for the answers of servos.

    Attributes:
        garbled: Number of bytes that belong to no valid packet.
    """

    def __init__(self) -> None:
        self.garbled = 0
        self._data = bytearray()

    def drop(self) -> None:
        """Forget an unfinished packet."""
        self._data.clear()

    def feed(self, data: bytes) -> list[Answer]:
        """Return the answers that these bytes complete. Packets of others, such as an echo, are left out."""
        self._data += data
        found: list[Answer] = []
        while True:
            start = self._data.find(_HEADER)
            if start < 0:
                keep = min(len(self._data), len(_HEADER) - 1)
                self._skip(len(self._data) - keep)
                return found
            self._skip(start)
            if len(self._data) < _FRAME:
                return found
            size = _FRAME + int.from_bytes(self._data[_BEFORE_LENGTH:_FRAME], "little")
            if not _FRAME + 3 <= size <= _MOST_BYTES:
                self._skip(len(_HEADER))
                continue
            if len(self._data) < size:
                return found
            whole = bytes(self._data[:size])
            if crc(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
                self._skip(len(_HEADER))
                continue
            del self._data[:size]
            if whole[_FRAME] == STATUS and size >= _FRAME + 4:
                body = whole[_FRAME + 2 : -2].replace(_HEADER[:3] + _HEADER[2:3], _HEADER[:3])
                found.append(Answer(whole[4], whole[_FRAME + 1], body))

    def _skip(self, count: int) -> None:
        self.garbled += count
        del self._data[:count]
