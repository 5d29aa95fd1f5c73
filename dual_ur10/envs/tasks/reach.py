"""Reach of both arms: joint positions that put their tools at poses, and the refusal of a task out of reach."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.tasks.geometry import flanges_of
from dual_ur10.errors import WorkspaceError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics import try_nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, length, yaw_quat
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.tools.tool import levers_m
from ur_core.types import Array, Mask

FAR_M: Final = 1.0
"""Largest distance at which a position in reach is looked for."""

_COARSE_M, _FINEST_M, _STARTS, _ROUNDS = 0.08, 1e-4, 8, 100  # of the search for the nearest one
_AROUND: Final = np.array([each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)])


class Reached(NamedTuple):
    """Joint positions for poses of both tools.

    Attributes:
        q_rad: (k, 2, 6) joint positions; where an arm does not reach its pose, those it was searched from.
        reached: (k, 2) True where an arm reaches it.
        flange_m, rotation: (k, 2, 3) and (k, 2, 3, 3) poses of the flanges, each in its arm's `base` frame.
    """

    q_rad: Array
    reached: Mask
    flange_m: Array
    rotation: Array


def tool_levers_m(cell: CellConfig) -> Array:
    """Return the tool centre points in the flange frames, (2, 3); at the flanges of a cell without grippers."""
    return levers_m(cell.equipment.tools) if cell.equipment.grippers else np.zeros((2, 3))


def reach(cell: CellConfig, tools: Poses, near_rad: Array) -> Reached:
    """Return the joint positions nearest to some that put both tools at poses.

    Args:
        cell: The cell.
        tools: Poses in the cell frame, (k, 2, 3) and (k, 2, 4), of the tool centre points of the grippers; of the
            flanges where the cell has none.
        near_rad: (2, 6) joint positions.
    """
    mounts = cell.left, cell.right
    flange, frames = flanges_of(tools, tool_levers_m(cell)), Frames(mounts)
    flange_m = frames.position_to_base(flange.position_m)
    rotation = quat_to_matrix(frames.quat_to_base(flange.quat))
    found = [
        try_nearest(flange_m[:, arm], rotation[:, arm], np.tile(near_rad[arm], (len(flange_m), 1)), mount.dh)
        for arm, mount in enumerate(mounts)
    ]
    q_rad, reached = (np.stack(each, axis=1) for each in zip(*found, strict=True))
    return Reached(q_rad, reached, flange_m, rotation)


def nearest_in_reach(
    position_m: Array, rotation: Array, near_rad: Array, dh: DHParameters
) -> tuple[Array, float] | None:
    """Return joint positions, (6,), of the nearest pose of the same orientation that an arm reaches, to some 5 mm.

    Args:
        position_m: (3,) position of the flange in the arm's `base` frame.
        rotation: (3, 3) its orientation.
        near_rad: (6,) joint positions, to which those of the pose are the nearest ones.
        dh: Kinematics of the arm.

    Returns:
        The joint positions, and the distance of the pose in m; None if there is none within `FAR_M`.
    """

    def among(away_m: Array) -> tuple[Array, Array]:
        """Return those offsets that are in reach, the nearest first, with their joint positions."""
        count = len(away_m)
        q, reached = try_nearest(
            position_m + away_m, np.tile(rotation, (count, 1, 1)), np.tile(near_rad, (count, 1)), dh
        )
        order = np.argsort(length(away_m[reached]))
        return away_m[reached][order], q[reached][order]

    axis = np.arange(-FAR_M, FAR_M + _COARSE_M / 2, _COARSE_M)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets_m, q_rad = among(grid[length(grid) <= FAR_M])
    found = [_refined(*start, among) for start in zip(offsets_m[:_STARTS], q_rad[:_STARTS], strict=True)]
    return min(found, key=lambda each: each[1], default=None)


def _refined(away_m: Array, q_rad: Array, among: Callable[[Array], tuple[Array, Array]]) -> tuple[Array, float]:
    """Return the joint positions of a local minimum of the distance, and the distance; the area has holes and edges."""
    step_m = _COARSE_M / 2
    for _ in range(_ROUNDS):
        shorter = away_m * (1.0 - step_m / max(float(length(away_m)), step_m))
        others_m, others = among(np.vstack([shorter, away_m + step_m * _AROUND]))
        if len(others) and length(others_m[0]) < length(away_m) - 1e-9:
            away_m, q_rad = others_m[0], others[0]
        elif step_m > _FINEST_M:
            step_m /= 2
        else:
            break
    return q_rad, float(length(away_m))


def corners(middle_m: Sequence[float] | Array, range_m: float, turn_rad: float, yaw_rad: float = 0.0) -> Poses:
    """Return the outermost poses, (8, 3) and (8, 4), of an object that lies about a place.

    Args:
        middle_m: (3,) middle of its positions.
        range_m: Largest distance from there, along x and y.
        turn_rad: Largest yaw from `yaw_rad`.
        yaw_rad: Yaw in the middle.
    """
    signs = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    position_m = np.asarray(middle_m) + signs * [range_m, range_m, 0.0]
    return Poses(position_m, yaw_quat(yaw_rad + signs[:, 2] * turn_rad))


def check_reach(cell: CellConfig, places: Mapping[str, Poses]) -> None:
    """Refuse arms that cannot put their tools at poses; what may stand in the way is the safety gate's to measure.

    Args:
        cell: The cell.
        places: Poses of both tools in the cell frame, (k, 2, 3) and (k, 2, 4), by what they are, for the message. A
            tool is at its gripper's tool centre point; where the cell has no grippers, it is the flange.

    Raises:
        WorkspaceError: An arm cannot reach one of them.
    """
    mounts = cell.left, cell.right
    for place, tools in places.items():
        reached = reach(cell, tools, home_q_rad(mounts)).reached
        for row, arm in np.argwhere(~reached)[:1]:
            x, y, z = tools.position_m[row, arm]
            raise WorkspaceError(
                f"the {ARMS[arm]} arm, {mounts[arm].robot}, cannot reach {place} at ({x:.3g}, {y:.3g}, {z:.3g}) m: "
                "choose longer arms, such as ur10e, smaller ranges, or move its base"
            )
