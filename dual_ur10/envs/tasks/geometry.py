"""Geometry of tasks with objects: grasps, steps of tools to their goals, and distances of poses.

Tasks call these for all rows at once. Results are named arrays. The kernel does the arithmetic, row by row: a row does
not depend on the others.

A *frame* is a position and a rotation matrix by rows, (..., 12). A *chord* is 2 sin(angle / 2) of a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.errors import SettingsError
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.forward import links
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses, yaw_quat
from ur_core.kinematics.rotations import quat_to_matrix, rotate
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import Tool, levers_m, strokes_m
from ur_core.types import Array, Mask

APPROACH_M: Final = 0.1
"""Length of the straight approach of a tool to its grip."""

LEARNERS_ROOM_M: Final = 0.013
"""Height of learners' grips above the task's: fingers pass the table at 4 and 7 mm, less than learners err."""

_TABLE_M: Final = 5e-4
"""Smallest legal distance of fingers from the table while they grasp."""

PICKING: Final = {(f"{arm}/fingers", "table"): _TABLE_M for arm in ("left", "right")}
"""Smallest legal distances of grippers that grasp an object on the table."""

LEVER_M: Final = 0.1
"""Lever with which distances include a rotation: 0.1 rad counts as 0.01 m."""

SAME: Final = Poses(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
"""Pose of a frame in itself."""

KEEP: Final = 3.0
"""Factor of the tolerances within which fingers that have begun to close go on."""

_WIDTH_MARGIN_M: Final = 0.001  # of fingers that an object stops
CLEARANCE_M: Final = 0.007
"""Width on both sides together by which open fingers are clear of an object."""
_ARRIVED_M: Final = 0.01  # of the goal: there fingers close or open
_ARRIVED: Final = 0.08  # the same of its rotation, as a chord
_ASIDE: Final = 1.5  # m behind the grip for each m beside the line
_SLACK_M: Final = 0.01  # of such an error, at which a goal is not behind its grip
NEAR_M: Final = 0.01
"""Length of which half is left when it is saturated."""
NEAR: Final = 0.03
"""The same of a chord."""
# Distances and chords at which the terms of a nearness have fallen to their halves.
_SCALES_M: Final = np.array([0.03, 0.3])
_SCALES: Final = np.array([0.2, 1.0])


def lying(where: Array, height_m: float) -> Poses:
    """Return poses of props that lie on the table, (n, 3) and (n, 4).

    Args:
        where: (n, 3) x and y (m) in the cell frame, and yaw (rad).
        height_m: Height of the props.
    """
    position = np.array(where, dtype=np.float64)
    position[:, 2] = height_m / 2
    return Poses(position, yaw_quat(where[:, 2]))


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
        _check_indices("held", held, objects)
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


TOOL: Final = -1
"""Frame of a `Goal` that is the tool's own: it stays where it is, but for its rise."""


@dataclass(frozen=True)
class Goal:
    """Goal of a tool.

    Attributes:
        frame: Index of the frame in which it is given; that behind the last one is the cell's; or `TOOL`.
        pose: Pose of the goal in that frame, (3,) and (4,).
        approached: The tool comes from behind the goal, along the goal's z: up to `APPROACH_M`, in proportion to how
            far it is beside the line and how far it is turned (`LEVER_M`). So fingers pass an object on both sides, and
            a straight step to the goal never pushes it.
        further_m: Length of the path that remains behind the goal.
    """

    frame: int
    pose: Poses = SAME
    approached: bool = False
    further_m: float = 0.0


class ToolSteps(NamedTuple):
    """Steps of both tools to their goals.

    Attributes:
        move_m: (n, 2, 3) translation to the goal, or to the point behind it, in the cell frame.
        turn: (n, 2, 3) rotation to the goal in that frame: twice the vector part of its quaternion.
        left_m: (n, 2) length of the path that is left.
        chord: (n, 2) chord of the rotation.
        away: (n, 2) path and chord that are left, the larger of both in their tolerances, 10 mm and 0.08: below 1 the
            tool has arrived.
        nearness: (n, 2) 1 at the goal, with a slope at every distance below 1 m. With the path d in m and the chord c
            it is a quarter of 2 - d - c / 2 + s, and s is half of the sum of 0.03 / (0.03 + d), 0.3 / (0.3 + d),
            0.2 / (0.2 + c) and 1 / (1 + c).
    """

    move_m: Array
    turn: Array
    left_m: Array
    chord: Array
    away: Array
    nearness: Array


class Nearby(NamedTuple):
    """Commanded tools near their goals, in numbers between -1 and 1.

    Attributes:
        saturated: (n, 2, 4, 3) x / (`NEAR_M` + |x|) of the step from the commanded tool to its goal; x / (`NEAR` + |x|)
            of its rotation; and the same two of the step from the tool to the commanded tool.
        closeness: (n, 2, 2) `NEAR_M` / (`NEAR_M` + path left), and the same of the chord of the rotation.
    """

    saturated: Array
    closeness: Array


