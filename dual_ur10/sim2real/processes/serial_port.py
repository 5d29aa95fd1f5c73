"""Serial port of this machine as a transport of bytes."""

from __future__ import annotations

import contextlib
from typing import Any

from dual_ur10.errors import LinkError, MissingExtraError


class SerialTransport:
    """Open serial port, a `dual_ur10.sim2real.processes.transport.Transport`. No other program can open it meanwhile.

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
