"""Tool poses and grasp conditions, shared by the tasks with grippers."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.assets.gripper import OPENING_M, PAD_LENGTH_M, TCP_M
from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import rotate
from dual_ur10.sim2real.config.cell import CellState
from dual_ur10.types import Array, Mask

TCP_LEVER: Final[Array] = np.array([0.0, 0.0, TCP_M])

_TABLE_M: Final = 5e-4
"""Smallest legal distance of fingers from the table while they grasp."""

PICKING: Final = {(f"{arm}/fingers", "table"): _TABLE_M for arm in ("left", "right")}
"""Smallest legal distances of grippers that grasp an object on the table."""

_WIDTH_MARGIN_M: Final = 0.001  # of fingers that an object stops


def tools(state: CellState) -> Poses:
    """Return the tool centre points in the cell frame, (n, 2, ...), with the flanges' orientations."""
    quat = required(state.flange_quat)
    return Poses(state.flange_m + rotate(quat, np.broadcast_to(TCP_LEVER, state.flange_m.shape)), quat)


def flanges_of(tools: Poses) -> Poses:
    """Return the flange poses of tool poses, in the same frame."""
    away = rotate(tools.quat, np.broadcast_to(TCP_LEVER, tools.position_m.shape))
    return Poses(tools.position_m - away, tools.quat)


def between_fingers(grip_in_tool_m: Array) -> Mask:
    """Return a mask, (...), of grips that are between the fingers of their gripper, open or closed.

    Args:
        grip_in_tool_m: (..., 3) position of the grip on the object in the frame of the tool.
    """
    near = np.abs(grip_in_tool_m) < np.array([0.06, OPENING_M / 4, PAD_LENGTH_M * 0.75])
    result: Mask = np.logical_and.reduce(near, axis=-1)
    return result


def holds(state: CellState, grip_in_tool_m: Array, width_m: float) -> Mask:
    """Return a mask, (n, 2), of grippers whose fingers hold the object.

    Args:
        state: Measured state.
        grip_in_tool_m: (n, 2, 3) position of the grip on the object in the frame of the tool.
        width_m: Width of the object at the grip.
    """
    touching: Mask = np.abs(required(state.gripper_m) - width_m) < _WIDTH_MARGIN_M
    return touching & between_fingers(grip_in_tool_m)


def required(values: Array | None) -> Array:
    """Return values that a cell with grippers always has.

    Raises:
        SettingsError: The values are missing.
    """
    if values is None:
        raise SettingsError("this cell has no grippers: a task with objects needs a cell with its equipment")
    return values
