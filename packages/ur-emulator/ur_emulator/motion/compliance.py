"""Admittance of the TCP in force mode and freedrive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ur_core.kinematics.rotations import cross
from ur_core.types import Array, constant
from ur_emulator.motion.tool_kinematics import Frame

# UR publishes none of these. Modest values keep a stiff contact stable at 8 ms.
FORCE_DAMPING: Final = constant([500.0, 500.0, 500.0, 20.0, 20.0, 20.0])  # N s/m, N m s/rad
FREE_DAMPING: Final = constant([100.0, 100.0, 100.0, 5.0, 5.0, 5.0])
FREE_FRICTION: Final = constant([4.0, 4.0, 4.0, 0.4, 0.4, 0.4])  # N, N m: smaller wrenches do not move the arm
SPEED_CAP: Final = constant([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])  # m/s, rad/s
TIME_CONSTANT_S: Final = 0.05
_WRENCH_CAP: Final = 1e4


@dataclass
class Compliance:
    """Admittance: wrenches cause speeds, in selected axes of a frame.

    Attributes:
        frame: Compliance frame, in base.
        kind: UR's types. 1: y points from the TCP to the frame's origin. 2: the frame as given. 3: x is the direction
            of the TCP's speed in the frame's x-y plane.
        axes: (6,) 1 in compliant axes, else 0.
        wanted: (6,) wrench that the arm exerts in them, in the frame.
        limits: (6,) greatest speeds in them.
        damping: (6,) wrench per speed.
        friction: (6,) wrench below which the arm does not move.
    """

    frame: Frame
    kind: int
    axes: Array
    wanted: Array
    limits: Array
    damping: Array
    friction: Array

    def twist(self, wrench: Sequence[float] | Array | None, tcp: Frame, speed: Array) -> Array:
        """Return the speed (6,) of the TCP in base.

        Args:
            wrench: (6,) wrench of the environment on the TCP, in base's axes; None: no wrench.
            tcp: Pose of the TCP.
            speed: (3,) speed of the TCP, m/s.
        """
        rotation = self._rotation(tcp, speed)
        net = self.wanted.copy()
        if wrench is not None:
            felt = np.clip(np.nan_to_num(wrench), -_WRENCH_CAP, _WRENCH_CAP).reshape(2, 3)
            net += (felt @ rotation).reshape(6)
        net -= np.clip(net, -self.friction, self.friction)
        local = np.clip(self.axes * net / self.damping, -self.limits, self.limits)
        twist: Array = (local.reshape(2, 3) @ rotation.T).reshape(6)
        return twist

    def _rotation(self, tcp: Frame, speed: Array) -> Array:
        rotation = self.frame.rotation
        if self.kind == 1:
            axis = self.frame.position - tcp.position
            other = rotation[:, 2]
        elif self.kind == 3:
            local = rotation.T @ speed
            local[2] = 0.0
            axis, other = rotation @ local, rotation[:, 2]
        else:
            return rotation
        length = math.sqrt(float(axis @ axis))
        if length < 1e-4:
            return rotation
        axis = axis / length
        third = other - (other @ axis) * axis
        length = math.sqrt(float(third @ third))
        if length < 1e-6:
            return rotation
        third = third / length
        columns = (axis, cross(third, axis), third) if self.kind == 3 else (cross(axis, third), axis, third)
        return np.column_stack(columns)
