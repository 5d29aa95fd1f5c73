"""Protocol of servo arms without encoders on a serial line: bytes in, bytes out.

A host asks, and the firmware answers: one request is on its way at a time. A frame is

    A5 5A | length | sequence | kind | payload | CRC-16

with `length` the bytes of the payload, at most `MOST_PAYLOAD`, so that a frame fits the 64 bytes that the UART driver
of an Arduino Mega buffers. The CRC is CRC-16/CCITT (polynomial 1021, initial value FFFF), high byte first, over length,
sequence, kind and payload. All numbers are big-endian. An answer has the sequence of its request and its kind plus
`ANSWER`; its payload begins with a `FirmwareRefusal`, 0 if the request was executed.

A host that gets no answer sends the same frame again. The firmware executes a request with the sequence of the last one
not again: it repeats its answer. `Request.HELLO` begins a new numbering.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple

from dual_ur10.errors import ProtocolError
from ur_core.kinematics.ur10 import ARMS

VERSION: Final = 1
BAUD: Final = 57_600
CAPACITY: Final = 36
"""Points that the buffer of the firmware holds for each arm."""

WATCHDOG_S: Final = 0.5
"""Time without a valid frame after which a moving firmware stops both arms by itself."""

STOP_S: Final = 0.25
"""Duration of a stop: the arms slow down along their path."""

ANSWER: Final = 0x80
MOST_PAYLOAD: Final = 57

_SYNC: Final = b"\xa5\x5a"
_HEAD: Final = struct.Struct(">BBB")  # length, sequence, kind
_CRC: Final = struct.Struct(">H")
_START: Final = struct.Struct(">BI")  # points of each arm, and CRC-32 of their payloads in the order of sending
_INFO: Final = struct.Struct(">BBBII")
_NONCE: Final = struct.Struct(">I")
_STATUS: Final = struct.Struct(">BBIBB")
_POINT: Final = struct.Struct(">BBI6i6i")
_SIX: Final = struct.Struct(">6i")
_MICRO: Final = 1e6

FRAME_BYTES: Final = len(_SYNC) + _HEAD.size + MOST_PAYLOAD + _CRC.size
"""Largest frame."""


class Request(IntEnum):
    """Kinds of requests.

    HELLO: a nonce; answered by it and the description of the firmware. CLEAR: empty the buffer. POINT: append a point.
    START: follow the points in the buffer. STATUS: ask for the status. STOP: slow down along the path, and stay.
    """

    HELLO = 1
    CLEAR = 2
    POINT = 3
    START = 4
    STATUS = 5
    STOP = 6


class FirmwareRefusal(IntEnum):
    """Reason for which a firmware has not executed a request."""

    NONE = 0
    MOVING = 1
    BUFFER_FULL = 2
    WRONG_POINT = 3
    INCOMPLETE = 4
    WRONG_START = 5
    UNKNOWN = 6


class MotionState(IntEnum):
    """State of a firmware. STOPPED: before the end of the points, by a request or by its own watchdog."""

    IDLE = 0
    MOVING = 1
    DONE = 2
    STOPPED = 3


class SerialFrame(NamedTuple):
    """Content of a frame."""

    sequence: int
    kind: int
    payload: bytes


class Info(NamedTuple):
    """Description of a firmware.

    Attributes:
        version: Version of the protocol.
        arms: Names of its arms, a part of ("left", "right").
        capacity: Points that it holds for each arm.
        device: Number of the device, by which the host remembers its last commanded positions.
        boot: Number of its start: another one after each loss of power.
    """

    version: int
    arms: tuple[str, ...]
    capacity: int
    device: int
    boot: int


class Status(NamedTuple):
    """State of a firmware.

    Attributes:
        state: State of the motion.
        known: True if the firmware has commanded a position since it was switched on.
        elapsed_s: Time on the path.
        by_watchdog: True if its own watchdog stopped the motion.
        q_rad: (6,) commanded joint positions of each of its arms. Nothing measures them.
    """

    state: MotionState
    known: bool
    elapsed_s: float
    by_watchdog: bool
    q_rad: tuple[tuple[float, ...], ...]


class Point(NamedTuple):
    """Point of one arm; the path between two is the cubic with their positions and speeds.

    Attributes:
        arm: Index of the arm among "left" and "right".
        number: Number of the point.
        time_s: Time from the start, in whole microseconds on the wire.
        q_rad: (6,) joint positions, in whole microradians on the wire.
        qd_rad_s: (6,) joint speeds, likewise.
    """

    arm: int
    number: int
    time_s: float
    q_rad: tuple[float, ...]
    qd_rad_s: tuple[float, ...]


def crc16(data: bytes) -> int:
    """Return the checksum of a frame."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode(frame: SerialFrame) -> bytes:
    """Return the bytes of a frame."""
    body = _HEAD.pack(len(frame.payload), frame.sequence, frame.kind) + frame.payload
    return _SYNC + body + _CRC.pack(crc16(body))


