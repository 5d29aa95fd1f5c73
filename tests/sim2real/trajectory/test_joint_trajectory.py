import pickle

import numpy as np
import pytest

from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode

LINE = np.linspace(0.0, 1.0, 3)[:, None, None] * np.ones((1, 2, 6))


def test_arrays_are_copies_that_cannot_change():
    given = LINE.copy()
    found = JointTrajectory(("left", "right"), [0, 1, 2], given)
    given[:] = 9.0
    assert np.array_equal(found.q_rad, LINE)
    assert found.duration_s == 2.0
    assert len(found) == 3
    with pytest.raises(ValueError, match="read-only"):
        found.q_rad[0] = 1.0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"time_s": [0, 1, 1]}, "point 2 is at 1 s, the one before at 1 s: times must increase"),
        ({"time_s": [0, 2, 1]}, "times must increase"),
        ({"time_s": [-1, 0, 1]}, "point 0 is at -1 s"),
        ({"time_s": [0, 1, np.nan]}, "time_s at point 2 is nan"),
        ({"time_s": []}, "1 point or more"),
        ({"q_rad": LINE[:, :1]}, r"shape \(3, 1, 6\)"),
        ({"q_rad": "home"}, "must be numbers"),
        ({"qd_rad_s": np.full((3, 2, 6), np.inf)}, "qd_rad_s of left/shoulder_pan_joint at point 0 is inf"),
        ({"qdd_rad_s2": LINE}, "without speeds"),
    ],
)
def test_points_that_are_no_trajectory_are_named(changes, text):
    with pytest.raises(TrajectoryError, match=text) as error:
        JointTrajectory(**{"arms": ("left", "right"), "time_s": [0, 1, 2], "q_rad": LINE, **changes})
    assert error.value.code == ResultCode.INVALID_GOAL


@pytest.mark.parametrize("arms", [(), ("right", "left"), ("left", "left"), ("third",)])
def test_arms_that_do_not_exist_are_named(arms):
    with pytest.raises(TrajectoryError, match="arms of the trajectory") as error:
        JointTrajectory(arms, [0, 1, 2], LINE)
    assert error.value.code == ResultCode.INVALID_JOINTS
    assert pickle.loads(pickle.dumps(error.value)).code == ResultCode.INVALID_JOINTS
