"""Poses of tools and of what they hold, and what both arms feel of it: shared by the tasks with grippers."""

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
"""How near fingers that pick something up may come to the table."""

PICKING: Final = {(f"{arm}/fingers", "table"): _TABLE_M for arm in ("left", "right")}
"""Smallest legal distances of hands that pick something up from the table."""

_WIDTH_MARGIN_M: Final = 0.001  # fingers that hold are stopped by what they hold


def tools(state: CellState) -> Poses:
    """Tool centre points in the cell frame, (n, 2, ...), with the flanges' orientations."""
    quat = required(state.flange_quat)
    return Poses(state.flange_m + rotate(quat, np.broadcast_to(TCP_LEVER, state.flange_m.shape)), quat)


def flanges_of(tools: Poses) -> Poses:
    """Flanges of tools, both in one frame."""
    away = rotate(tools.quat, np.broadcast_to(TCP_LEVER, tools.position_m.shape))
    return Poses(tools.position_m - away, tools.quat)


def between_fingers(grip_in_tool_m: Array) -> Mask:
    """(...) whether what a gripper is to hold is between its fingers, open or not.

    Args:
        grip_in_tool_m: (..., 3) where on the object the gripper should be, in its tool's frame.
    """
    near = np.abs(grip_in_tool_m) < np.array([0.06, OPENING_M / 4, PAD_LENGTH_M * 0.75])
    result: Mask = np.logical_and.reduce(near, axis=-1)
    return result


def holds(state: CellState, grip_in_tool_m: Array, width_m: float) -> Mask:
    """(n, 2) whether a gripper's fingers are on what it is to hold.

    Args:
        state: What was measured.
        grip_in_tool_m: (n, 2, 3) where on the object the gripper should be, in its tool's frame.
        width_m: Width of the object there.
    """
    on_it: Mask = np.abs(required(state.gripper_m) - width_m) < _WIDTH_MARGIN_M
    return on_it & between_fingers(grip_in_tool_m)


def required(values: Array | None) -> Array:
    """Values that a cell with grippers always has.

    Raises:
        SettingsError: They are missing.
    """
    if values is None:
        raise SettingsError("this cell has no grippers: a task with objects needs a cell with its equipment")
    return values
