"""Perturbation: the deviation of a simulated plant from the nominal model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core.kinematics.robots import MOST_PAYLOAD_KG
from ur_core.types import Array

Numbers = float | Array | tuple[Any, ...]


@dataclass(frozen=True)
class Perturbation:
    """Deviation of a simulated plant from the nominal model of adapter and controller.

    Each value is one number for all, or an array that broadcasts to the shape given; arrays are kept as nested tuples,
    so that equal perturbations are equal and hash alike. The defaults change nothing.

    Attributes:
        mass_scale: (n, 2) factor on all link masses and inertias. The controller still compensates the gravity of the
            nominal arm.
        friction_nm: (n, 2, 6) Coulomb friction of the joints.
        lookahead_scale: (n, 2) factor on the lookahead time of the law.
        latency_s: (n, 2) constant delay of every target, rounded to whole physics steps.
        jitter_s: (n, 2) largest additional delay, uniform, per tick; targets keep their order.
        loss: (n, 2) probability that a target is lost; the previous one is held.
        payload_kg: (n, 2) mass at the flange.
        declared_payload_kg: (n, 2) payload set on the controller, as with `set_payload`.
        base_shift_m: (n, 2, 3) displacement of a base, in the cell frame, from its nominal position. The safety gate
            measures distances at the nominal position, as it does on a robot.
        base_turn_rad: (n, 2) rotation of a base about the vertical from its nominal orientation.
        object_mass_scale: (n,) factor on the mass and inertia of the object.
        grip_friction_scale: (n, 2) factor on the friction of the pads.
    """

    mass_scale: Numbers = 1.0
    friction_nm: Numbers = 0.0
    lookahead_scale: Numbers = 1.0
    latency_s: Numbers = 0.0
    jitter_s: Numbers = 0.0
    loss: Numbers = 0.0
    payload_kg: Numbers = 0.0
    declared_payload_kg: Numbers = 0.0
    base_shift_m: Numbers = 0.0
    base_turn_rad: Numbers = 0.0
    object_mass_scale: Numbers = 1.0
    grip_friction_scale: Numbers = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("mass_scale", 0.1, 10.0),
            ("friction_nm", 0.0, 100.0),
            ("lookahead_scale", 0.1, 10.0),
            ("latency_s", 0.0, 0.2),
            ("jitter_s", 0.0, 0.2),
            ("loss", 0.0, 0.9),
            ("payload_kg", 0.0, MOST_PAYLOAD_KG),
            ("declared_payload_kg", 0.0, MOST_PAYLOAD_KG),
            ("base_shift_m", -0.05, 0.05),
            ("base_turn_rad", -0.1, 0.1),
            ("object_mass_scale", 0.1, 10.0),
            ("grip_friction_scale", 0.1, 10.0),
        ):
            try:
                value = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError):
                raise SettingsError(f"perturbation {name} is {getattr(self, name)!r}: it must be numbers") from None
            if not ((value >= low) & (value <= high)).all():
                raise SettingsError(f"perturbation {name} is {getattr(self, name)!r}: allowed are {low} to {high}")
            object.__setattr__(self, name, _plain(value.tolist()))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Perturbation:
        """Build from plain keywords.

        Raises:
            UnknownNameError: A key is not one of the attributes.
        """
        known = [each.name for each in fields(cls)]
        for key in values:
            if key not in known:
                raise UnknownNameError("perturbation", str(key), known)
        return cls(**values)

    def changed(self, **values: Any) -> Perturbation:
        """Return a copy with some values changed.

        Raises:
            UnknownNameError: A keyword is not one of the attributes.
        """
        return self.from_mapping({**{each.name: getattr(self, each.name) for each in fields(self)}, **values})

    def expanded(self, n: int) -> dict[str, Array]:
        """Return all values as arrays of their full shape."""
        shapes: dict[str, tuple[int, ...]] = {"friction_nm": (2, 6), "base_shift_m": (2, 3), "object_mass_scale": ()}
        result = {}
        for each in fields(self):
            shape = (n, *shapes.get(each.name, (2,)))
            try:
                value = np.broadcast_to(np.asarray(getattr(self, each.name), dtype=np.float64), shape)
            except ValueError:
                found = np.shape(getattr(self, each.name))
                raise SettingsError(f"perturbation {each.name} has shape {found}: it must fit {shape}") from None
            result[each.name] = value.copy()
        return result


def _plain(values: Any) -> Any:
    """Convert nested lists to nested tuples."""
    return tuple(map(_plain, values)) if isinstance(values, list) else values


TYPICAL_PERTURBATION = Perturbation(
    mass_scale=1.05,
    friction_nm=np.array([5.0, 5.0, 3.0, 1.0, 1.0, 1.0]),
    lookahead_scale=1.05,
    latency_s=0.002,
)
"""Plant of the accuracy figures called "perturbed": masses +5 %, joint friction, lookahead +5 %, 2 ms of latency that
is not compensated."""