class GoalSteps:
    """Steps of both tools of n cells to their goals.

    Args:
        n: Number of cells.
        frames: Number k of frames of a cell, those of its objects.
        goals: Goals, by their numbers.
        mounts: Mounts of the arms, for steps of tools at joint positions; None: tools are given as frames.
        in_bases: With `mounts`, give tools in the arms' own `base` frames instead of that of the cell.
        tcp_m: With `mounts`, distance of each tool from its flange.

    Attributes:
        tools: (n, 2, 12) frames of the tools of the last call.
        actual: (n, 2, 12) with `mounts`, frames of the tools themselves, to be written before a call.
        nearby: With `mounts`, results of the last call, which the next one writes anew.
    """

    def __init__(
        self,
        n: int,
        frames: int,
        goals: Sequence[Goal],
        mounts: tuple[ArmMount, ArmMount] | None = None,
        *,
        in_bases: bool = False,
        tcp_m: Sequence[float] = (0.0, 0.0),
    ) -> None:
        _check_indices("frame of a goal", [each.frame for each in goals], frames + 1, TOOL)
        self._goals = len(goals)
        self.tools: Array = np.zeros((n, 2, 12))
        self.actual: Array = np.zeros((n, 2, 12))
        self.nearby = Nearby(np.zeros((n, 2, 4, 3)), np.zeros((n, 2, 2)))
        self._frames, self._goal = np.zeros((n, frames, 12)), np.zeros((n, 2), dtype=np.int64)
        self._goal[:, 1] = len(goals) > 1
        self._rise_m, self._error_m = np.zeros((n, 2)), np.zeros((n, 2))
        vectors, values = ([np.zeros((n, 2, *size)) for _ in range(count)] for count, size in ((2, (3,)), (4, ())))
        self._found = ToolSteps(*vectors, *values)
        self._q_rad = np.zeros((n, 2, 6))
        arms = None
        if mounts is not None:
            both = Frames(mounts)
            arms = Struct(
                "ArmTools",
                n=n,
                links=np.stack([links(mount.dh) for mount in mounts]),
                tcp_m=np.array(tcp_m, dtype=np.float64),
                base_m=np.zeros((2, 3)) if in_bases else both.base_m,
                to_base=np.tile(np.eye(3), (2, 1, 1)) if in_bases else np.ascontiguousarray(both.rotation),
                near_m=NEAR_M,
                near=NEAR,
                q_rad=self._q_rad,
                tools=self.tools,
                actual=self.actual,
                **self.nearby._asdict(),
            )
        struct = Struct(
            "GoalSteps",
            n=n,
            frame_count=frames,
            goals=len(goals),
            back_m=APPROACH_M,
            lever_m=LEVER_M,
            aside=_ASIDE,
            slack_m=_SLACK_M,
            arrived_m=_ARRIVED_M,
            arrived=_ARRIVED,
            scales_m=_SCALES_M,
            scales=_SCALES,
            frame=np.array([each.frame for each in goals], dtype=np.int64),
            pose=np.stack([frame_of(each.pose) for each in goals]),
            approached=np.array([each.approached for each in goals], dtype=np.int64),
            further_m=np.array([each.further_m for each in goals]),
            arms=arms,
            tools=self.tools,
            frames=self._frames,
            goal=self._goal,
            rise_m=self._rise_m,
            error_m=self._error_m,
            **self._found._asdict(),
        )
        self._of_joints, self._compute = arms is not None, RowLoop("goal_steps", struct, n, 1)

    def __call__(
        self,
        tools: Array,
        frames: Array,
        goal: Sequence[Number] | None = None,
        rise_m: Sequence[Number] | None = None,
        error_m: Sequence[Number] | None = None,
    ) -> ToolSteps:
        """Return the steps, in arrays that the next call writes anew.

        Args:
            tools: (n, 2, 12) frames of the tools; with `mounts`, (n, 2, 6) commanded joint positions.
            frames: (n, k, 12).
            goal: Numbers of the goals of both tools, (n,) each; None: as in the last call, or the first and the second.
            rise_m: Heights added to the goals, likewise; None: as in the last call, or none.
            error_m: Errors of what an approached goal is at, from the farther behind it is approached; likewise.

        Raises:
            SettingsError: There is no goal of such a number.
        """
        given = self._q_rad if self._of_joints else self.tools
        given[...], self._frames[...] = tools, frames
        if goal is not None:
            self._goal[:, 0], self._goal[:, 1] = goal
            if np.count_nonzero((self._goal < 0) | (self._goal >= self._goals)):
                _check_indices("goal", self._goal.ravel().tolist(), self._goals)
        if rise_m is not None:
            self._rise_m[:, 0], self._rise_m[:, 1] = rise_m
        if error_m is not None:
            self._error_m[:, 0], self._error_m[:, 1] = error_m
        self._compute()
        return self._found


