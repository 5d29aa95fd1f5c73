"""Obstacles of the cell: boxes, capsules and walls, in the cell frame.

They are solid in simulation, and the safety gate keeps both arms and their grippers away from them.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from dual_ur10.errors import SettingsError
from ur_core.kinematics.frames import finite_floats
from ur_core.types import Vector3

ROOM_M: Final = 20.0
"""Farthest that a coordinate of an obstacle may be from the cell's origin, and the longest edge of a box."""

THINNEST_M: Final = 0.001
"""Shortest edge of a box, and smallest radius of a capsule."""

NAME: Final = "[A-Za-z0-9_-]{1,64}"
"""Names of obstacles: they become parts of messages and of names in models."""

_UNIT_TOLERANCE: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box: centre, length of its edges, rotation vector.

    Raises:
        SettingsError: A value is not finite or not allowed.
    """

    kind: ClassVar[str] = "box"
    name: str
    position_m: Vector3
    size_m: Vector3
    rotation_rad: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _take(self, ROOM_M, "position_m")
        _take(self, ROOM_M, "size_m", THINNEST_M)
        _take(self, 2 * math.pi, "rotation_rad")


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A capsule: all points within `radius_m` of a line; a ball, if both ends are one point.

    Raises:
        SettingsError: A value is not finite or not allowed.
    """

    kind: ClassVar[str] = "capsule"
    name: str
    from_m: Vector3
    to_m: Vector3
    radius_m: float

    def __post_init__(self) -> None:
        _take(self, ROOM_M, "from_m")
        _take(self, ROOM_M, "to_m")
        (radius,) = finite_floats(_path(self, "radius_m"), (self.radius_m,), 1)
        _check(self, "radius_m", (radius,), ROOM_M / 2, THINNEST_M)
        object.__setattr__(self, "radius_m", radius)


@dataclass(frozen=True, kw_only=True)
class Plane:
    """An infinite wall. `normal`, of length 1 within 1e-3, points towards the arms.

    Raises:
        SettingsError: A value is not finite or not allowed.
    """

    kind: ClassVar[str] = "plane"
    name: str
    point_m: Vector3
    normal: Vector3

    def __post_init__(self) -> None:
        _take(self, ROOM_M, "point_m")
        _take(self, 1 + _UNIT_TOLERANCE, "normal")
        length = math.hypot(*self.normal)
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise SettingsError(
                f"{_path(self, 'normal')} has the length {length:.6g}: allowed is 1. Divide it by its length"
            )


Obstacle = Box | Capsule | Plane


def geom_name(obstacle: Obstacle) -> str:
    """Return its name in models, in pairs and in messages of the safety gate."""
    return f"obstacle/{obstacle.name}"


def _path(obstacle: Any, key: str) -> str:
    """Return the name of a value for messages, after a check of the obstacle's own name."""
    name = obstacle.name
    if not (isinstance(name, str) and re.fullmatch(NAME, name)):
        raise SettingsError(
            f"a {obstacle.kind} among the obstacles is named {name!r}: allowed are up to 64 letters, digits, _ and -"
        )
    return f"{key} of the obstacle {name!r}"


def _take(obstacle: Any, highest: float, key: str, lowest: float | None = None) -> None:
    """Check three numbers of an obstacle, and keep them as plain floats."""
    values = finite_floats(_path(obstacle, key), getattr(obstacle, key), 3)
    _check(obstacle, key, values, highest, -highest if lowest is None else lowest)
    object.__setattr__(obstacle, key, values)


def _check(obstacle: Any, key: str, values: tuple[float, ...], highest: float, lowest: float) -> None:
    if not all(lowest <= value <= highest for value in values):
        raise SettingsError(
            f"{_path(obstacle, key)} is {values if len(values) > 1 else values[0]}: allowed is {lowest:g} to "
            f"{highest:g}"
        )


def checked(obstacles: Any) -> tuple[Obstacle, ...]:
    """Return the obstacles of one scene, checked.

    Raises:
        SettingsError: An entry is no obstacle, or two have the same name.
    """
    if not isinstance(obstacles, tuple | list) or not all(isinstance(each, Obstacle) for each in obstacles):
        raise SettingsError(f"obstacles must be a tuple of Box, Capsule and Plane, found {obstacles!r}")
    names = [each.name for each in obstacles]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"{names.count(name)} obstacles are named {name!r}: choose different names")
    return tuple(obstacles)
