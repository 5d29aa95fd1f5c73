"""Joint trajectory of one arm or both on one time base, and its checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final

import numpy as np

from dual_ur10.errors import TrajectoryError
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

MOST_DURATION_S: Final = 3600.0
"""Longest duration of a goal, and of what a stream knows ahead: the check of such a path takes some seconds."""


class ResultCode(IntEnum):
    """Result codes of `control_msgs/FollowJointTrajectory`, control_msgs 6."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Points of one arm's joints or both arms', on one time base. Arrays are copied and read-only.

    Between two points the path is a line, a cubic or a quintic, by what both carry: positions, speeds, accelerations.

    Attributes:
        arms: Names of the arms that move, a part of ("left", "right") in this order.
        time_s: (k,) times from the start, increasing, the first 0 or later.
        q_rad: (k, arms, 6) joint positions.
        qd_rad_s: (k, arms, 6) joint speeds; None: not given.
        qdd_rad_s2: (k, arms, 6) joint accelerations; None: not given.

    Raises:
        TrajectoryError: An arm does not exist, a shape does not fit, a number is not finite, times do not increase, or
            accelerations come without speeds.
    """

    arms: tuple[str, ...]
    time_s: Array
    q_rad: Array
    qd_rad_s: Array | None = field(default=None)
    qdd_rad_s2: Array | None = field(default=None)

    def __post_init__(self) -> None:
        arms = tuple(self.arms)
        if not arms or arms != tuple(each for each in ARMS if each in arms):
            raise TrajectoryError(
                f"arms of the trajectory are {arms!r}: allowed are ('left',), ('right',) and ('left', 'right')",
                ResultCode.INVALID_JOINTS,
            )
        object.__setattr__(self, "arms", arms)
        time = _numbers("time_s", self.time_s, None)
        if time.ndim != 1 or not len(time):
            raise TrajectoryError(f"time_s has shape {time.shape}: it must be one time per point, of 1 point or more")
        object.__setattr__(self, "time_s", time)
        for name in ("q_rad", "qd_rad_s", "qdd_rad_s2"):
            if getattr(self, name) is not None or name == "q_rad":
                object.__setattr__(self, name, _numbers(name, getattr(self, name), (len(time), len(arms), 6), arms))
        if time[0] < 0.0:
            raise TrajectoryError(f"point 0 is at {time[0]:g} s: times must be 0 or more")
        wrong = np.flatnonzero(np.diff(time) <= 0.0)
        if wrong.size:
            point = int(wrong[0]) + 1
            raise TrajectoryError(
                f"point {point} is at {time[point]:g} s, the one before at {time[point - 1]:g} s: times must increase"
            )
        if self.qdd_rad_s2 is not None and self.qd_rad_s is None:
            raise TrajectoryError("accelerations are given without speeds: give both, or neither")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({' and '.join(self.arms)}, {len(self)} points, {self.duration_s:g} s)"

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def duration_s(self) -> float:
        """Time of the last point."""
        return float(self.time_s[-1])

    def place(self, path_s: float) -> str:
        """Return between which points a time is, such as "between points 0 and 1"."""
        after = int(np.searchsorted(self.time_s, path_s, side="right"))
        last = len(self) - 1
        return f"between points {after - 1} and {after}" if 0 < after <= last else f"at point {min(after, last)}"


def too_long(duration_s: float) -> str:
    """Return why a goal may not last so long; "" if it may."""
    if duration_s <= MOST_DURATION_S:
        return ""
    return (
        f"the last point is {duration_s:g} s ahead, allowed are at most {MOST_DURATION_S:g} s in one goal: cut the "
        "trajectory into goals that follow each other"
    )


def _numbers(name: str, value: Any, shape: tuple[int, ...] | None, arms: tuple[str, ...] = ()) -> Array:
    """Return a read-only copy as floats.

    Raises:
        TrajectoryError: These are not finite numbers of this shape.
    """
    try:
        array: Array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TrajectoryError(f"{name} must be numbers: {error}") from None
    if shape is not None and array.shape != shape:
        raise TrajectoryError(f"{name} has shape {array.shape}: it must be {shape}, (points, arms, joints)")
    if not np.isfinite(array).all():
        point, *rest = np.argwhere(~np.isfinite(array))[0].tolist()
        where = f" of {arms[rest[0]]}/{JOINTS[rest[1]]}" if len(rest) == 2 else ""
        raise TrajectoryError(f"{name}{where} at point {point} is {array[(point, *rest)]}: it must be finite")
    array.setflags(write=False)
    return array
