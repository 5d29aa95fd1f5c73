"""Joint trajectories of one arm or both, and goals that follow them.

Trajectories, interpolation, timing, reduction, files, and the executor of goals on any `Cell`. It
opens no connection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dual_ur10.sim2real.trajectory.goal import Feedback, GoalResult, GoalState, TrajectoryGoal
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode

if TYPE_CHECKING:
    from dual_ur10.sim2real.trajectory.files import read_trajectory, write_trajectory

__all__ = [
    "Feedback",
    "GoalResult",
    "GoalState",
    "JointTrajectory",
    "ResultCode",
    "TrajectoryGoal",
    "read_trajectory",
    "write_trajectory",
]


def __getattr__(name: str) -> Any:
    if name in ("read_trajectory", "write_trajectory"):  # on first use, because it loads readers of files
        from dual_ur10.sim2real.trajectory import files

        return getattr(files, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
