"""Geometry of tasks with objects: steps of tools to their goals, and distances of poses.

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
from ur_core.kinematics.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
    rotate,
)
from ur_core.tools.tool import levers_m
from ur_core.types import Array

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
        check_indices("frame of a goal", [each.frame for each in goals], frames + 1, TOOL)
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
        arms = None if mounts is None else self._arm_tools(mounts, in_bases, tcp_m)
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

    def _arm_tools(self, mounts: tuple[ArmMount, ArmMount], in_bases: bool, tcp_m: Sequence[float]) -> Struct:
        """Return the structure that computes the tools from joint positions."""
        both = Frames(mounts)
        return Struct(
            "ArmTools",
            n=len(self.tools),
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
                check_indices("goal", self._goal.ravel().tolist(), self._goals)
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


def toward(begin: Poses, end: Poses, most_m: float, most_rad: float) -> Poses:
    """Return poses on the way from some to others, (..., 3) and (..., 4), at most these steps from the first ones.

    Args:
        begin: Poses.
        end: Other poses.
        most_m: Longest translation.
        most_rad: Largest rotation.
    """
    path_m = end.position_m - begin.position_m
    turn = quat_to_rotvec(quat_multiply(end.quat, quat_conjugate(begin.quat)))
    step_m, step_rad = (
        part * np.minimum(1.0, most / np.maximum(length(part), 1e-12))[..., None]
        for part, most in ((path_m, most_m), (turn, most_rad))
    )
    return Poses(begin.position_m + step_m, quat_multiply(quat_from_rotvec(step_rad), begin.quat))


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
        check_indices("of", of, frames)
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


def check_indices(what: str, found: Sequence[int], count: int, least: int = 0) -> None:
    """Refuse indices that the kernel would read beyond its arrays."""
    if not all(least <= each < count for each in found):
        raise SettingsError(f"{what} is {list(found)!r}: allowed are {least} to {count - 1}")


def length(vectors: Array) -> Array:
    """Return the lengths, (...), of vectors, (..., 3), in one pass."""
    result: Array = np.sqrt(np.vecdot(vectors, vectors))
    return result


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
