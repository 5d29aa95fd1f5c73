"""Settings between the hands of an operator and the arms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from dual_ur10.envs.tasks.task import check_numbers
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.operators.device import FULL_TWIST
from ur_core.types import Array, constant

Frame = Literal["cell", "base", "tool"]
Arms = Literal["both", "left", "right", "mirrored", "held"]

MIRRORED: Final = constant([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
"""(6,) signs of a twist's mirror image across the plane y = 0."""


@dataclass(frozen=True, kw_only=True)
class Mapping:
    """Settings of an operator.

    Attributes:
        frame: Axes of the device's speeds: those of the "cell", of each arm's own "base" (its `base_link`), or of each
            commanded "tool", whose z points out of the gripper.
        yaw_rad: Rotation of the device's axes about their z, for an operator who does not look along the x of the cell
            (rad).
        scale: Factor on speeds of translation, 0.01 to 1. At 1 full deflection is 0.25 m/s.
        turn_scale: Factor on speeds of rotation, 0 to 1. At 1 full deflection is 0.5 rad/s.
        dead_zone: Fraction of the deflection, 0 to 0.5, below which an axis counts as at rest. The rest is stretched.
        mirror: Exchange left and right of the device, as in a mirror across the plane y = 0.
        arms: Arms that the device leads. "both": each hand its own; a device for one hand leads one arm at a time, and
            its button "switch" passes it on. "left", "right": only this arm. "mirrored": the first hand leads both, the
            right arm as its mirror image. "held": the first hand moves an object that both grippers hold; the pose of
            one grip in the other stays.

    Raises:
        SettingsError: A value is not legal.
        UnknownNameError: `frame` or `arms` is none of its names.
    """

    frame: Frame = "cell"
    yaw_rad: float = 0.0
    scale: float = 1.0
    turn_scale: float = 1.0
    dead_zone: float = 0.08
    mirror: bool = False
    arms: Arms = "both"

    def __post_init__(self) -> None:
        for name, choices in (("frame", get_args(Frame)), ("arms", get_args(Arms))):
            if getattr(self, name) not in choices:
                raise UnknownNameError(f"{name} of an operator", str(getattr(self, name)), choices)
        if not isinstance(self.mirror, bool):
            raise SettingsError(f"mirror of an operator is {self.mirror!r}: it must be True or False")
        check_numbers(
            self,
            ("yaw_rad", -math.pi, math.pi),
            ("scale", 0.01, 1.0),
            ("turn_scale", 0.0, 1.0),
            ("dead_zone", 0.0, 0.5),
        )

    def speeds(self, twist: Array) -> Array:
        """Return speeds, (..., 6) m/s and rad/s, along the axes of the frame, from those of the device.

        Neither the speed nor the angular speed exceeds that of full deflection along one axis.
        """
        share = twist / FULL_TWIST
        beyond = np.maximum(np.abs(share) - self.dead_zone, 0.0) / (1.0 - self.dead_zone)
        share = np.copysign(beyond, share)
        if self.mirror:
            share = share * MIRRORED
        vectors = share.reshape(*share.shape[:-1], 2, 3)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        vectors = vectors @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        vectors = vectors / np.maximum(1.0, np.linalg.norm(vectors, axis=-1, keepdims=True))
        scaled = vectors * np.array([[self.scale], [self.turn_scale]])
        result: Array = scaled.reshape(share.shape) * FULL_TWIST
        return result
