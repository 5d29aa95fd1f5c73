"""Geometry of grasps and their conditions, shared by the tasks with grippers."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.gripper import OPENING_M, PAD_LENGTH_M, TCP_M
from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import quat_between, quat_to_matrix, rotate
from dual_ur10.sim2real.config.cell import CellState
from dual_ur10.types import Array, Mask

TCP_LEVER: Final[Array] = np.array([0.0, 0.0, TCP_M])

_TABLE_M: Final = 5e-4
"""Smallest legal distance of fingers from the table while they grasp."""

PICKING: Final = {(f"{arm}/fingers", "table"): _TABLE_M for arm in ("left", "right")}
"""Smallest legal distances of grippers that grasp an object on the table."""

_WIDTH_MARGIN_M: Final = 0.001  # of fingers that an object stops


_BETWEEN_M: Final = np.array([0.06, OPENING_M / 4, PAD_LENGTH_M * 0.75])
"""Largest distances of a grip from the tool centre point, along the axes of the tool, between the fingers."""


class GraspGeometry(NamedTuple):
    """Both arms and the object, relative to each other.

    Attributes:
        other_flange: (n, 2, 7) pose of the other flange in each flange's frame: position and quaternion.
        grip_in_tool_m: (n, 2, 3) position of each arm's grip on the object in its tool's frame.
    """

    other_flange: Array
    grip_in_tool_m: Array


def rotations_of(state: CellState, poses: Array) -> Array:
    """Return the rotations, (n, 2 + k, 3, 3), of both flanges and of k poses, (n, 7 k), in the cell frame."""
    quat = poses.reshape(len(poses), -1, 7)[..., 3:]
    return quat_to_matrix(np.concatenate([required(state.flange_quat), quat], axis=1))


def grasp_geometry(state: CellState, rotations: Array, grip_m: Array) -> GraspGeometry:
    """Compute where flanges and grips are relative to each other.

    Args:
        state: Measured state.
        rotations: (n, 3 or more, 3, 3) rotations of both flanges and the object in the cell frame.
        grip_m: (n, 2, 3) or (2, 3) position of each arm's grip in the object's frame.
    """
    flange_m, quat, n = state.flange_m, required(state.flange_quat), len(rotations)
    # From each flange to the other one, and to its grip.
    away = np.empty((n, 2, 2, 3))
    np.subtract(flange_m[:, ::-1], flange_m, out=away[:, :, 0])
    np.matmul(grip_m, rotations[:, 2].swapaxes(1, 2), out=away[:, :, 1])
    away[:, :, 1] += required(state.object_m)[:, None] - flange_m
    inside = away @ rotations[:, :2]
    other = np.empty((n, 2, 7))
    other[..., :3], other[..., 3:] = inside[:, :, 0], quat_between(quat, quat[:, ::-1])
    inside[:, :, 1, 2] -= TCP_M
    return GraspGeometry(other, inside[:, :, 1])


def flanges_of(tools: Poses) -> Poses:
    """Return the flange poses of tool poses, in the same frame."""
    away = rotate(tools.quat, np.broadcast_to(TCP_LEVER, tools.position_m.shape))
    return Poses(tools.position_m - away, tools.quat)


def between_fingers(grip_in_tool_m: Array) -> Mask:
    """Return a mask, (...), of grips that are between the fingers of their gripper, open or closed.

    Args:
        grip_in_tool_m: (..., 3) position of the grip on the object in the frame of the tool.
    """
    result: Mask = np.logical_and.reduce(np.abs(grip_in_tool_m) < _BETWEEN_M, axis=-1)
    return result


def holds(state: CellState, between: Mask, width_m: float) -> Mask:
    """Return a mask, (n, 2), of grippers whose fingers hold the object.

    Args:
        state: Measured state.
        between: (n, 2) result of `between_fingers`.
        width_m: Width of the object at the grip.
    """
    touching: Mask = np.abs(required(state.gripper_m) - width_m) < _WIDTH_MARGIN_M
    return touching & between


def required(values: Array | None) -> Array:
    """Return values that a cell with grippers always has.

    Raises:
        SettingsError: The values are missing.
    """
    if values is None:
        raise SettingsError("this cell has no grippers: a task with objects needs a cell with its equipment")
    return values
