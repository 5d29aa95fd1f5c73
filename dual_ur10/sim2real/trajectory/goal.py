"""Goals that follow a trajectory: states, feedback and results, named as in ROS, and comparisons with measured arms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import TrajectoryError, distinguishable
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.ur10 import ARMS, JOINTS, DHParameters
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.sim2real.trajectory.course_stepper import Desired

PATH_TOLERANCE_RAD: Final = 0.05
"""Default largest distance of a joint from its path: chosen, ten times what friction and added mass cause here."""

GOAL_TOLERANCE_RAD: Final = 0.01
"""Default largest distance of a joint from the last point when the goal ends."""

GOAL_TIME_S: Final = 2.0
"""Default time after the last point within which the arms must rest inside the goal tolerance."""

REST_RAD_S: Final = 0.01
"""Speed below which a measured joint counts as resting: JointTrajectoryController's `stopped_velocity_tolerance`."""

END_SPEED_RAD_S: Final = 1e-3
"""Largest speed of a last point: what the safety gate counts as rest."""

START_RAD: Final = 0.01
"""Largest distance of a first point at time 0 from where the arms are commanded to be."""

MEASURED_RAD: Final = 0.02
"""Largest measured distance of resting arms from where they are commanded to be, as after an approach."""

_POINTS: Final = ("time_s", "q_rad", "qd_rad_s", "qdd_rad_s2")


class GoalState(StrEnum):
    """States of a goal, named as in actionlib."""

    PENDING = "pending"
    ACTIVE = "active"
    PREEMPTING = "preempting"
    PREEMPTED = "preempted"
    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    REJECTED = "rejected"

    @property
    def is_final(self) -> bool:
        """True for a state that a goal never leaves."""
        return self not in (GoalState.PENDING, GoalState.ACTIVE, GoalState.PREEMPTING)


@dataclass(frozen=True, eq=False)
class TrajectoryGoal:
    """Trajectory to follow, with tolerances.

    Attributes:
        trajectory: The trajectory. A first point at 0 must be where the arms are; one later is reached from there.
        path_tolerance_rad: Largest distance of each joint from the path: one number, (6,) or (arms, 6); None: any.
        goal_tolerance_rad: Largest distance of each joint from the last point at the end of the goal, likewise.
        goal_time_s: Time after the last point within which the arms must rest inside the goal tolerance.
        start_s: Start of the trajectory on the executor's clock; until then a running goal continues. None: at once.
        stream: More points will be appended: the last point may move.

    Raises:
        TrajectoryError: A value is not legal, or the last point moves.
    """

    trajectory: JointTrajectory
    path_tolerance_rad: Any = field(default=PATH_TOLERANCE_RAD)
    goal_tolerance_rad: Any = field(default=GOAL_TOLERANCE_RAD)
    goal_time_s: float = GOAL_TIME_S
    start_s: float | None = None
    stream: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.trajectory, JointTrajectory):
            raise TrajectoryError(
                f"the goal's trajectory is a {type(self.trajectory).__name__}: make a JointTrajectory"
            )
        for name in ("path_tolerance_rad", "goal_tolerance_rad"):
            object.__setattr__(self, name, self._tolerance(name))
        for name, least in (("goal_time_s", 0.0), ("start_s", -math.inf)):
            value = getattr(self, name)
            if value is None and name == "start_s":
                continue
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float | np.number)
                or not least <= value < math.inf
            ):
                raise TrajectoryError(f"{name} of the goal is {value!r}: it must be a finite number, {least:g} or more")
        if not self.stream:
            _check_end(self.trajectory)

    @property
    def rows(self) -> list[int]:
        """Indices of the arms that move."""
        return [ARMS.index(each) for each in self.trajectory.arms]

    def extended(self, points: JointTrajectory) -> TrajectoryGoal:
        """Return this stream with further points.

        Raises:
            TrajectoryError: They are of other arms, carry other values, or are not later.
        """
        before = self.trajectory
        if points.arms != before.arms:
            raise TrajectoryError(
                f"points of {points.arms} were appended to a goal of {before.arms}: send all of its arms, and no other",
                ResultCode.INVALID_JOINTS,
            )
        values: dict[str, Any] = {}
        for name in _POINTS:
            first, second = getattr(before, name), getattr(points, name)
            if (first is None) != (second is None):
                raise TrajectoryError(f"appended points must carry {name} exactly where the points before do")
            values[name] = None if first is None else np.concatenate([first, second])
        return replace(self, trajectory=JointTrajectory(before.arms, **values))

    def since(self, path_s: float) -> TrajectoryGoal:
        """Return this goal without points before a time of the trajectory, except the last two of them."""
        trajectory = self.trajectory
        first = max(min(int(np.searchsorted(trajectory.time_s, path_s)), len(trajectory)) - 2, 0)
        given = {name: getattr(trajectory, name) for name in _POINTS}
        values: dict[str, Any] = {name: None if each is None else each[first:] for name, each in given.items()}
        kept = JointTrajectory(trajectory.arms, **values)
        return replace(self, trajectory=kept) if first else self

    def completed(self) -> TrajectoryGoal:
        """Return this stream as a whole.

        Raises:
            TrajectoryError: Its last point moves.
        """
        return replace(self, stream=False)

    def _tolerance(self, name: str) -> Array:
        """Return a tolerance as (arms, 6); infinite where none is given."""
        value, shape = getattr(self, name), self.trajectory.q_rad.shape[1:]
        try:
            array = np.array(math.inf if value is None else value, dtype=np.float64)
            array = np.array(np.broadcast_to(array, shape))
        except (TypeError, ValueError):
            raise TrajectoryError(f"{name} is {value!r}: it must be one number, or fit {shape}, (arms, 6)") from None
        if not (array > 0.0).all():
            arm, joint = np.argwhere(~(array > 0.0))[0]
            raise TrajectoryError(
                f"{name} of {self.trajectory.arms[arm]}/{JOINTS[joint]} is {array[arm, joint]:g}: it must be above 0, "
                "or None for none"
            )
        array.setflags(write=False)
        return array


