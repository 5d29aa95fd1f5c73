"""Steps of a flange become smaller where the arm comes near a singularity, and end before it."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.kinematics.forward import pose_and_jacobian
from dual_ur10.kinematics.ur10 import DHParameters
from dual_ur10.types import Array

SLOW_CONDITION: Final = 17.0
"""Condition number of the flange's Jacobian, in m and rad, from which on steps become smaller: that of MoveIt Servo."""

HALT_CONDITION: Final = 30.0
"""The same, at which there are none any more: that of MoveIt Servo. The tasks' scripted policies stay below 10."""

_SAME: Final = 1.0 + 1e-6  # turning the base changes nothing but the last digits
_SHARES: Final = np.arange(9) / 8


def condition(q_rad: Array, dh: DHParameters) -> Array:
    """How near an arm is to a singularity: (n,) largest by smallest singular value of its Jacobian at (n, 6) angles."""
    values = np.linalg.svd(pose_and_jacobian(q_rad, dh)[2], compute_uv=False)
    result: Array = values[:, 0] / np.maximum(values[:, -1], np.finfo(np.float64).tiny)
    return result


def share_of_step(q_rad: Array, step_rad: Array, ahead: float, dh: DHParameters) -> Array:
    """How much of a step may be gone, (n,), in eighths.

    All of a step that leads away from singularities, or is far from any; of another, as much as the condition allows
    everywhere on the way on which the arm, going on with as much in every period, could still come to rest.

    Args:
        q_rad: (n, 6) where the arm is.
        step_rad: (n, 6) the whole step.
        ahead: Steps that the arm goes until it has come to rest.
        dh: Its kinematics.
    """
    way = q_rad[:, None] + _SHARES[:, None] * (ahead * step_rad)[:, None]
    on_way = condition(way.reshape(-1, 6), dh).reshape(len(q_rad), len(_SHARES))
    here = on_way[:, :1] * _SAME
    allowed = np.maximum(HALT_CONDITION - _SHARES * (HALT_CONDITION - SLOW_CONDITION), here)
    may = np.maximum.accumulate(on_way, axis=1) <= allowed
    share: Array = (may * _SHARES).max(axis=1)
    return share
