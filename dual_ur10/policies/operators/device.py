"""Protocol of input devices, and the readings that they give."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Protocol, runtime_checkable

import numpy as np

from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES
from dual_ur10.errors import DeviceGarbageError
from dual_ur10.sim2real.control.adapter import TCP_ROTATION_RAD_S, TCP_STEP_M_S
from ur_core.types import Array, Mask, constant

FULL_TWIST: Final = constant([TCP_STEP_M_S] * 3 + [TCP_ROTATION_RAD_S] * 3)
"""(6,) m/s and rad/s of a device at full deflection: those of action 1 of `tcp_delta`."""

SILENT_S: Final = 0.08
"""Age of the newest input from which on nothing moves: as long as LeRobot's device for two arms waits."""

LOST_S: Final = 1.0
"""Age from which on the device is given up."""

BUTTONS: Final = ("grip", "grip_left", "grip_right", "switch", *EPISODES, *TAKES, "stop")
"""Names of buttons with a meaning. "grip" opens or closes the gripper of the arm that the hand leads, "grip_left" and
"grip_right" those of one arm. "switch" passes a device for one hand to the other arm. The others are for what runs the
episodes."""


def _unset() -> Array:
    return np.full(2, np.nan)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Newest input of a device, of the left and of the right hand.

    Exactly one of `twist`, `joints_rad` and `poses` is set. The numbers of a hand whose clutch is released count for
    nothing. A device for one hand fills the first row.

    Attributes:
        twist: (2, 6) speeds of the tool centre points, m/s, and about them, rad/s, along the axes of `Mapping.frame`.
        joints_rad: (2, 6) joint positions of leader arms, any whole turns off.
        poses: (2, 7) wanted poses of the tool centre points in the cell frame: position (m), quaternion (w, x, y, z).
        gripper: (2,) 0 closed to 1 open; NaN: as it is.
        triggers: The grippers are those of triggers: after a takeover one counts once it has come to where its gripper
            is. False: they were just asked for, and count at once.
        clutch: (2,) True while the hand leads.
        buttons: Names of the buttons pressed since the reading before.
        age_s: Age of the newest input. 0 where silence means rest.
    """

    twist: Array | None = None
    joints_rad: Array | None = None
    poses: Array | None = None
    gripper: Array = field(default_factory=_unset)
    triggers: bool = True
    clutch: Mask = field(default_factory=lambda: np.zeros(2, dtype=bool))
    buttons: frozenset[str] = frozenset()
    age_s: float = 0.0

    @property
    def kind(self) -> str:
        """Name of what is set: "twist", "joints_rad" or "poses"."""
        return next(name for name in _SIZES if getattr(self, name) is not None)


_SIZES: Final = {"twist": 6, "joints_rad": 6, "poses": 7}


@runtime_checkable
class Device(Protocol):
    """Input device.

    Attributes:
        name: Its name in messages, such as "spacemouse at /dev/hidraw3".
        hands: 1 for a device for one hand, 2 for one for both.
    """

    name: str
    hands: int

    def begin(self) -> None:
        """Begin an episode: forget what was pressed before it, but not the button "stop".

        Raises:
            DeviceError: As for `read`.
        """

    def read(self) -> Reading:
        """Return the newest input, and forget all earlier one. It never waits longer than a few milliseconds.

        Raises:
            DeviceError: One of its kinds: the device is gone, silent, or not understood.
        """

    def close(self) -> None:
        """Release the device. May be called twice."""


def checked(reading: Reading, name: str) -> Reading:
    """Return a reading whose arrays have their shapes and are finite where a hand leads.

    Args:
        reading: Of any device, also of the user's own.
        name: Name of the device for messages.

    Raises:
        DeviceGarbageError: It has not.
    """
    given = [each for each in _SIZES if getattr(reading, each) is not None]
    if len(given) != 1:
        raise DeviceGarbageError(
            f"{name} gave {' and '.join(given) or 'nothing'}: a reading holds one of {', '.join(_SIZES)}"
        )
    values = _array(getattr(reading, given[0]), (2, _SIZES[given[0]]), given[0], name)
    gripper = _array(reading.gripper, (2,), "gripper", name)
    clutch = np.asarray(reading.clutch)
    if clutch.shape != (2,) or clutch.dtype != np.bool_:
        raise DeviceGarbageError(f"{name} gave clutch={reading.clutch!r:.80}: it must be two of True and False")
    if not np.isfinite(values[clutch]).all():
        raise DeviceGarbageError(f"{name} gave {given[0]}={values[clutch]!r:.120}: numbers must be finite")
    if not (np.isnan(gripper) | ((gripper >= 0.0) & (gripper <= 1.0))).all():
        raise DeviceGarbageError(f"{name} gave gripper={gripper!r:.80}: each must be 0 to 1, or NaN")
    if not 0.0 <= reading.age_s < math.inf:
        raise DeviceGarbageError(f"{name} gave age_s={reading.age_s!r:.80}: it must be a time of 0 s or more")
    return Reading(
        **{given[0]: np.where(clutch[:, None], values, 0.0)},
        gripper=np.where(clutch, gripper, np.nan),
        triggers=bool(reading.triggers),
        clutch=clutch,
        buttons=_buttons(reading.buttons, name),
        age_s=float(reading.age_s),
    )


def _array(value: object, shape: tuple[int, ...], what: str, name: str) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape:
        raise DeviceGarbageError(f"{name} gave {what}={value!r:.120}: it must be numbers of shape {shape}")
    return array


def _buttons(buttons: Iterable[str], name: str) -> frozenset[str]:
    found = frozenset(buttons)
    if not all(isinstance(each, str) for each in found):
        raise DeviceGarbageError(f"{name} gave buttons={buttons!r:.120}: they must be names")
    return found
