"""Check that both arms can put their tools where a task needs them, before an episode begins."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.tasks.geometry import flanges_of
from dual_ur10.errors import WorkspaceError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics import try_nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, yaw_quat
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import levers_m
from ur_core.types import Array


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
    mounts, equipment = (cell.left, cell.right), cell.equipment
    levers = levers_m(equipment.tools) if equipment.grippers else np.zeros((2, 3))
    frames, home = Frames(mounts), home_q_rad(mounts)
    for place, tools in places.items():
        flange = flanges_of(tools, levers)
        position = frames.position_to_base(flange.position_m)
        rotation = quat_to_matrix(frames.quat_to_base(flange.quat))
        for arm, mount in enumerate(mounts):
            near = np.tile(home[arm], (len(position), 1))
            _, reached = try_nearest(position[:, arm], rotation[:, arm], near, mount.dh)
            if not reached.all():
                x, y, z = tools.position_m[~reached, arm][0]
                raise WorkspaceError(
                    f"the {ARMS[arm]} arm, {mount.robot}, cannot reach {place} at ({x:.3g}, {y:.3g}, {z:.3g}) m: "
                    "choose longer arms, such as ur10e, smaller ranges, or move its base"
                )