def frame_of(pose: Poses) -> Array:
    """Return the frames, (..., 12), of poses."""
    matrix = quat_to_matrix(pose.quat)
    return np.concatenate([pose.position_m, matrix.reshape(*matrix.shape[:-2], 9)], axis=-1)


class FrameDistances:
    """Distances of frames of n cells from others.

    Args:
        n: Number of cells.
        frames: Number k of frames of a cell.
        of: Index of one of these for each pair.

    Attributes:
        others: (n, pairs, 12) frames that they are compared with, to be written; what stays need not be written again.
    """

    def __init__(self, n: int, frames: int, of: Sequence[int]) -> None:
        _check_indices("of", of, frames)
        self.others: Array = np.zeros((n, len(of), 12))
        self._frames, self._found = np.zeros((n, frames, 12)), [np.zeros((n, len(of))) for _ in range(3)]
        moved_m, chord, axis_rad = self._found
        struct = Struct(
            "FrameDistances",
            n=n,
            frame_count=frames,
            pairs=len(of),
            of=np.array(of, dtype=np.int64),
            frames=self._frames,
            others=self.others,
            moved_m=moved_m,
            chord=chord,
            axis_rad=axis_rad,
        )
        self._compute = RowLoop("frame_distances", struct, n, 1)

    def __call__(self, frames: Array) -> tuple[Array, Array, Array]:
        """Return distances, chords, and angles of the x axes in rad, (n, pairs) each, which the next call changes."""
        self._frames[...] = frames
        self._compute()
        moved_m, chord, axis_rad = self._found
        return moved_m, chord, axis_rad


def _check_indices(what: str, found: Sequence[int], count: int, least: int = 0) -> None:
    """Refuse indices that the kernel would read beyond its arrays."""
    if not all(least <= each < count for each in found):
        raise SettingsError(f"{what} is {list(found)!r}: allowed are {least} to {count - 1}")


def length(vectors: Array) -> Array:
    """Return the lengths, (...), of vectors, (..., 3), in one pass."""
    result: Array = np.sqrt(np.vecdot(vectors, vectors))
    return result


class Tracked(NamedTuple):
    """Errors of both flanges from their references.

    Attributes:
        turn: (n, 2, 3) rotation from flange to reference in the frame of the quaternions: twice the vector part of its
            quaternion, which is the rotation vector as long as it is small.
        off_m: (n, 2) distance.
        chord: (n, 2) chord of the rotation.
        apart_m: (n,) error of the vector between the flanges.
        other_flange: (n, 2, 7) pose of the other flange in the `base` frame of each arm: position and quaternion.
    """

    turn: Array
    off_m: Array
    chord: Array
    apart_m: Array
    other_flange: Array


class Tracking:
    """Errors of n pairs of flanges from references.

    Args:
        n: Number of cells.
        frames: Frames of both arms.
        quat: (2, 4) orientations of both references in the arms' `base` frames.
    """

    def __init__(self, n: int, frames: Frames, quat: Array) -> None:
        self._flange_m, self._flange_base_m, self._reference_m = (np.zeros((n, 2, 3)) for _ in range(3))
        self._flange_quat: Array = np.zeros((n, 2, 4))
        shapes = (2, 3), (2,), (2,), (), (2, 7)
        self._found = Tracked(*[np.zeros((n, *shape)) for shape in shapes])
        struct = Struct(
            "Tracking",
            n=n,
            reference_quat=np.ascontiguousarray(quat),
            others=np.ascontiguousarray(frames.others_pose),
            flange_m=self._flange_m,
            flange_base_m=self._flange_base_m,
            flange_quat=self._flange_quat,
            reference_m=self._reference_m,
            **self._found._asdict(),
        )
        self._compute = RowLoop("track", struct, n, 1)

    def __call__(self, flange_m: Array, in_bases: Poses, reference_m: Array) -> Tracked:
        """Return the errors of flanges from references, (n, 2, 3) in the cell frame; orientations are in the bases."""
        self._flange_m[...], self._reference_m[...] = flange_m, reference_m
        self._flange_base_m[...], self._flange_quat[...] = in_bases
        self._compute()
        return Tracked(*[each.copy() for each in self._found])


Number = Any
"""A value of each row, (n,); of one row alone a plain number, whose arithmetic is ten times as fast."""


def numbers(values: NDArray[Any]) -> Sequence[Number]:
    """Return the values of k quantities, (k, n), as arrays, (n,); of one row alone as k plain numbers."""
    return values[:, 0].tolist() if values.shape[1] == 1 else values  # type: ignore[return-value]


def ratio(value: Number) -> Number:
    """Return a number, limited to 0 to 1."""
    if isinstance(value, float):
        return min(max(value, 0.0), 1.0)
    return np.minimum(np.maximum(value, 0.0), 1.0)


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
