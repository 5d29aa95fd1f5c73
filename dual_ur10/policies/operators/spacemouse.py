"""SpaceMice of 3Dconnexion, one or two, read as raw HID reports."""

from __future__ import annotations

import os
import re
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import DeviceAbsentError, DeviceGarbageError
from dual_ur10.policies.operators.device import FULL_TWIST, Reading
from dual_ur10.policies.operators.hands import open_path, paths_of, unplugged
from ur_core.types import Array

UDEV_RULE: Final = (
    'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="256f|046d", ATTRS{idProduct}=="c6*", MODE="0660", TAG+="uaccess"'
)
"""Rule of udev that permits the person at the screen to read a SpaceMouse."""

FULL_SCALE: Final = 350
"""Number in a report at full deflection."""

_VENDORS: Final = {"256F": "", "046D": "C6"}  # 3Dconnexion, and Logitech: products that begin so
_MOST: Final = 2000  # numbers beyond that come from no SpaceMouse
_REPORT_BYTES: Final = 64
_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3  # reports; others, such as that of the battery, are left out
# Report axes are right, towards the operator, and down; the device's are forward, left and up.
_AXES: Final = np.array([1, 0, 2, 4, 3, 5])
_HIDRAW: Final = Path("/sys/class/hidraw")


def found_here(folder: Path = _HIDRAW) -> list[str]:
    """Return the paths of the SpaceMice of this machine."""
    try:
        names = sorted(each.name for each in folder.iterdir())
    except OSError:
        return []
    return [f"/dev/{name}" for name in names if _is_spacemouse(name, folder)]


def _is_spacemouse(name: str, folder: Path) -> bool:
    try:
        text = (folder / name / "device" / "uevent").read_text()
    except OSError:
        return False
    found = re.search(r"^HID_ID=\w+:0000(\w{4}):0000(\w{4})$", text, re.MULTILINE)
    if found is None:
        return False
    vendor, product = found[1].upper(), found[2].upper()
    return vendor in _VENDORS and product.startswith(_VENDORS[vendor])


class _Mouse:
    """One SpaceMouse.

    Attributes:
        counts: (6,) newest numbers of its axes, as reported.
        moved_s: Time of the newest report of axes.
    """

    def __init__(self, path: str, name: str, now_s: float) -> None:
        here = found_here()
        known = _HIDRAW / os.path.basename(os.path.realpath(path))
        if known.exists() and not _is_spacemouse(known.name, _HIDRAW):
            raise DeviceAbsentError(f"{name}: it is no SpaceMouse. Found here: {', '.join(here) or 'none'}")
        self.name, self._held = name, 0
        self.counts: Array = np.zeros(6)
        self.moved_s = now_s
        self._file = open_path(path, name, os.O_RDONLY | os.O_NONBLOCK, UDEV_RULE, here)

    def drain(self, now_s: float) -> int:
        """Take in all reports, and return the buttons that they press, as bits: the kernel keeps a second of them."""
        pressed = 0
        while True:
            try:
                report = os.read(self._file, _REPORT_BYTES)
            except BlockingIOError:
                return pressed
            except OSError as error:
                unplugged(self.name, error)
            if not report:
                unplugged(self.name)
            pressed |= self._take(report, now_s)

    def _take(self, report: bytes, now_s: float) -> int:
        """Take in a report, and return the buttons that it presses."""
        kind, body = report[0], report[1:]
        if kind == _BUTTONS and body:
            held = int.from_bytes(body[:4], "little")
            pressed, self._held = held & ~self._held, held
            return pressed
        if kind not in (_TRANSLATION, _ROTATION):
            return 0
        first = 0 if kind == _TRANSLATION else 3
        count = 6 if kind == _TRANSLATION and len(body) >= 12 else 3
        if len(body) < 2 * count:
            raise DeviceGarbageError(f"{self.name} sent {report.hex(' ')}: report {kind} has 6 or 12 bytes behind it")
        values = struct.unpack_from(f"<{count}h", body)
        if max(map(abs, values)) > _MOST:
            raise DeviceGarbageError(
                f"{self.name} sent {report.hex(' ')}: numbers of axes are up to {FULL_SCALE}, found {values}"
            )
        self.counts[first : first + count] = values
        self.moved_s = now_s
        return 0

    def close(self) -> None:
        """Release the device. May be called twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class SpaceMouse:
    """One SpaceMouse for one hand, or two, one for each hand.

    Its cap leads while it is deflected: forward, left and up along x, y and z, and rotations about them. The first
    button opens or closes the gripper. The second passes a single SpaceMouse to the other arm; of two, the left one's
    is "discard" and the right one's "success".

    A deflected cap reports about 100 times a second. If it falls silent, it counts as silent; at rest it reports
    nothing.

    Args:
        path: Path of a single SpaceMouse, such as /dev/hidraw3. None, without `left` and `right`: the only one here.
        left, right: Paths of two.
        clock: Clock of ages.

    Raises:
        DeviceError: One of its kinds: it is absent, may not be opened, or is named twice.
        SettingsError: Only one of `left` and `right` is given.
    """

    def __init__(
        self,
        path: str | None = None,
        left: str | None = None,
        right: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if path is left is right is None:
            path = _only_one(found_here())
        paths = paths_of("spacemouse", left, right, path)
        self.hands, self._clock = len(paths), clock
        self.name = f"spacemouse at {' and '.join(each for _, each in paths)}"
        self._mice: list[_Mouse] = []
        self._sides = [side for side, _ in paths]
        try:
            for side, each in paths:
                self._mice.append(_Mouse(each, f"{side} spacemouse at {each}".strip(), clock()))
        except BaseException:
            self.close()
            raise

    def begin(self) -> None:
        """See `Device`."""
        self.read()

    def read(self) -> Reading:
        """See `Device`."""
        now = self._clock()
        twist, buttons, age_s = np.zeros((2, 6)), set(), 0.0
        for hand, mouse in enumerate(self._mice):
            buttons |= self._names(self._sides[hand], mouse.drain(now))
            share = np.clip(-mouse.counts[_AXES] / FULL_SCALE, -1.0, 1.0)
            twist[hand] = share * FULL_TWIST
            if mouse.counts.any():
                age_s = max(age_s, now - mouse.moved_s)
        clutch = np.arange(2) < self.hands
        return Reading(twist=twist, clutch=clutch, buttons=frozenset(buttons), age_s=age_s)

    @staticmethod
    def _names(side: str, pressed: int) -> set[str]:
        second = {"left": "discard", "right": "success", "": "switch"}[side]
        names = ("grip" if not side else f"grip_{side}", second)
        return {name for bit, name in enumerate(names) if pressed >> bit & 1}

    def close(self) -> None:
        """See `Device`."""
        for mouse in self._mice:
            mouse.close()


def _only_one(found: list[str]) -> str:
    if len(found) != 1:
        raise DeviceAbsentError(
            f"spacemouse: found {', '.join(found) or 'none'}. Plug one in, or name them: path=/dev/hidraw3, or "
            "left=/dev/hidraw3,right=/dev/hidraw4"
        )
    return found[0]
