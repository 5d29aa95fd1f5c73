"""Emulated firmware of servo arms on a serial line: bytes in, bytes out, on a time from outside.

It has the buffer, the checks and the watchdog of `dual_ur10.sim2real.serial_arm.protocol`, and no encoders: its
position is what it commands.
"""

from __future__ import annotations

import binascii
from typing import Final

import numpy as np

from dual_ur10.errors import ProtocolError
from dual_ur10.sim2real.serial_arm.protocol import (
    ANSWER,
    CAPACITY,
    STOP_S,
    VERSION,
    WATCHDOG_S,
    FirmwareRefusal,
    FrameScanner,
    Info,
    MotionState,
    Point,
    Request,
    SerialFrame,
    Status,
    encode,
    pack_info,
    pack_status,
    unpack_point,
    unpack_start,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

START_TOLERANCE_RAD: Final = 2e-6
"""Difference of the first point from the commanded position that rounding to microradians explains."""

_GAP_S: Final = 0.02
"""Silence after which an incomplete frame is dropped: nearly twice the duration of the largest one at 57,600 baud."""


class SerialFirmware:
    """Firmware of one or two arms.

    Args:
        arms: Names of its arms, a part of ("left", "right").
        capacity: Points that it holds for each arm.
        device: Number of the device.
        boot: Number of this start.

    Attributes:
        info: Its description.
        state: State of the motion.
        executed: Kinds of the requests that were executed, without repetitions.
    """

    def __init__(
        self, arms: tuple[str, ...] = ("left",), *, capacity: int = CAPACITY, device: int = 1, boot: int = 1
    ) -> None:
        self.info = Info(VERSION, arms, capacity, device, boot)
        self._numbers = [ARMS.index(name) for name in arms]
        self.state = MotionState.IDLE
        self.executed: list[int] = []
        self._scanner = FrameScanner()
        self._points: dict[int, list[Point]] = {number: [] for number in self._numbers}
        self._crc32 = 0
        self._last: tuple[SerialFrame, bytes] | None = None
        self._heard_s = 0.0
        self._begin_s = 0.0
        self._stop: tuple[float, float] | None = None  # time, and time on the path there
        self._by_watchdog = False
        self._q: Array | None = None

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Return the answers to the requests that `data` completes."""
        self.advance(now_s)
        if now_s - self._heard_s > _GAP_S:
            self._scanner.drop()
        self._heard_s = now_s if data else self._heard_s
        answers = b""
        for frame in self._scanner.feed(data):
            self._fed_s = now_s
            answers += self._answer(frame, now_s)
        return answers

    _fed_s = 0.0  # last valid frame

    def advance(self, now_s: float) -> None:
        """Advance the motion to a time."""
        if self.state != MotionState.MOVING:
            return
        if self._stop is None and now_s > self._fed_s + WATCHDOG_S:
            self._begin_stop(self._fed_s + WATCHDOG_S)
            self._by_watchdog = True
        path_s, end_s = self._path_s(now_s), self._points[self._numbers[0]][-1].time_s
        if path_s >= end_s:
            self.state, path_s = MotionState.DONE, end_s
        elif self._stop is not None and now_s >= self._stop[0] + STOP_S:
            self.state = MotionState.STOPPED
        self._elapsed_s = path_s
        self._q = np.array([_hermite(self._points[number], path_s) for number in self._numbers])

    _elapsed_s = 0.0

    @property
    def q_rad(self) -> Array | None:
        """(arms, 6) commanded joint positions; None before the first command since the start."""
        return None if self._q is None else self._q.copy()

    def _path_s(self, now_s: float) -> float:
        """Return the time on the path: it slows down to rest after the beginning of a stop."""
        if self._stop is None:
            return now_s - self._begin_s
        at_s, path_s = self._stop
        passed = min(max(now_s - at_s, 0.0), STOP_S)
        return path_s + passed - passed * passed / (2 * STOP_S)

    def _begin_stop(self, at_s: float) -> None:
        if self._stop is None:
            self._stop = at_s, self._path_s(at_s)

    def _answer(self, frame: SerialFrame, now_s: float) -> bytes:
        if frame.kind == Request.HELLO:
            self._last = None
        if self._last is not None and self._last[0] == frame:
            return self._last[1]
        try:
            refusal, data = self._execute(frame, now_s)
        except ProtocolError:
            refusal, data = FirmwareRefusal.UNKNOWN, b""
        if refusal == FirmwareRefusal.NONE:
            self.executed.append(frame.kind)
        answer = encode(SerialFrame(frame.sequence, frame.kind | ANSWER, bytes([refusal]) + data))
        self._last = frame, answer
        return answer

    def _execute(self, frame: SerialFrame, now_s: float) -> tuple[FirmwareRefusal, bytes]:
        kind, moving = frame.kind, self.state == MotionState.MOVING
        if kind == Request.HELLO:
            return FirmwareRefusal.NONE, pack_info(frame.payload, self.info)
        if kind == Request.STATUS:
            return FirmwareRefusal.NONE, pack_status(self._status())
        if kind == Request.STOP:
            if moving:
                self._begin_stop(now_s)
            return FirmwareRefusal.NONE, b""
        if kind not in (Request.CLEAR, Request.POINT, Request.START):
            return FirmwareRefusal.UNKNOWN, b""
        if moving:
            return FirmwareRefusal.MOVING, b""
        if kind == Request.CLEAR:
            self._crc32 = 0
            for each in self._points.values():
                each.clear()
            return FirmwareRefusal.NONE, b""
        if kind == Request.POINT:
            return self._append(frame.payload), b""
        return self._begin(frame.payload, now_s), b""

    def _append(self, payload: bytes) -> FirmwareRefusal:
        point = unpack_point(payload)
        if point.arm not in self._points:
            return FirmwareRefusal.WRONG_POINT
        points = self._points[point.arm]
        if len(points) >= self.info.capacity:
            return FirmwareRefusal.BUFFER_FULL
        if point.number != len(points) or point.time_s <= (points[-1].time_s if points else -1.0):
            return FirmwareRefusal.WRONG_POINT
        points.append(point)
        self._crc32 = binascii.crc32(payload, self._crc32)
        return FirmwareRefusal.NONE

    def _begin(self, payload: bytes, now_s: float) -> FirmwareRefusal:
        count, crc32 = unpack_start(payload)
        lengths = {len(each) for each in self._points.values()}
        ends = {each[-1].time_s for each in self._points.values() if each}
        if count < 2 or lengths != {count} or crc32 != self._crc32 or len(ends) != 1:
            return FirmwareRefusal.INCOMPLETE
        first = np.array([self._points[number][0].q_rad for number in self._numbers])
        if self._q is not None and np.abs(first - self._q).max() > START_TOLERANCE_RAD:
            return FirmwareRefusal.WRONG_START
        self.state, self._q, self._begin_s = MotionState.MOVING, first, now_s
        self._stop, self._by_watchdog, self._elapsed_s = None, False, 0.0
        return FirmwareRefusal.NONE

    def _status(self) -> Status:
        q = np.zeros((len(self._numbers), 6)) if self._q is None else self._q
        rows = tuple(tuple(each) for each in q.tolist())
        return Status(self.state, self._q is not None, self._elapsed_s, self._by_watchdog, rows)


def _hermite(points: list[Point], time_s: float) -> list[float]:
    """Return the joint positions (6,) on the cubics through points with their speeds."""
    after = next((k for k, each in enumerate(points) if each.time_s > time_s), None)
    if after is None:
        return list(points[-1].q_rad)
    if after == 0:
        return list(points[0].q_rad)
    first, second = points[after - 1], points[after]
    width = second.time_s - first.time_s
    s = (time_s - first.time_s) / width
    a, b = 1 + s * s * (2 * s - 3), s * (1 - s) * (1 - s) * width
    c, d = s * s * (3 - 2 * s), s * s * (s - 1) * width
    return [
        a * q0 + b * v0 + c * q1 + d * v1
        for q0, v0, q1, v1 in zip(first.q_rad, first.qd_rad_s, second.q_rad, second.qd_rad_s, strict=True)
    ]
