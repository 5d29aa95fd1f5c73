"""Goals: legal values, tolerances per joint, and points of a stream."""

import numpy as np
import pytest

from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.trajectory.goal import GoalState, TrajectoryGoal
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from tests.sim2real.trajectory.following import part, wave


def test_tolerances_are_spread_over_the_joints():
    goal = TrajectoryGoal(wave(arms=("left",)), path_tolerance_rad=None, goal_tolerance_rad=np.arange(1, 7))
    assert np.isinf(goal.path_tolerance_rad).all()
    assert goal.goal_tolerance_rad.tolist() == [[1, 2, 3, 4, 5, 6]]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"trajectory": 3}, "the goal's trajectory is a int"),
        ({"path_tolerance_rad": 0.0}, "path_tolerance_rad of left/shoulder_pan_joint is 0: it must be above 0"),
        ({"path_tolerance_rad": np.nan}, "is nan: it must be above 0"),
        ({"goal_tolerance_rad": [1.0, 2.0]}, r"it must be one number, or fit \(2, 6\)"),
        ({"goal_tolerance_rad": "x"}, "it must be one number"),
        ({"goal_time_s": -1.0}, "goal_time_s of the goal is -1.0: it must be a finite number, 0 or more"),
        ({"goal_time_s": True}, "goal_time_s"),
        ({"start_s": np.inf}, "start_s of the goal is inf"),
        ({"start_s": "now"}, "start_s of the goal is 'now'"),
        ({"trajectory": part(wave(), 0, 5)}, r"the last point, 4, moves \w+/\w+ at -?0\.\d+ rad/s: it must be at rest"),
    ],
)
def test_a_wrong_goal_is_named(changes, text):
    with pytest.raises(TrajectoryError, match=text):
        TrajectoryGoal(**{"trajectory": wave(), **changes})


def test_a_stream_may_end_in_motion_and_grows():
    whole = wave(points=20)
    goal = TrajectoryGoal(part(whole, 0, 5), stream=True).extended(part(whole, 5, 12))
    assert np.array_equal(goal.trajectory.q_rad, whole.q_rad[:12])
    kept = goal.since(whole.time_s[8] + 1e-6)
    assert kept.trajectory.time_s.tolist() == whole.time_s[7:12].tolist()
    assert goal.since(-1.0) is goal
    assert len(goal.since(99.0).trajectory) == 2
    with pytest.raises(TrajectoryError, match="must be at rest"):
        goal.completed()
    assert not goal.extended(part(whole, 12, 20)).completed().stream


def test_positions_alone_end_at_rest():
    assert TrajectoryGoal(JointTrajectory(("left",), [0.0], np.zeros((1, 1, 6)))).rows == [0]


@pytest.mark.parametrize("state", GoalState)
def test_final_states(state):
    assert state.is_final == (state not in ("pending", "active", "preempting"))