def _check_end(trajectory: JointTrajectory) -> None:
    """Check that a trajectory ends at rest.

    Raises:
        TrajectoryError: Its last point moves.
    """
    if trajectory.qd_rad_s is None:
        return
    last = trajectory.qd_rad_s[-1]
    arm, joint = np.unravel_index(int(np.abs(last).argmax()), last.shape)
    if abs(last[arm, joint]) > END_SPEED_RAD_S:
        raise TrajectoryError(
            f"the last point, {len(trajectory) - 1}, moves {trajectory.arms[arm]}/{JOINTS[joint]} at "
            f"{last[arm, joint]:g} rad/s: it must be at rest. Add a point with speed 0, or send the goal as a stream"
        )


class Feedback(NamedTuple):
    """State of a running goal after a period, of its arms.

    Attributes:
        time_s: Time on the executor's clock.
        path_s: Time on the trajectory that the measured positions show. Arms that follow their commands later show
            nothing of the goal at first: until then it is the time of its beginning.
        scaling: Rate of the trajectory's time.
        desired_q_rad: (arms, 6) positions on the path.
        actual_q_rad: (arms, 6) measured positions.
        error_rad: (arms, 6) desired minus actual.
        flange_error_m: (arms,) distance of each flange from where the desired positions put it.
    """

    time_s: float
    path_s: float
    scaling: float
    desired_q_rad: Array
    actual_q_rad: Array
    error_rad: Array
    flange_error_m: Array


class GoalResult(NamedTuple):
    """End of a goal.

    Attributes:
        state: Final state.
        code: Result code. A goal that was cancelled or replaced has SUCCESSFUL, as in ros2_controllers.
        reason: Short name: "reached", "cancelled", "replaced", "rejected", "path tolerance", "goal tolerance",
            "underrun", "refused", "stopped", "late" or "diverged".
        text: Description: the joint, what was found, what is allowed, and the remedy.
        time_s: Time on the executor's clock.
        largest_error_rad: (arms, 6) largest distance of each joint from the path.
        rms_error_rad: (arms, 6) root mean square of it.
        largest_flange_error_m: (arms,) largest flange error.
        rms_flange_error_m: (arms,) root mean square of it.
    """

    state: GoalState
    code: ResultCode
    reason: str
    text: str
    time_s: float
    largest_error_rad: Array
    rms_error_rad: Array
    largest_flange_error_m: Array
    rms_flange_error_m: Array

    @property
    def succeeded(self) -> bool:
        """True if the goal was reached."""
        return self.state == GoalState.SUCCEEDED


