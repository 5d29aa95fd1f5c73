"""Leader arms: small copies of the arms with Dynamixel servos in their joints, such as GELLO."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.errors import (
    DeviceAbsentError,
    DeviceError,
    DeviceGarbageError,
    DeviceSharedError,
    DeviceSilentError,
    MissingExtraError,
    SettingsError,
)
from dual_ur10.policies.operators.device import LOST_S, Reading
from dual_ur10.policies.operators.dynamixel import (
    COUNTS_PER_TURN,
    ERROR_MASK,
    POSITION_BYTES,
    Scanner,
    position_request,
)
from dual_ur10.policies.operators.hands import denied, paths_of, unplugged
from ur_core.types import Array

UDEV_RULE: Final = 'SUBSYSTEM=="tty", ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014", MODE="0660", TAG+="uaccess"'
"""Rule of udev that permits the person at the screen to open the U2D2 adapter of a leader."""

BAUD: Final = 57_600
"""Rate at which Dynamixel servos are delivered."""

SIGNS: Final = (1.0, 1.0, -1.0, 1.0, 1.0, 1.0)
"""Directions of the joints of a GELLO for a UR, against those of the arm."""

_JOINTS: Final = 6
_FIRST_S: Final = 0.5  # within which the first positions must come
_WAIT_S: Final = 0.006  # for answers in each reading: a chain at 1 Mbaud needs 3 ms
_AGAIN_S: Final = 0.05  # after which a request counts as lost
_PAUSE_S: Final = LOST_S / 2  # between two readings, in which nothing was asked for: no silence of a chain
_READ_BYTES: Final = 4096


class _Chain:
    """Servos of one leader.

    Attributes:
        position_rad: Newest position of each servo; None: none so far.
        asked_s: Time at which they were asked for.
    """

    def __init__(self, path: str, name: str, baud: int, servos: Sequence[int], clock: Callable[[], float]) -> None:
        self.name, self._servos, self._clock = name, list(servos), clock
        self._port = _open(path, name, baud)
        self._file = int(self._port.fileno())
        self._scanner = Scanner()
        self._answers: dict[int, int] = {}
        self._sent_s: float | None = None
        self.position_rad: Array | None = None
        self.asked_s = clock()

    def ask(self) -> None:
        """Ask for the positions, unless answers are under way."""
        now = self._clock()
        if self._sent_s is not None and now - self._sent_s < _AGAIN_S:
            return
        try:
            while self._receive():  # late answers are no longer wanted
                pass
            self._scanner.drop()
            self._answers.clear()
            os.write(self._file, position_request(self._servos))
        except BlockingIOError:
            return  # nobody takes what was sent before
        except OSError as error:
            unplugged(self.name, error)
        self._sent_s = now

    def collect(self, wait_s: float) -> None:
        """Take in the answers, for which it waits at most so long."""
        until = time.monotonic() + wait_s
        while self._sent_s is not None:
            data = self._receive()
            for answer in self._scanner.feed(data):
                if answer.error & ERROR_MASK or len(answer.body) != POSITION_BYTES:
                    raise DeviceGarbageError(
                        f"{self.name}: servo {answer.servo} answers with error {answer.error & ERROR_MASK} and "
                        f"{len(answer.body)} bytes: is it a Dynamixel of the X series?"
                    )
                self._answers[answer.servo] = int.from_bytes(answer.body, "little", signed=True)
            if all(each in self._answers for each in self._servos):
                counts = np.array([self._answers[each] for each in self._servos], dtype=np.float64)
                self.position_rad, self.asked_s = counts * (2.0 * math.pi / COUNTS_PER_TURN), self._sent_s
                self._answers.clear()
                self._sent_s, self._scanner.garbled = None, 0
            elif not data:
                left = until - time.monotonic()
                if left <= 0.0 or not select.select([self._file], [], [], left)[0]:
                    return

    def lacking(self) -> DeviceError:
        """Return the error of a chain that gives no positions."""
        missing = [each for each in self._servos if each not in self._answers]
        if self._scanner.garbled:
            return DeviceGarbageError(
                f"{self.name}: {self._scanner.garbled} bytes were no valid packets of Dynamixel protocol 2.0: check "
                "the baud rate, the cable, and that nothing else talks on this line"
            )
        return DeviceSilentError(
            f"{self.name}: no answer of the servos {', '.join(map(str, missing))}: check their power, the cable, their "
            "ids and the baud rate"
        )

    def _receive(self) -> bytes:
        """Return what has arrived; b"" if nothing has."""
        # Asked before: a line at rest, too, gives b"" to those that read it.
        if not select.select([self._file], [], [], 0.0)[0]:
            return b""
        try:
            data = os.read(self._file, _READ_BYTES)
        except OSError as error:
            unplugged(self.name, error)
        if not data:
            unplugged(self.name)
        return data

    def close(self) -> None:
        """Release the line. May be called twice."""
        with contextlib.suppress(OSError):
            self._port.close()


class Leader:
    """Leader arm for one hand, or two, one for each hand, which the arms follow joint for joint.

    Servos 1 to 6 of a leader are its joints from the base on. A joint of the arm is `sign * (position - offset)`, the
    position of its servo from 0 to 2 pi. Servo 7 is the trigger of the gripper. Nothing is written to the servos: their
    torque must be off, as it is after power-on.

    Args:
        path: Serial port of a single leader, such as /dev/ttyUSB0.
        left, right: Ports of two.
        baud: Bits per second of the servos. 57600 takes 26 ms for each reading, 1000000 takes 3 ms.
        signs: Directions of the joints.
        offsets_rad: Offsets of the joints of both leaders; those of each one count instead.
        left_offsets_rad, right_offsets_rad: Offsets of each.
        gripper_deg: Positions of the trigger for an open and for a closed gripper; None: there is no trigger.
        clock: Clock of ages.

    Raises:
        DeviceError: One of its kinds: a port is absent, may not be opened, is in use, or its servos do not answer.
        SettingsError: A value is not legal.
        MissingExtraError: pyserial is not installed.
    """

    def __init__(
        self,
        path: str | None = None,
        left: str | None = None,
        right: str | None = None,
        *,
        baud: int = BAUD,
        signs: Sequence[float] = SIGNS,
        offsets_rad: Sequence[float] = (0.0,) * _JOINTS,
        left_offsets_rad: Sequence[float] | None = None,
        right_offsets_rad: Sequence[float] | None = None,
        gripper_deg: Sequence[float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        paths = paths_of("leader", left, right, path)
        offsets = {
            "": offsets_rad,
            "left": offsets_rad if left_offsets_rad is None else left_offsets_rad,
            "right": offsets_rad if right_offsets_rad is None else right_offsets_rad,
        }
        self._signs = _numbers("signs", signs, _JOINTS)
        if not np.isin(self._signs, (-1.0, 1.0)).all():
            raise SettingsError(f"signs of a leader are {signs!r}: each must be 1 or -1")
        self._offsets = [_numbers(f"{side}_offsets_rad".strip("_"), offsets[side], _JOINTS) for side, _ in paths]
        self._gripper = None if gripper_deg is None else np.radians(_numbers("gripper_deg", gripper_deg, 2))
        if self._gripper is not None and abs(self._gripper[0] - self._gripper[1]) < math.radians(1.0):
            raise SettingsError(
                f"gripper_deg of a leader is {gripper_deg!r}: open and closed must differ by 1° or more"
            )
        if isinstance(baud, bool) or not isinstance(baud, int) or baud <= 0:
            raise SettingsError(f"baud of a leader is {baud!r}: it must be a whole number, such as 57600 or 1000000")
        servos = range(1, _JOINTS + 1 + (self._gripper is not None))
        self.hands, self._clock = len(paths), clock
        self.name = f"leader at {' and '.join(each for _, each in paths)}"
        self._chains: list[_Chain] = []
        self._read_s = self._resumed_s = clock()
        try:
            for side, each in paths:
                self._chains.append(_Chain(each, f"{side} leader at {each}".strip(), baud, servos, clock))
            self._begin()
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        """Wait for the first positions."""
        until = time.monotonic() + _FIRST_S
        for chain in self._chains:
            while chain.position_rad is None:
                chain.ask()
                chain.collect(min(_AGAIN_S, max(0.0, until - time.monotonic())))
                if chain.position_rad is None and time.monotonic() >= until:
                    raise chain.lacking()

    def begin(self) -> None:
        """See `Device`. A leader has no buttons."""

    def read(self) -> Reading:
        """See `Device`. After a pause in which nobody read, old positions count as silence until new ones come."""
        begin_s = self._clock()
        if begin_s - self._read_s > _PAUSE_S:
            self._resumed_s = begin_s
        self._read_s = begin_s
        for chain in self._chains:
            chain.ask()
        joints, gripper = np.zeros((2, _JOINTS)), np.full(2, np.nan)
        age_s, until = 0.0, time.monotonic() + _WAIT_S
        for hand, chain in enumerate(self._chains):
            chain.collect(max(0.0, until - time.monotonic()))
            now = self._clock()
            if now - max(chain.asked_s, self._resumed_s) > LOST_S:
                raise chain.lacking()
            age_s = max(age_s, min(now - chain.asked_s, LOST_S))
            position = chain.position_rad
            if position is None:
                raise chain.lacking()
            joints[hand] = self._signs * (position[:_JOINTS] - self._offsets[hand])
            if self._gripper is not None:
                opened, closed = self._gripper
                away = math.remainder(position[_JOINTS] - (opened + closed) / 2, 2.0 * math.pi)
                gripper[hand] = np.clip(0.5 + away / (opened - closed), 0.0, 1.0)
        return Reading(joints_rad=joints, gripper=gripper, clutch=np.arange(2) < self.hands, age_s=age_s)

    def close(self) -> None:
        """See `Device`."""
        for chain in self._chains:
            chain.close()


def _numbers(name: str, values: object, count: int) -> Array:
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise SettingsError(f"{name} of a leader is {values!r:.80}: it must be {count} finite numbers")
    return found


def _open(path: str, name: str, baud: int) -> Any:
    """Return the open serial port of a leader. No other program can open it meanwhile."""
    try:
        import serial
        from serial.tools import list_ports
    except ImportError:
        raise MissingExtraError("pyserial", "teleop", "a leader arm") from None
    try:
        return serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except ValueError as error:
        raise SettingsError(f"{name}: {error}") from error
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            found = ", ".join(sorted(each.device for each in list_ports.comports())) or "none"
            raise DeviceAbsentError(f"{name}: there is no {path}. Found here: {found}") from None
        if error.errno == errno.EACCES:
            raise denied(path, name, UDEV_RULE) from None
        if error.errno in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
            raise DeviceSharedError(f"{name}: another program reads {path}. End it first") from None
        raise DeviceError(f"{name}: {path} cannot be opened ({error})") from error
