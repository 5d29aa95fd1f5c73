"""Measurement of grasps: both arms and the objects between their fingers, all rows at once."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.geometry import check_indices
from dual_ur10.errors import SettingsError
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import Tool, strokes_m
from ur_core.types import Array, Mask

_WIDTH_MARGIN_M: Final = 0.001  # of fingers that an object stops
CLEARANCE_M: Final = 0.007
"""Width on both sides together by which open fingers are clear of an object."""


def _between_m(tool: Tool) -> list[float]:
    """Return the largest distances of a grip between the fingers from the tool centre point, along the tool's axes."""
    return [0.06, tool.stroke_m / 4, tool.pad_m[2] * 0.75]


class Grasped(NamedTuple):
    """Both arms and k objects, relative to each other.

    A frame is 12 numbers: a position in m, then a rotation matrix by rows. The columns of the matrix are the axes.

    Attributes:
        tools: (n, 2, 12) frames of the tools in the cell frame.
        frames: (n, k, 12) frames of the objects in the cell frame.
        other_flange: (n, 2, 7) pose of the other flange in each flange's frame: position and quaternion.
        grip_in_tool_m: (n, 2, 3) position of each arm's grip on its object, in its tool's frame.
        between: (n, 2) True if the grip is between the fingers of its gripper, open or closed.
        holding: (n, 2) True if the fingers hold the object there.
        opened: (n, 2) 0 for fingers at the object's width or below it, to 1 fully open.
        closed: (n, 2) 1 for fingers at the object's width, 0 fully open or closed beyond it.
        cleared: (n, 2) 0 for fingers at the object's width to 1 once they are clear of it, 7 mm wider.
        in_bases: (n, 2, k, 7) poses of the objects in the `base` frame of each arm.
    """

    tools: Array
    frames: Array
    other_flange: Array
    grip_in_tool_m: Array
    between: Mask
    holding: Mask
    opened: Array
    closed: Array
    cleared: Array
    in_bases: Array


class Grasps:
    """Measurement of grasps in n cells.

    Args:
        frames: Frames of both arms.
        grip_m: (n, 2, 3) position of each arm's grip in the frame of its object; later changes count.
        width_m: Width of the object at both grips, or at each.
        objects: Number k of objects, or of other poses.
        held: Index of the object that each arm grips.
        tools: Tools of both arms.

    Raises:
        SettingsError: A tool does not open beyond the object and `CLEARANCE_M`, or an index is beyond the objects.
    """

    def __init__(
        self,
        frames: Frames,
        grip_m: Array,
        width_m: float | tuple[float, float],
        objects: int,
        held: tuple[int, int] = (0, 0),
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        check_indices("held", held, objects)
        widths_m = np.broadcast_to(np.asarray(width_m, dtype=np.float64), 2).copy()
        for arm, tool, width in zip(ARMS, tools, widths_m.tolist(), strict=True):
            if tool.stroke_m < width + CLEARANCE_M:
                raise SettingsError(
                    f"the {arm} tool {tool.name!r} opens by {tool.stroke_m:g} m: to take and leave an object of "
                    f"{width:g} m it needs {width + CLEARANCE_M:g} m or more. Mount another tool"
                )
        n = len(grip_m)
        self._flange_m, self._flange_quat = np.zeros((n, 2, 3)), np.zeros((n, 2, 4))
        self._opening_m, self._poses = np.zeros((n, 2)), np.zeros((n, objects, 7))
        # Each an array of its own: a pickled structure shares whole arrays, but no views.
        shapes = (2, 12), (objects, 12), (2, 7), (2, 3), *[(2,)] * 5, (2, objects, 7)
        self._found = found = Grasped._make(np.zeros((n, *shape)) for shape in shapes)
        struct = Struct(
            "Grasps",
            n=n,
            objects=objects,
            width_margin_m=_WIDTH_MARGIN_M,
            tcp_m=np.array([each.tcp_m for each in tools]),
            between_m=np.array([_between_m(each) for each in tools]),
            width_m=widths_m,
            held=np.array(held, dtype=np.int64),
            most_m=np.array(strokes_m(tools)),
            clearance_m=CLEARANCE_M,
            base_m=frames.base_m,
            to_base=np.ascontiguousarray(frames.rotation),
            quat_to_base=frames.quat_products,
            grip_m=grip_m,
            flange_m=self._flange_m,
            flange_quat=self._flange_quat,
            opening_m=self._opening_m,
            poses=self._poses,
            **found._asdict(),
        )
        self._measure = RowLoop("grasps_measure", struct, n, 1)

    def __call__(self, flanges: Poses, opening_m: Array | None, poses: Array) -> Grasped:
        """Measure flanges, (n, 2, ...), openings, (n, 2), and objects, (n, k, 7), in the cell frame.

        Args:
            flanges: Poses of both flanges.
            opening_m: Widths between the fingers; None: nothing that is welded has one.
            poses: Position and quaternion of each object.
        """
        self._flange_m[...], self._flange_quat[...], self._poses[...] = *flanges, poses
        if opening_m is not None:
            self._opening_m[...] = opening_m
        self._measure()
        tools, frames, other_flange, grip_in_tool_m, between, holding, opened, closed, cleared, in_bases = self._found
        return Grasped(
            tools.copy(),
            frames.copy(),
            other_flange.copy(),
            grip_in_tool_m.copy(),
            between > 0.0,
            holding > 0.0,
            opened.copy(),
            closed.copy(),
            cleared.copy(),
            in_bases.copy(),
        )
