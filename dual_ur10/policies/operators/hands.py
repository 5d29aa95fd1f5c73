"""Common parts of the classes of devices: descriptors, arguments and the choice of a hand."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from typing import NoReturn

from dual_ur10.errors import (
    DeviceAbsentError,
    DeviceDeniedError,
    DeviceError,
    DeviceSharedError,
    DeviceUnpluggedError,
    SettingsError,
)

_GONE = (errno.ENODEV, errno.EIO, errno.ENXIO, errno.EPIPE, errno.ECONNRESET)


def paths_of(kind: str, left: str | None, right: str | None, path: str | None) -> list[tuple[str, str]]:
    """Return "left", "right" or "" for one hand, and the path of each device.

    Args:
        kind: Name of the device's class.
        left: Path of the device for the left hand.
        right: Path of that for the right hand.
        path: Path of a device for one hand.

    Raises:
        SettingsError: Other paths are given than one, or one for each hand.
        DeviceSharedError: Both hands have the same one.
    """
    if path is not None and left is None and right is None:
        return [("", path)]
    if left is None or right is None or path is not None:
        found = {name: value for name, value in (("left", left), ("right", right), ("path", path)) if value}
        raise SettingsError(
            f"{kind} with {found or 'no path'}: name one device as path=..., or two as left=... and right=..."
        )
    if os.path.realpath(left) == os.path.realpath(right):
        raise DeviceSharedError(f"{kind}: {left} is named for both hands. Each needs a device of its own")
    return [("left", left), ("right", right)]


def open_path(path: str, name: str, flags: int, rule: str, found: Sequence[str]) -> int:
    """Return the descriptor of a device file.

    Args:
        path: Path of the file.
        name: Name of the device for messages.
        flags: Flags of `os.open`.
        rule: udev rule that permits this user to open it.
        found: Devices of this kind on this machine, for messages.

    Raises:
        DeviceAbsentError: There is no such file.
        DeviceDeniedError: This user may not open it.
        DeviceError: It cannot be opened for another reason.
    """
    try:
        return os.open(path, flags | os.O_CLOEXEC)
    except FileNotFoundError:
        raise DeviceAbsentError(f"{name}: there is no {path}. Found here: {', '.join(found) or 'none'}") from None
    except PermissionError:
        raise denied(path, name, rule) from None
    except OSError as error:
        if error.errno in _GONE:
            raise DeviceAbsentError(f"{name}: nothing answers at {path} ({error.strerror})") from None
        raise DeviceError(f"{name}: {path} cannot be opened ({error.strerror})") from error


def denied(path: str, name: str, rule: str) -> DeviceDeniedError:
    """Return the error of a device that this user may not open."""
    return DeviceDeniedError(
        f"{name}: you may not open {path}. Put this line into /etc/udev/rules.d/60-dual-ur10.rules, run `sudo udevadm "
        f"control --reload`, and plug the device in again: {rule}"
    )


def unplugged(name: str, error: OSError | None = None) -> NoReturn:
    """Raise the error of a device that is gone, or another one of its descriptor."""
    if error is not None and error.errno not in _GONE:
        raise DeviceError(f"{name} cannot be read ({error.strerror})") from error
    raise DeviceUnpluggedError(f"{name} was unplugged: plug it in, and start again") from error