def feedback_of(
    goal: TrajectoryGoal, desired: Desired, measured_q_rad: Array, dh: Sequence[DHParameters], time_s: float
) -> Feedback:
    """Return the feedback of a goal's arms after a period.

    Args:
        goal: The goal.
        desired: Commanded motion that the measurement shows.
        measured_q_rad: (2, 6) measured positions.
        dh: Kinematics of both arms.
        time_s: Time on the executor's clock.
    """
    rows = goal.rows
    wanted, found = desired.q_rad[rows], measured_q_rad[rows]
    flanges = [flange_pose(q, dh[arm])[0] for arm, q in zip(rows, np.stack([wanted, found], 1), strict=True)]
    away = np.array([math.dist(*each) for each in flanges])
    return Feedback(time_s, desired.path_s, desired.rate, wanted, found, wanted - found, away)


def off_path(goal: TrajectoryGoal, feedback: Feedback) -> str:
    """Return which joint exceeds its path tolerance most; "" if none does."""
    if not (np.abs(feedback.error_rad) > goal.path_tolerance_rad).any():
        return ""
    worst = _worst(goal, feedback.error_rad, goal.path_tolerance_rad)
    return f"{worst} from its path at {feedback.path_s:.3f} s: both arms stop on it"


def off_goal(goal: TrajectoryGoal, feedback: Feedback, rests: bool) -> str:
    """Return which joint is not at the last point, or that an arm moves; "" if all rest there."""
    if rests and (np.abs(feedback.error_rad) <= goal.goal_tolerance_rad).all():
        return ""
    worst = _worst(goal, feedback.error_rad, goal.goal_tolerance_rad) if rests else "an arm still moves"
    return f"{worst} from the last point, {goal.goal_time_s:g} s after it: check what holds it, or allow more"


def misplaced(goal: TrajectoryGoal, desired_q_rad: Array, measured_q_rad: Array) -> str:
    """Return which joint of resting arms is not where it should be at the beginning of a goal; "" if none.

    Args:
        goal: The goal.
        desired_q_rad: (2, 6) commanded positions.
        measured_q_rad: (2, 6) measured positions.
    """
    off = np.abs(measured_q_rad - desired_q_rad)
    if (off > MEASURED_RAD).any():
        arm, joint = np.unravel_index(int(off.argmax()), off.shape)
        return (
            f"{ARMS[arm]}/{JOINTS[joint]} is measured at {measured_q_rad[arm, joint]:.4f} rad and was commanded to "
            f"{desired_q_rad[arm, joint]:.4f} rad: allowed are {MEASURED_RAD:g} rad between them. Check what holds it"
        )
    first = goal.trajectory.q_rad[0]
    off = np.abs(desired_q_rad[goal.rows] - first)
    if goal.trajectory.time_s[0] == 0.0 and (off > START_RAD).any():
        arm, joint = np.unravel_index(int(off.argmax()), off.shape)
        return (
            f"point 0 of {goal.trajectory.arms[arm]}/{JOINTS[joint]} is at {first[arm, joint]:.4f} rad, and it is "
            f"at {desired_q_rad[goal.rows][arm, joint]:.4f} rad: allowed are {START_RAD:g} rad between them at time 0. "
            "Bring the arms there first, or give the point a later time"
        )
    return ""


def _worst(goal: TrajectoryGoal, error: Array, tolerance: Array) -> str:
    """Return the joint that exceeds its tolerance most."""
    arm, joint = np.unravel_index(int((np.abs(error) / tolerance).argmax()), error.shape)
    name = f"{goal.trajectory.arms[arm]}/{JOINTS[joint]}"
    found, allowed = distinguishable(abs(error[arm, joint]), tolerance[arm, joint], 4)
    return f"{name} is {found} rad, allowed are {allowed} rad,"