class FrameScanner:
    """Reader of frames from a line that loses and garbles bytes. It keeps less than one frame.

    Attributes:
        garbled: Number of bytes so far that belonged to no valid frame.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.garbled = 0

    def feed(self, data: bytes) -> Iterator[SerialFrame]:
        """Yield the valid frames that `data` completes. Everything else is skipped."""
        rest = self._rest
        rest += data
        while True:
            begin = rest.find(_SYNC)
            if begin < 0:
                begin = len(rest) - (rest[-1:] == _SYNC[:1])
            self.garbled += begin
            del rest[:begin]
            if len(rest) < len(_SYNC) + _HEAD.size:
                return
            length, sequence, kind = _HEAD.unpack_from(rest, len(_SYNC))
            end = len(_SYNC) + _HEAD.size + length
            if length <= MOST_PAYLOAD and len(rest) < end + _CRC.size:
                return
            if length > MOST_PAYLOAD or crc16(bytes(rest[len(_SYNC) : end])) != _CRC.unpack_from(rest, end)[0]:
                del rest[: len(_SYNC)]  # a frame may begin inside of what looked like one
                self.garbled += len(_SYNC)
                continue
            yield SerialFrame(sequence, kind, bytes(rest[len(_SYNC) + _HEAD.size : end]))
            del rest[: end + _CRC.size]

    def drop(self) -> None:
        """Forget an incomplete frame: its rest was lost."""
        self.garbled += len(self._rest)
        self._rest.clear()


class Client:
    """Host's end of the protocol: one request at a time."""

    def __init__(self) -> None:
        self.scanner = FrameScanner()
        self._sequence = 0
        self._kind = Request.STATUS

    def request(self, kind: Request, payload: bytes = b"") -> bytes:
        """Return the frame of a new request. A retry sends the same bytes."""
        self._sequence = 0 if kind == Request.HELLO else self._sequence % 255 + 1
        self._kind = kind
        return encode(SerialFrame(self._sequence, kind, payload))

    def feed(self, data: bytes) -> bytes | None:
        """Return the answer to the request, or None as long as there is none. Late answers to others are skipped."""
        found = None
        for frame in self.scanner.feed(data):
            if (frame.sequence, frame.kind) == (self._sequence, self._kind | ANSWER) and found is None:
                found = frame.payload
        return found


# Payloads.


def pack_point(point: Point) -> bytes:
    """Return the payload of `Request.POINT`."""
    numbers = (round(each * _MICRO) for each in (*point.q_rad, *point.qd_rad_s))
    return _POINT.pack(point.arm, point.number, round(point.time_s * _MICRO), *numbers)


def unpack_point(payload: bytes) -> Point:
    """Return the point of `Request.POINT`.

    Raises:
        ProtocolError: The payload has another length.
    """
    arm, index, time, *numbers = _unpacked(_POINT, payload)
    values = tuple(each / _MICRO for each in numbers)
    return Point(arm, index, time / _MICRO, values[:6], values[6:])


def pack_start(points: int, crc32: int) -> bytes:
    """Return the payload of `Request.START`."""
    return _START.pack(points, crc32)


def unpack_start(payload: bytes) -> tuple[int, int]:
    """Return the number of points of each arm, and their checksum.

    Raises:
        ProtocolError: The payload has another length.
    """
    points, crc32 = _unpacked(_START, payload)
    return points, crc32


def pack_nonce(nonce: int) -> bytes:
    """Return the payload of `Request.HELLO`."""
    return _NONCE.pack(nonce)


def pack_info(nonce: bytes, info: Info) -> bytes:
    """Return the data of the answer to `Request.HELLO`, which repeats its payload."""
    mask = sum(1 << ARMS.index(name) for name in info.arms)
    return nonce + _INFO.pack(info.version, mask, info.capacity, info.device, info.boot)


def unpack_info(nonce: int, data: bytes) -> Info:
    """Return the description in an answer to `Request.HELLO`.

    Raises:
        ProtocolError: It is the answer to another one, or not valid.
    """
    if data[: _NONCE.size] != pack_nonce(nonce):
        raise ProtocolError("an answer to another HELLO: something else uses the line")
    version, mask, capacity, device, boot = _unpacked(_INFO, data[_NONCE.size :])
    arms = tuple(name for number, name in enumerate(ARMS) if mask >> number & 1)
    if not arms or mask >> len(ARMS) or capacity < 2:
        raise ProtocolError(f"a firmware with the arms {mask:#x} and room for {capacity} points: allowed are 1 or 2")
    return Info(version, arms, capacity, device, boot)


def pack_status(status: Status) -> bytes:
    """Return the data of the answer to `Request.STATUS`."""
    head = _STATUS.pack(
        status.state, status.known, round(status.elapsed_s * _MICRO), status.by_watchdog, len(status.q_rad)
    )
    return head + b"".join(_SIX.pack(*(round(each * _MICRO) for each in row)) for row in status.q_rad)


def unpack_status(data: bytes) -> Status:
    """Return the status in an answer to `Request.STATUS`.

    Raises:
        ProtocolError: It is not valid.
    """
    state, known, elapsed, by_watchdog, arms = _unpacked(_STATUS, data[: _STATUS.size])
    rows = data[_STATUS.size :]
    if len(rows) != arms * _SIX.size or state not in tuple(MotionState):
        raise ProtocolError(f"a status of {len(data)} bytes with state {state}: update the firmware")
    q = tuple(tuple(each / _MICRO for each in row) for row in _SIX.iter_unpack(rows))
    return Status(MotionState(state), bool(known), elapsed / _MICRO, bool(by_watchdog), q)


def _unpacked(form: struct.Struct, payload: bytes) -> tuple[int, ...]:
    if len(payload) != form.size:
        raise ProtocolError(f"a payload of {len(payload)} bytes, expected are {form.size}: update the firmware")
    return form.unpack(payload)
