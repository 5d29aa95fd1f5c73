"""Variation of plant and sensing from episode to episode, so that a policy does not depend on one exact plant."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core.types import Array

JOINT_FRICTION_NM: Final = (5.0, 5.0, 3.0, 1.0, 1.0, 1.0)
"""Coulomb friction of the joints at `joint_friction` 1: that of `dual_ur10.TYPICAL_PERTURBATION`."""

VISUAL: Final = ("light", "colour", "camera_shift_m", "camera_turn_rad")
"""Ranges that observed images alone show."""

VISUAL_SEED: Final = "visual_seed"
"""Name of the sampled number from which the look of an episode follows."""

_LOOKAHEAD_DIGITS: Final = 3  # of a sampled lookahead, so that cached discretisations are reused


@dataclasses.dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges of the deviations from the nominal model. 0 means no deviation.

    Every episode of every cell samples its own values. "±" is uniform between minus and plus; "up to" is uniform from
    0; "σ" is normal. Values per arm are sampled for each arm.

    Attributes:
        mass: ± fraction of the links' masses and inertias, per arm.
        joint_friction: Up to this fraction of `JOINT_FRICTION_NM`, per joint.
        lookahead: ± fraction of the servos' lookahead time, per arm.
        latency_s: Up to this latency of commands, common to both arms.
        skew_s: Up to this additional latency, per arm.
        jitter_s: Largest additional delay of each command, per arm.
        joint_noise_rad: σ of each measured joint position, at every observation.
        joint_speed_noise_rad_s: σ of each measured joint speed, at every observation.
        object_noise_m: σ along each axis of the object's measured position, constant in an episode.
        object_noise_rad: σ about each axis of its measured orientation, constant in an episode.
        observation_delay_s: Up to this age of an observation, at most a policy period.
        base_shift_m: ± offset of a base along each axis from its nominal position, per arm.
        base_turn_rad: ± rotation of a base about the vertical, per arm.
        object_mass: ± fraction of the object's mass and inertia.
        grip_friction: ± fraction of the pads' friction, per arm.
        object_spread: Factor on the task's ranges of the object's initial pose.
        light: ± fraction of the strength of each light, in observed images.
        colour: ± fraction of red, green and blue of each material and shape there.
        camera_shift_m: ± offset of each camera along each axis of the frame that it stands in.
        camera_turn_rad: ± rotation of each camera about each of its axes.

    Raises:
        SettingsError: A value is not possible.
    """

    mass: float = 0.0
    joint_friction: float = 0.0
    lookahead: float = 0.0
    latency_s: float = 0.0
    skew_s: float = 0.0
    jitter_s: float = 0.0
    joint_noise_rad: float = 0.0
    joint_speed_noise_rad_s: float = 0.0
    object_noise_m: float = 0.0
    object_noise_rad: float = 0.0
    observation_delay_s: float = 0.0
    base_shift_m: float = 0.0
    base_turn_rad: float = 0.0
    object_mass: float = 0.0
    grip_friction: float = 0.0
    object_spread: float = 1.0
    light: float = 0.0
    colour: float = 0.0
    camera_shift_m: float = 0.0
    camera_turn_rad: float = 0.0

    def __post_init__(self) -> None:
        most = {
            "mass": 0.5,
            "joint_friction": 10.0,
            "lookahead": 0.5,
            "latency_s": 0.1,
            "skew_s": 0.1,
            "jitter_s": 0.1,
            "joint_noise_rad": 0.1,
            "joint_speed_noise_rad_s": 1.0,
            "object_noise_m": 0.1,
            "object_noise_rad": 1.0,
            "observation_delay_s": 0.2,
            "base_shift_m": 0.05,
            "base_turn_rad": 0.1,
            "object_mass": 0.9,
            "grip_friction": 0.9,
            "object_spread": 5.0,
            "light": 0.9,
            "colour": 1.0,
            "camera_shift_m": 0.2,
            "camera_turn_rad": 0.5,
        }
        for name, high in most.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0.0 <= float(value) <= high:
                raise SettingsError(f"randomization {name} is {value!r}: it must be a number, 0 to {high:g}")
            object.__setattr__(self, name, float(value))

    @property
    def is_none(self) -> bool:
        """True if nothing varies except initial poses of objects, which the task samples."""
        return dataclasses.replace(self, object_spread=1.0) == Randomization()

    @property
    def varied(self) -> tuple[str, ...]:
        """Names of the values of `Perturbation` that differ from episode to episode."""
        by_name = {
            "mass_scale": self.mass,
            "friction_nm": self.joint_friction,
            "lookahead_scale": self.lookahead,
            "latency_s": self.latency_s + self.skew_s,
            "jitter_s": self.jitter_s,
            "base_shift_m": self.base_shift_m,
            "base_turn_rad": self.base_turn_rad,
            "object_mass_scale": self.object_mass,
            "grip_friction_scale": self.grip_friction,
        }
        return tuple(name for name, value in by_name.items() if value)

    @property
    def visual(self) -> bool:
        """True if observed images look otherwise from episode to episode, beyond what moves in them."""
        return any(getattr(self, name) for name in VISUAL)

    def spread(self, settings: Any, given: Mapping[str, Any], ranges: Sequence[str]) -> Any:
        """Return a task's settings with wider ranges of objects' initial poses.

        Args:
            settings: Settings of the task.
            given: Keywords that the user gave, which stay.
            ranges: Names of the settings that are ranges; see `Task.ranges`.
        """
        own = {each.name for each in dataclasses.fields(settings)}
        names = [name for name in ranges if name in own and name not in given]
        if self.object_spread == 1.0 or not names:
            return settings
        return dataclasses.replace(settings, **{name: self.object_spread * getattr(settings, name) for name in names})

    def sample(self, rngs: Sequence[np.random.Generator], objects: int = 1) -> dict[str, Array]:
        """Sample the values of one episode for each generator, (len(rngs), ...) by name.

        Args:
            rngs: A generator for each cell that begins an episode.
            objects: Number of objects whose poses are measured.


        Values of `dual_ur10.sim2real.cell.perturbation.Perturbation` have its names, and are factors or differences
        on top of the cell's own. `VISUAL_SEED` is for observed images, the others for
        `dual_ur10.envs.core.sensing.Sensing`.
        """
        # The stream advances equally, whichever numbers are used.
        unit = np.array([rng.uniform(-1.0, 1.0, 40) for rng in rngs])
        normal = np.array([rng.standard_normal(6 * max(1, objects)) for rng in rngs]).reshape(len(rngs), -1, 2, 3)
        up = (unit + 1.0) / 2
        both = np.s_[:, :2]
        latency = self.latency_s * up[:, :1] + self.skew_s * up[:, 1:3]
        lookahead = np.round(1.0 + self.lookahead * unit[:, 4:6], _LOOKAHEAD_DIGITS)
        return {
            **({VISUAL_SEED: unit[:, 30]} if self.visual else {}),
            "mass_scale": 1.0 + self.mass * unit[both],
            "friction_nm": self.joint_friction * up[:, 6:18].reshape(-1, 2, 6) * np.array(JOINT_FRICTION_NM),
            "lookahead_scale": lookahead,
            "latency_s": latency,
            "jitter_s": np.full((len(rngs), 2), self.jitter_s),
            "base_shift_m": self.base_shift_m * unit[:, 18:24].reshape(-1, 2, 3),
            "base_turn_rad": self.base_turn_rad * unit[:, 24:26],
            "object_mass_scale": 1.0 + self.object_mass * unit[:, 26],
            "grip_friction_scale": 1.0 + self.grip_friction * unit[:, 27:29],
            "observation_delay_s": self.observation_delay_s * up[:, 29],
            "object_offset_m": self.object_noise_m * normal[:, :, 0],
            "object_offset_rad": self.object_noise_rad * normal[:, :, 1],
        }


