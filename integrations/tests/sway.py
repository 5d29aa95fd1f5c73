"""Device that sways both arms by itself, for tests without a person."""

from __future__ import annotations

import math

import numpy as np

from dual_ur10.policies.operators.device import Reading


class Sway:
    """Two hands that lead up and down, and close the grippers for a while."""

    name, hands = "sway", 2

    def __init__(self) -> None:
        self._count = 0

    def begin(self) -> None:
        """Do nothing."""

    def read(self) -> Reading:
        """Return the next reading."""
        self._count += 1
        twist = np.zeros((2, 6))
        twist[:, 2] = 0.05 * math.sin(0.2 * self._count)
        gripper = np.full(2, 0.5 + 0.5 * math.cos(0.1 * self._count))
        return Reading(twist=twist, gripper=gripper, triggers=False, clutch=np.ones(2, dtype=bool))

    def close(self) -> None:
        """Do nothing."""
