"""Deviation of simulated arms from their nominal model."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.frames import ArmMount

PLANTS: Final = ("nominal", "mild", "wide")
"""Deviation of the plant from its nominal model: none, or the randomization of that name."""

_MAX_DH_ERROR_M: Final = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Simulated plant.

    Attributes:
        plant: "nominal" for the nominal model. "mild" or "wide" for a sample from the randomization of that name:
            masses, friction, lookahead and latency; in a cell also base poses, object and grip.
        seed: Seed of the sample, and of the start of a task's episode.
        dh_error_m: Largest random error of the lengths in the arms' kinematics, m.
    """

    plant: str = "mild"
    seed: int = 0
    dh_error_m: float = 0.0

    def __post_init__(self) -> None:
        if self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)
        if not isinstance(self.seed, int) or self.seed < 0:
            raise SettingsError(f"seed is {self.seed!r}: it must be a whole number, 0 or above")
        if not 0.0 <= self.dh_error_m <= _MAX_DH_ERROR_M:
            raise SettingsError(f"dh_error_m is {self.dh_error_m!r}: allowed are 0 to {_MAX_DH_ERROR_M:g} m")

    def mount(self, nominal: ArmMount, rng: np.random.Generator) -> ArmMount:
        """Return the mount of an arm with random errors of its kinematics."""
        if not self.dh_error_m:
            return nominal
        a_m, d_m = (np.asarray(each) for each in (nominal.dh.a_m, nominal.dh.d_m))
        a_m = a_m + rng.uniform(-self.dh_error_m, self.dh_error_m, 6) * (a_m != 0.0)
        d_m = d_m + rng.uniform(-self.dh_error_m, self.dh_error_m, 6) * (d_m != 0.0)
        return dataclasses.replace(nominal, dh=dataclasses.replace(nominal.dh, a_m=tuple(a_m), d_m=tuple(d_m)))
