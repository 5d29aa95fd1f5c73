"""URScript's functions for TCP connections, from a program to other programs on this machine.

Names, defaults, formats and limits: UR's script manual, module "interfaces". A read with a timeout of 0 waits without
limit. A read that fails takes at least one control period, so that a loop of them is no infinite loop.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Generator
from typing import Any, Final, TypeVar

from ur_emulator.builtins.functions import Functions
from ur_emulator.controller.controller import CHARACTERS_PER_STEP, Controller
from ur_emulator.controller.script_sockets import CONNECT_S, ScriptSockets, discard
from ur_emulator.script import Builtins, text
from ur_emulator.script.values import TEXT_MAX, fitting, integer, number

T = TypeVar("T")
Blocking = Generator[None, None, T]

# Names and defaults of the parameters are those of UR's script manual.
# ruff: noqa: A002

_NAME: Final = "socket_0"
_TIMEOUT_S: Final = 2.0
_NUMBERS_MAX: Final = 30
_SEND_S: Final = 2.0  # longest wait for a peer that does not read
_STEPS: Final = 10  # statements that a call counts for
_ESCAPES: Final = {"\\n": "\n", "\\r": "\r", "\\t": "\t", "\\\\": "\\"}


class _Streams:
    """Reads and writes that take as many control periods as the peer needs."""

    def __init__(self, controller: Controller) -> None:
        self._sockets: ScriptSockets = controller.sockets
        self._spend, self._tick_s = controller.spend, controller.profile.tick_s

    def _periods(self, duration_s: float) -> float:
        return math.ceil(duration_s / self._tick_s - 1e-6) if duration_s > 0 else math.inf

    def open(self, address: Any, port: Any, name: str) -> Blocking[bool]:
        self._spend(_STEPS)
        self._sockets.close(name)
        attempt = self._sockets.connect(address, port)
        kept = False
        try:
            left = self._periods(CONNECT_S)
            while not attempt.done() and left > 0:
                left -= 1
                yield
            if attempt.done() and attempt.exception() is None:
                self._sockets.add(name, attempt.result())
                kept = True
        finally:
            if not kept:
                discard(attempt)
        return kept

    def send(self, data: bytes, name: str) -> Blocking[bool]:
        self._spend(_STEPS + len(data) // CHARACTERS_PER_STEP)
        socket = self._sockets.find(name)
        if socket is None:
            return False
        left = self._periods(_SEND_S)
        while not socket.send(data):
            data = b""
            if left <= 0:
                self._sockets.close(name)
                return False
            left -= 1
            yield
        return not socket.ended

    def read(self, take: Callable[[bytearray], T | None], name: str, timeout: Any, failed: T) -> Blocking[T]:
        """Return the first value that `take` finds in the received bytes, or `failed`."""
        left, first = self._periods(number(timeout)), True
        while True:
            self._spend(_STEPS)
            socket = self._sockets.find(name)
            if socket is not None:
                socket.fill()
                found = take(socket.received)
                if found is not None:
                    return found
            if socket is None or socket.ended:
                if first:
                    yield
                return failed
            if left <= 0:
                return failed
            left, first = left - 1, False
            yield


class _SocketFunctions(Functions):
    """Functions for connections."""

    def __init__(self, controller: Controller) -> None:
        super().__init__(controller)
        self._streams = _Streams(controller)

    def socket_open(self, address: Any, port: Any, socket_name: str = _NAME) -> Blocking[bool]:
        return (yield from self._streams.open(address, port, socket_name))

    def socket_close(self, socket_name: str = _NAME) -> None:
        self._controller.sockets.close(socket_name)

    def socket_read_binary_integer(
        self, number: int, socket_name: str = _NAME, timeout: float = _TIMEOUT_S
    ) -> Blocking[list[Any]]:
        count = _count(number)

        def take(data: bytearray) -> list[Any] | None:
            return None if len(data) < 4 * count else [count, *struct.unpack(f">{count}i", _pop(data, 4 * count))]

        return (yield from self._streams.read(take, socket_name, timeout, [0, *[-1] * count]))

    def socket_read_byte_list(
        self, number: int, socket_name: str = _NAME, timeout: float = _TIMEOUT_S
    ) -> Blocking[list[Any]]:
        count = _count(number)

        def take(data: bytearray) -> list[Any] | None:
            return None if len(data) < count else [count, *_pop(data, count)]

        return (yield from self._streams.read(take, socket_name, timeout, [0, *[-1] * count]))

    def socket_read_ascii_float(
        self, number: int, socket_name: str = _NAME, timeout: float = _TIMEOUT_S
    ) -> Blocking[list[Any]]:
        count = _count(number)
        failed = [0, *[math.nan] * count]

        def take(data: bytearray) -> list[Any] | None:
            end = data.find(b")")
            if end < 0:
                return None
            body = _pop(data, end + 1).decode("latin-1").partition("(")[2].rstrip(")")
            try:
                found = [float(each) for each in body.split(",")][:count]
            except ValueError:
                return failed
            return [len(found), *found, *[math.nan] * (count - len(found))]

        return (yield from self._streams.read(take, socket_name, timeout, failed))

    def socket_read_line(self, socket_name: str = _NAME, timeout: float = _TIMEOUT_S) -> Blocking[str]:
        return (yield from self._streams.read(_line, socket_name, timeout, ""))

    def socket_read_string(
        self,
        socket_name: str = _NAME,
        prefix: str = "",
        suffix: str = "",
        interpret_escape: bool = False,
        timeout: float = _TIMEOUT_S,
    ) -> Blocking[str]:
        start, end = (_bytes(_unescaped(each) if interpret_escape else each) for each in (prefix, suffix))

        def take(data: bytearray) -> str | None:
            first = data.find(start)
            first = first + len(start) if first >= 0 else len(data)
            last = data.find(end, first) if end else len(data)
            if last <= first and not (end and last == first):
                return None
            found = bytes(data[first : min(last, first + TEXT_MAX) if not end else last])
            del data[: first + len(found) + len(end)]
            return _limited(found)

        return (yield from self._streams.read(take, socket_name, timeout, ""))

    def socket_get_var(self, name: str, socket_name: str = _NAME) -> Blocking[int]:
        if not (yield from self._streams.send(_bytes(f"GET {name}\n"), socket_name)):
            yield
            return 0
        line = yield from self._streams.read(_line, socket_name, _TIMEOUT_S, "")
        found = re.fullmatch(rf"{re.escape(name)}\s+([+-]?\d{{1,10}})\s*", line)
        return 0 if found is None else fitting(int(found[1]))

    def socket_set_var(self, name: str, value: int, socket_name: str = _NAME) -> Blocking[None]:
        yield from self._streams.send(_bytes(f"SET {name} {integer(value)}\n"), socket_name)

    def socket_send_byte(self, value: int, socket_name: str = _NAME) -> Blocking[bool]:
        return (yield from self._streams.send(bytes([_byte(value)]), socket_name))

    def socket_send_int(self, value: int, socket_name: str = _NAME) -> Blocking[bool]:
        return (yield from self._streams.send(struct.pack(">i", integer(value)), socket_name))

    def socket_send_line(self, str: Any, socket_name: str = _NAME) -> Blocking[bool]:
        return (yield from self._streams.send(_bytes(text(str)) + b"\n", socket_name))

    def socket_send_string(self, str: Any, socket_name: str = _NAME) -> Blocking[bool]:
        return (yield from self._streams.send(_bytes(text(str)), socket_name))


def socket_builtins(controller: Controller) -> Builtins:
    """Return the functions by name."""
    return _SocketFunctions(controller).by_name()


def _count(number: Any) -> int:
    if not 1 <= integer(number) <= _NUMBERS_MAX:
        raise ValueError(f"a socket is read for 1 to {_NUMBERS_MAX} numbers at once, found {number}")
    return int(number)


def _pop(data: bytearray, count: int) -> bytes:
    found = bytes(data[:count])
    del data[:count]
    return found


def _line(data: bytearray) -> str | None:
    end = data.find(b"\n")
    return None if end < 0 else _limited(_pop(data, end + 1).rstrip(b"\r\n"))


def _limited(found: bytes) -> str:
    if len(found) > TEXT_MAX:
        raise ValueError(f"a string has at most {TEXT_MAX} characters, received {len(found)}")
    return found.decode("latin-1")


def _bytes(value: str) -> bytes:
    return value.encode("latin-1", "replace")


def _unescaped(value: str) -> str:
    return re.sub(r"\\[nrt\\]", lambda found: _ESCAPES[found[0]], value)


def _byte(value: Any) -> int:
    if not -128 <= integer(value) <= 255:
        raise ValueError(f"a byte is -128 to 255, found {value}")
    return int(value) & 0xFF
