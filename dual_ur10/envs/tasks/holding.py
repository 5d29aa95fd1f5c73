"""Geometry of grasps and their conditions, shared by the tasks with grippers."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool, levers_m
from dual_ur10.errors import SettingsError
from dual_ur10.kernel import RowLoop, Struct
from dual_ur10.kinematics.frames import Frames
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import rotate
from dual_ur10.sim2real.config.cell import CellState
from dual_ur10.types import Array, Mask

APPROACH_M: Final = 0.1
"""Length of the straight approach of a tool to its grip."""

LEARNERS_ROOM_M: Final = 0.013
"""Height of learners' grips above the task's: fingers pass the table at 4 and 7 mm, less than learners err."""

_TABLE_M: Final = 5e-4
"""Smallest legal distance of fingers from the table while they grasp."""

PICKING: Final = {(f"{arm}/fingers", "table"): _TABLE_M for arm in ("left", "right")}
"""Smallest legal distances of grippers that grasp an object on the table."""

_WIDTH_MARGIN_M: Final = 0.001  # of fingers that an object stops


def _between_m(tool: Tool) -> list[float]:
    """Return the largest distances of a grip between the fingers from the tool centre point, along the tool's axes."""
    return [0.06, tool.stroke_m / 4, tool.pad_m[2] * 0.75]


class Grasped(NamedTuple):
    """Both arms and the object, relative to each other.

    Attributes:
        other_flange: (n, 2, 7) pose of the other flange in each flange's frame: position and quaternion.
        grip_in_tool_m: (n, 2, 3) position of each arm's grip on the object in its tool's frame.
        between: (n, 2) True if the grip is between the fingers of its gripper, open or closed.
        holding: (n, 2) True if the fingers hold the object there.
        rotations: (n, 2, 3, 3) rotations of the first two poses in the cell frame.
        in_bases: (n, 2, 7 k) poses in the `base` frame of each arm.
        values: (n, 42 + 14 k) all of these in their order, as the kernel takes them.
    """

    other_flange: Array
    grip_in_tool_m: Array
    between: Mask
    holding: Mask
    rotations: Array
    in_bases: Array
    values: Array


class Grasps:
    """Measurement of flanges, grips and poses of n cells.

    Args:
        frames: Frames of both arms.
        grip_m: (n, 2, 3) position of each arm's grip in the object's frame; later changes count.
        width_m: Width of the object at the grips.
        poses: Number k of poses: the object's, and at least another one.
        tools: Tools of both arms.
    """

    def __init__(
        self,
        frames: Frames,
        grip_m: Array,
        width_m: float,
        poses: int,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        self._n = n = len(grip_m)
        self._input, self._output = np.zeros((n, 16 + 7 * poses)), np.zeros((n, 42 + 14 * poses))
        struct = Struct(
            "Grasps",
            n=n,
            poses=poses,
            inputs=self._input.shape[1],
            outputs=self._output.shape[1],
            tcp_m=np.array([tool.tcp_m for tool in tools]),
            limits=grasp_limits(width_m, tools),
            base_m=frames.base_m,
            to_base=np.ascontiguousarray(frames.rotation),
            quat_to_base=frames.quat_products,
            grip_m=grip_m,
            input=self._input,
            output=self._output,
        )
        self._measure = RowLoop("grasps_measure", struct, n, 1)

    def __call__(self, state: CellState, poses: Array) -> Grasped:
        """Measure a state with poses in the cell frame, (n, 7 k): position and quaternion of each."""
        n, given = self._n, self._input
        given[:, :8] = required(state.flange_quat).reshape(n, 8)
        given[:, 8:14] = state.flange_m.reshape(n, 6)
        if state.gripper_m is not None:  # nothing that is welded has a width
            given[:, 14:16] = state.gripper_m
        given[:, 16:] = poses
        self._measure()
        found = self._output.copy()
        holding = found[:, 20:24] > 0.0
        return Grasped(
            found[:, :14].reshape(n, 2, 7),
            found[:, 14:20].reshape(n, 2, 3),
            holding[:, :2],
            holding[:, 2:],
            found[:, 24:42].reshape(n, 2, 3, 3),
            found[:, 42:].reshape(n, 2, -1),
            found,
        )


def grasp_limits(width_m: float, tools: tuple[Tool, Tool] = DEFAULT_TOOLS) -> Struct:
    """Return the conditions of a grasp of an object with this width at its grips, for the kernel."""
    between_m = np.array([_between_m(tool) for tool in tools])
    return Struct("GraspLimits", width_m=width_m, width_margin_m=_WIDTH_MARGIN_M, between_m=between_m)


def flanges_of(tools: Poses, lever_m: Array | None = None) -> Poses:
    """Return the flange poses of tool poses, in the same frame.

    Args:
        tools: (..., 3) and (..., 4).
        lever_m: Tool centre points in the flange frames: (2, 3) for poses of both arms, (3,) for one; None: those of
            the default tools.
    """
    lever_m = levers_m(DEFAULT_TOOLS)[0] if lever_m is None else lever_m
    away = rotate(tools.quat, np.broadcast_to(lever_m, tools.position_m.shape))
    return Poses(tools.position_m - away, tools.quat)


def required(values: Array | None) -> Array:
    """Return values that a cell with grippers always has.

    Raises:
        SettingsError: The values are missing.
    """
    if values is None:
        raise SettingsError("this cell has no grippers: a task with objects needs a cell with its equipment")
    return values
