"""Cartesian steps of a tool as joint goals, which shrink near singularities and end before them."""

from __future__ import annotations

from typing import Final

import numpy as np

from ur_core.kinematics import flange_pose, try_nearest
from ur_core.kinematics.forward import pose_and_jacobian
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array

SLOW_CONDITION: Final = 17.0
"""Condition number of the flange's Jacobian, in m and rad, from which on steps shrink: that of MoveIt Servo."""

HALT_CONDITION: Final = 30.0
"""Condition number at which no step is left: that of MoveIt Servo. The tasks' scripted policies stay below 10."""

_ROUNDING: Final = 1.0 + 1e-6  # rotating the base changes only the last digits of the condition
_FRACTIONS: Final = np.arange(9) / 8


def condition(q_rad: Array, dh: DHParameters) -> Array:
    """Return the condition number of the Jacobian, (n,), at joint angles (n, 6)."""
    values = np.linalg.svd(pose_and_jacobian(q_rad, dh)[2], compute_uv=False)
    result: Array = values[:, 0] / np.maximum(values[:, -1], np.finfo(np.float64).tiny)
    return result


def fraction_of_step(q_rad: Array, step_rad: Array, ahead: float, dh: DHParameters) -> Array:
    """Return the fraction of a joint step that may be taken, (n,), in eighths.

    A step that leads away from singularities, or is far from any, is taken whole. Another one is reduced until the
    condition allows every configuration on the stopping path, along which the arm would coast at the same step.

    Args:
        q_rad: (n, 6) joint angles.
        step_rad: (n, 6) whole step.
        ahead: Stopping path in steps.
        dh: Kinematics of the arm.
    """
    path = q_rad[:, None] + _FRACTIONS[:, None] * (ahead * step_rad)[:, None]
    on_path = condition(path.reshape(-1, 6), dh).reshape(len(q_rad), len(_FRACTIONS))
    here = on_path[:, :1] * _ROUNDING
    allowed = np.maximum(HALT_CONDITION - _FRACTIONS * (HALT_CONDITION - SLOW_CONDITION), here)
    legal = np.maximum.accumulate(on_path, axis=1) <= allowed
    fraction: Array = (legal * _FRACTIONS).max(axis=1)
    return fraction


def goal_of_step(
    q_rad: Array, step_m: Array, rotation_rad: Array, ahead: float, dh: DHParameters, tcp_m: float = 0.0
) -> Array:
    """Return joint goals, (n, 6), of Cartesian steps; `q_rad` where a step is out of reach.

    Args:
        q_rad: (n, 6) joint angles.
        step_m: (n, 3) translation of the tool centre point in the arm's `base` frame.
        rotation_rad: (n, 3) rotation vector about it, in that frame.
        ahead: Stopping path in steps, see `fraction_of_step`.
        dh: Kinematics of the arm.
        tcp_m: Distance of the tool centre point before the flange.
    """
    position, rotation = flange_pose(q_rad, dh)
    goal = _moved(position, rotation, step_m, rotation_rad, q_rad, dh, tcp_m)
    fraction = fraction_of_step(q_rad, goal - q_rad, ahead, dh)[:, None]
    slow = np.flatnonzero(fraction < 1.0)
    if slow.size:
        part = fraction[slow]
        goal[slow] = _moved(
            position[slow], rotation[slow], part * step_m[slow], part * rotation_rad[slow], q_rad[slow], dh, tcp_m
        )
    return goal


def _moved(
    position: Array, rotation: Array, step: Array, rotvec: Array, here: Array, dh: DHParameters, tcp_m: float
) -> Array:
    wanted = quat_to_matrix(quat_from_rotvec(rotvec[:, None]))[:, 0] @ rotation
    q, reached = try_nearest(position + step + tcp_m * (rotation - wanted)[..., 2], wanted, here, dh)
    return np.where(reached[:, None], q, here)
