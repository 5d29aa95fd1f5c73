"""Settings of `Free`, and the objects of its scene."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final

import numpy as np

from dual_ur10.assets.prop import Prop, check_props
from dual_ur10.assets.props import BAR, BAR_WIDTH_M, BLOCK, BLOCK_SIZE_M
from dual_ur10.envs.tasks.geometry import lying
from dual_ur10.envs.tasks.task import check_numbers
from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core.objects import load_object
from ur_core.types import Array

OBJECTS: Final = {BLOCK.name: BLOCK, BAR.name: BAR}
"""Objects by name."""

_HEIGHT_M: Final = {BLOCK.name: BLOCK_SIZE_M[2], BAR.name: BAR_WIDTH_M}
_PLACES_M: Final = {BLOCK.name: (-0.1, 0.5, 0.0), BAR.name: (0.15, 0.0, 0.0)}
"""Nominal x, y (m) and yaw (rad) on the table, in the cell frame: the block lies along x, the bar along y."""


@dataclasses.dataclass(frozen=True)
class FreeSettings:
    """Keywords of `Free`, described there.

    Raises:
        UnknownNameError: There is no object of a name.
        SettingsError: Another value is not legal.
    """

    objects: tuple[Any, ...] = (BLOCK.name,)
    grip_force_n: float = 60.0
    object_range_m: float = 0.02
    object_turn_rad: float = 0.1

    def __post_init__(self) -> None:
        objects = (self.objects,) if isinstance(self.objects, str | Prop) else self.objects
        if not isinstance(objects, tuple | list):
            raise SettingsError(f"objects are {objects!r:.80}: name one, or several in a tuple, such as ('block',)")
        object.__setattr__(self, "objects", tuple(objects))
        check_props(self.props)
        check_numbers(self, ("object_range_m", 0.0, 0.05), ("object_turn_rad", 0.0, math.pi / 12))

    @property
    def props(self) -> tuple[Prop, ...]:
        """Objects of the scene."""
        return tuple(_prop(each) for each in self.objects)

    def places(self, samples: Array) -> dict[str, Array]:
        """Return the poses, (k, 7), of the objects that have nominal places, from samples between -1 and 1.

        Args:
            samples: (k, objects, 3) of shifts along x and y, and of the rotation about the vertical.
        """
        reach, found = np.array([self.object_range_m] * 2 + [self.object_turn_rad]), {}
        for k, prop in enumerate(self.props):
            if OBJECTS.get(prop.name) is prop:
                pose = lying(_PLACES_M[prop.name] + reach * samples[:, k], _HEIGHT_M[prop.name])
                found[prop.name] = np.concatenate(pose, axis=1)
        return found


def _prop(given: object) -> Prop:
    if isinstance(given, Prop):
        return given
    if isinstance(given, str) and given in OBJECTS:
        return OBJECTS[given]
    if isinstance(given, str) and given.count(":") == 1:
        found = load_object(given, "an object of the scene")
        if isinstance(found, Prop):
            return found
        raise SettingsError(f"the object {given!r} is {type(found).__name__}: it must be a Prop")
    raise UnknownNameError("object", str(given), tuple(OBJECTS), "module:NAME of a Prop of your own")
