"""Home configuration of each model: elbow up, tool straight down, in front of the base."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from ur_core.kinematics.inverse import try_nearest
from ur_core.kinematics.robots import ROBOTS, robot_model
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.types import Array, constant

# Elbow up, tool z straight down, flange x towards the base: the rotation vector (pi, 0, 0) in UR's base frame.
_HOME: Final = (-0.22036724, -1.4126697, 1.84438035, -2.00250698, -math.pi / 2, 1.35042908)

FRONT_M: Final = 0.75
"""Distance of a UR10's flange from its base at home, along the base's axis towards the workspace."""

_UP_M: Final = 0.4  # above the base
_TOOL_DOWN: Final = np.diag([1.0, -1.0, -1.0])


def reach_ratio(robot: str) -> float:
    """Return the reach of a model in that of a UR10.

    Raises:
        UnknownNameError: There is no such model.
    """
    return robot_model(robot).reach_m / ROBOTS["ur10"].reach_m


@lru_cache(maxsize=len(ROBOTS))
def home_of(robot: str) -> Array:
    """Return the home configuration, (6,): flange 0.4 m above the base, before it in proportion to the model's reach.

    Raises:
        UnknownNameError: There is no such model.
    """
    if robot == "ur10":
        return constant(_HOME)
    place = (-FRONT_M * reach_ratio(robot), 0.0, _UP_M)
    q, _ = try_nearest(place, _TOOL_DOWN, _HOME, nominal_dh(robot))  # a test holds that all reach it
    return constant(q)