def apply_sample(plant: Mapping[str, Array], sampled: Mapping[str, Array]) -> dict[str, Array]:
    """Apply sampled values on top of those of `Perturbation`; return {} if nothing was sampled."""
    return {
        name: value * sampled[name] if name.endswith("_scale") else value + sampled[name]
        for name, value in plant.items()
        if name in sampled
    }


PRESETS: Final = {
    "none": Randomization(),
    "mild": Randomization(
        mass=0.03,
        joint_friction=0.5,
        lookahead=0.03,
        latency_s=0.004,
        skew_s=0.001,
        jitter_s=0.002,
        joint_noise_rad=5e-5,
        joint_speed_noise_rad_s=5e-3,
        object_noise_m=0.001,
        object_noise_rad=0.005,
        observation_delay_s=0.004,
        base_shift_m=0.0005,
        base_turn_rad=0.0005,
        object_mass=0.1,
        grip_friction=0.2,
        light=0.15,
        colour=0.1,
        camera_shift_m=0.005,
        camera_turn_rad=0.01,
    ),
    "wide": Randomization(
        mass=0.1,
        joint_friction=1.0,
        lookahead=0.1,
        latency_s=0.016,
        skew_s=0.004,
        jitter_s=0.008,
        joint_noise_rad=2e-4,
        joint_speed_noise_rad_s=2e-2,
        object_noise_m=0.002,
        object_noise_rad=0.0175,
        observation_delay_s=0.016,
        base_shift_m=0.002,
        base_turn_rad=0.002,
        object_mass=0.3,
        grip_friction=0.4,
        object_spread=1.5,
        light=0.4,
        colour=0.3,
        camera_shift_m=0.02,
        camera_turn_rad=0.03,
    ),
}
"""Named randomizations. "mild" is about the deviation of well maintained arms from their model; "wide" is several times
that, for training robust policies."""


def resolve_randomization(value: object) -> Randomization:
    """Resolve the keyword `randomization`.

    A mapping may name a preset to start from: `{"preset": "mild", "mass": 0.1}`.

    Raises:
        UnknownNameError: Neither a preset nor a mapping of known values.
        SettingsError: A value is not possible.
    """
    if isinstance(value, Randomization):
        return value
    if isinstance(value, Mapping):
        values = dict(value)
        preset = resolve_randomization(values.pop("preset", "none"))
        known = [each.name for each in dataclasses.fields(Randomization)]
        for name in values:
            if name not in known:
                raise UnknownNameError("randomization", str(name), ["preset", *known])
        return dataclasses.replace(preset, **values)
    if not isinstance(value, str) or value not in PRESETS:
        raise UnknownNameError("randomization", str(value), list(PRESETS), "a mapping of values")
    return PRESETS[value]
