"""Torque control of the joints: `direct_torque`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ur_core.errors import MotionError
from ur_core.kinematics.robots import robot_model
from ur_core.types import Array
from ur_emulator.motion.arguments import six
from ur_emulator.motion.trajectories import JointTorques, Trajectory


def checked_torques(
    robot: str, torque: Iterable[Any], viscous_scale: Iterable[Any], coulomb_scale: Iterable[Any]
) -> JointTorques:
    """Return the torques of a command.

    Args:
        robot: Model of the arm.
        torque: (6,) N·m, each within the joint's largest torque.
        viscous_scale: (6,) fraction of the viscous friction, 0 to 1. The simulated joints have none to compensate.
        coulomb_scale: (6,) fraction of the Coulomb friction, 0 to 1.

    Raises:
        MotionError: A value is not finite or out of bounds.
    """
    torques, most = np.array(six(torque, "the torque of direct_torque")), np.array(robot_model(robot).joint_torque_nm)
    if (np.abs(torques) > most).any():
        joint = int((np.abs(torques) / most).argmax())
        raise MotionError(
            f"the torque of direct_torque is {torques[joint]:g} N·m at joint {joint}: allowed are ±{most[joint]:g}"
        )
    scales = []
    for name, values in (("viscous_scale", viscous_scale), ("coulomb_scale", coulomb_scale)):
        found = np.array(six(values, f"{name} of direct_torque"))
        if ((found < 0.0) | (found > 1.0)).any():
            raise MotionError(f"{name} of direct_torque is {found.tolist()}: allowed are 0 to 1 for each joint")
        scales.append(found)
    return JointTorques(torques, scales[1])


class TorqueStream(Trajectory):
    """Motion under torques, which act for one control period.

    Where the arm goes follows from its physics. The positions here extrapolate the measured motion: the limits of
    joint positions and speeds are checked with them.

    Args:
        start: (6,) measured joint positions.
        rate: (6,) measured joint speeds.
        torques: Torques of this control period.
    """

    streamed = True
    duration = float("inf")

    def __init__(self, start: Array, rate: Array, torques: JointTorques) -> None:
        self._start, self._rate, self.torques = start, rate, torques
        self.ticks_left = 1

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        q: Array = self._start + (self.t + step * counts)[:, None] * self._rate
        return q

    def rate(self) -> Array:
        """Return the joint speeds (6,) now."""
        return self._rate

    @property
    def returns(self) -> bool:
        """True once the command returns to its program."""
        return self.ticks_left <= 0
