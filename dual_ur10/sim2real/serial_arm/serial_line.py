"""Line to the firmware of servo arms: the port, and requests with retries, each with a deadline."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Final, TypeVar

from dual_ur10.errors import LinkError, MissingExtraError, OperationRefusedError, ProtocolError
from dual_ur10.sim2real.serial_arm.protocol import (
    BAUD,
    FRAME_BYTES,
    VERSION,
    Client,
    FirmwareRefusal,
    Info,
    Request,
    Status,
    pack_nonce,
    unpack_info,
    unpack_status,
)
from ur_core.processes.clock import Clock
from ur_core.processes.transport import Transport
from ur_core.types import Closing

ANSWER_S: Final = 2 * FRAME_BYTES * 10 / BAUD + 0.03
"""Time limit of one try: the largest frame both ways, with 10 bits per byte, and the delays of a USB adapter."""

TRIES: Final = 5
"""Tries of one request: all of them take less than the watchdog of the firmware."""

T = TypeVar("T")

_BOOT_S: Final = 3.0  # some boards restart when their port is opened
_RECEIVE_BYTES: Final = 4096
_REASONS: Final = {
    FirmwareRefusal.MOVING: "the arms move",
    FirmwareRefusal.BUFFER_FULL: "its buffer is full",
    FirmwareRefusal.WRONG_POINT: "a point has the wrong arm, number or time",
    FirmwareRefusal.INCOMPLETE: "not all points have arrived",
    FirmwareRefusal.WRONG_START: "the first point is not where the arms stand",
    FirmwareRefusal.UNKNOWN: "it does not know this request",
}


class SerialLine(Closing):
    """Requests to one firmware, one after the other.

    Args:
        transport: The line, which this object owns.
        clock: Clock of the transport.
        where: Name of the port, for messages.
    """

    def __init__(self, transport: Transport, clock: Clock, where: str) -> None:
        self._transport, self._clock, self._where = transport, clock, where
        self._client = Client()

    def hello(self, nonce: int) -> Info:
        """Return the description of the firmware, once it has started.

        Args:
            nonce: Number of 32 bits that no earlier program on this line has used.

        Raises:
            LinkError: There is no such firmware at the port, or it speaks another version.
        """
        tries = round(_BOOT_S / ANSWER_S)
        info = self._unpacked(lambda data: unpack_info(nonce, data), self.ask(Request.HELLO, pack_nonce(nonce), tries))
        if info.version != VERSION:
            raise LinkError(
                f"{self._where}: the firmware speaks version {info.version} of the protocol, this program {VERSION}: "
                "update the older one"
            )
        return info

    def status(self) -> Status:
        """Return the status.

        Raises:
            LinkError: There is no answer.
        """
        return self._unpacked(unpack_status, self.ask(Request.STATUS))

    def ask(self, kind: Request, payload: bytes = b"", tries: int = TRIES) -> bytes:
        """Send a request until it is answered, and return the data of the answer.

        Raises:
            LinkError: There is no valid answer to any try, or the line was unplugged.
            OperationRefusedError: The firmware refuses it.
        """
        frame = self._client.request(kind, payload)
        garbled = self._client.scanner.garbled
        try:
            for _ in range(tries):
                deadline_s = self._clock.now_s() + ANSWER_S
                self._send(frame, deadline_s)
                answer = self._wait(deadline_s)
                if answer is not None:
                    return self._checked(kind, answer)
        except OSError as error:
            if isinstance(error, LinkError):
                raise
            raise LinkError(f"{self._where}: the line broke ({error}): check the cable") from error
        strange = self._client.scanner.garbled - garbled
        raise LinkError(
            f"{self._where}: no valid answer to {kind.name} in {tries} tries, and {strange} bytes that are no frame: "
            f"check that the device has the firmware of this protocol at {BAUD} baud, its power, and the cable"
        )

    def _send(self, frame: bytes, deadline_s: float) -> None:
        left = memoryview(frame)
        while left and self._clock.now_s() < deadline_s:
            left = left[self._transport.send_now(left) :]
            if left:
                self._clock.wait((), deadline_s, (self._transport.fileno(),))

    def _wait(self, deadline_s: float) -> bytes | None:
        """Return the answer, or None at the deadline."""
        while True:
            data = self._transport.receive_now(_RECEIVE_BYTES)
            if data == b"":
                raise LinkError(f"{self._where}: the line was unplugged: check the cable")
            answer = None if data is None else self._client.feed(data)
            if answer is not None:
                return answer
            if self._clock.now_s() >= deadline_s:
                self._client.scanner.drop()
                return None
            self._clock.wait((self._transport.fileno(),), deadline_s)

    def _checked(self, kind: Request, answer: bytes) -> bytes:
        refusal = answer[0] if answer else FirmwareRefusal.UNKNOWN
        if refusal != FirmwareRefusal.NONE:
            reason = _REASONS.get(FirmwareRefusal(refusal)) if refusal in tuple(FirmwareRefusal) else None
            raise OperationRefusedError(
                f"{self._where}: the firmware refuses {kind.name}: {reason or f'reason {refusal}'}"
            )
        return answer[1:]

    def _unpacked(self, unpack: Callable[[bytes], T], data: bytes) -> T:
        try:
            return unpack(data)
        except ProtocolError as error:
            raise LinkError(f"{self._where}: {error}") from error

    def close(self) -> None:
        """Release the line. May be called twice."""
        self._transport.close()


class SerialTransport:
    """Open serial port, a `ur_core.processes.transport.Transport`. No other program can open it meanwhile.

    Args:
        port: Name of the port, such as /dev/ttyACM0.
        baud: Bits per second.

    Raises:
        MissingExtraError: pyserial is not installed.
        LinkError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int) -> None:
        try:
            import serial
            from serial.tools import list_ports
        except ImportError:
            raise MissingExtraError("pyserial", "serial", "an arm on a serial line") from None
        try:
            self._port: Any = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            found = ", ".join(sorted(each.device for each in list_ports.comports())) or "none"
            raise LinkError(
                f"serial port {port} cannot be opened ({error}): ports of this machine are {found}. Check the cable, "
                "the name, and the rights on the device (group dialout)"
            ) from error

    def fileno(self) -> int:
        """See `Transport`."""
        return int(self._port.fileno())

    def send_now(self, data: bytes | bytearray | memoryview) -> int:
        """See `Transport`."""
        return int(self._port.write(data))

    def receive_now(self, size: int) -> bytes | None:
        """See `Transport`. A port that was unplugged raises an error; it has no other end of the stream."""
        return self._port.read(size) or None

    def end_sending(self) -> None:
        """Do nothing: a line has no end."""

    def close(self, *, reset: bool = False) -> None:
        """See `Transport`."""
        with contextlib.suppress(OSError):  # it was unplugged
            self._port.close()
