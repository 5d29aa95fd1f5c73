"""Cameras as data: of the cell, or fixed to a body of an arm, a tool or a prop."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ur_core.errors import SettingsError
from ur_core.kinematics.frames import finite_floats
from ur_core.types import Array, Vector3

_NAME: Final = re.compile(r"[A-Za-z]\w{0,39}")
_LEAST: Final = 1e-6  # sine of an angle between two directions that are not parallel
_STEEP: Final = 0.95  # cosine beyond which a camera that looks up or down has x upwards in its images


@dataclass(frozen=True)
class Camera:
    """Camera for rendering and for observations of pixels.

    Attributes:
        name: Its name. In the cell, one of a tool has the arm's name in front, "left/wrist", and one of a prop the
            prop's, "case/eye".
        position_m: Position in the frame of its body.
        target_m: Point in the middle of the image, in that frame.
        fovy_deg: Vertical field of view.
        body: Body that carries it. Of a camera of a scene or an environment: a body of the cell, such as "left/gripper"
            or "case/lid"; "": it stands in the cell frame. Of a camera of a prop or of a tool: one of their bodies; "":
            the prop itself, or the gripper, whose frame is the flange's.
        up: Direction in that frame that is upwards in the images; None: z, or x where it looks along z.

    Raises:
        SettingsError: A value is not legal.
    """

    name: str
    position_m: Vector3
    target_m: Vector3
    fovy_deg: float = 45.0
    body: str = ""
    up: Vector3 | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or _NAME.fullmatch(self.name) is None:
            raise SettingsError(f"the name of a camera is {self.name!r}: use letters, digits and _, a letter first")
        if not isinstance(self.body, str):
            raise SettingsError(f"body of the camera {self.name!r} is {self.body!r:.80}: it must be the name of a body")
        for name in ("position_m", "target_m", *(("up",) if self.up is not None else ())):
            value = finite_floats(f"{name} of the camera {self.name!r}", getattr(self, name), 3)
            object.__setattr__(self, name, value)
        (fovy,) = finite_floats(f"fovy_deg of the camera {self.name!r}", (self.fovy_deg,), 1)
        object.__setattr__(self, "fovy_deg", fovy)
        if not 1.0 <= fovy <= 170.0 or self.position_m == self.target_m:
            raise SettingsError(
                f"the camera {self.name!r} at {self.position_m} looks at {self.target_m} with {fovy:g}°: the points "
                "must differ, and the field of view must be 1 to 170°"
            )
        if self.up is not None:
            across = np.linalg.norm(np.cross(self.up, self._backward()))
            if across <= _LEAST * np.linalg.norm(self.up):
                raise SettingsError(f"up of the camera {self.name!r} is {self.up}: it must not be along its view, or 0")

    @property
    def axes(self) -> tuple[float, ...]:
        """(6,) its axes x and y, rightwards and upwards in the images, in the frame of its body."""
        backward = self._backward()
        up = self.up or ((0.0, 0.0, 1.0) if abs(backward[2]) < _STEEP else (1.0, 0.0, 0.0))
        x = np.cross(up, backward)
        x /= np.linalg.norm(x)
        return (*x.tolist(), *np.cross(backward, x).tolist())

    def _backward(self) -> Array:
        """Return the unit vector from the target to the camera."""
        away: Array = np.subtract(self.position_m, self.target_m)
        return away / np.linalg.norm(away)


def cameras_of(values: Any, what: str) -> tuple[Camera, ...]:
    """Return cameras that belong together.

    Args:
        values: The cameras, or mappings of their fields, as JSON holds them.
        what: Owner, for the message.

    Raises:
        SettingsError: They are no cameras, or two have one name.
    """
    try:
        found = tuple(each if isinstance(each, Camera) else Camera(**each) for each in values)
    except TypeError:
        raise SettingsError(f"cameras of {what} is {values!r:.120}: it must be a tuple of Camera") from None
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"two cameras of {what} are named {name!r}: give each a name of its own")
    return found
