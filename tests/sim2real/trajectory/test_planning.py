"""Trajectories to a configuration."""

import json

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import PlanningError, TrajectoryError
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.trajectory.files import parse_trajectory, read_trajectory, write_trajectory
from dual_ur10.sim2real.trajectory.goal import GoalState
from dual_ur10.sim2real.trajectory.planning import configuration_of, plan_to
from tests.sim2real.trajectory.following import CLEARANCE, LIMITS, check_sent, made, wave
from ur_core.kinematics.ur10 import ARMS, JOINTS


def test_the_arms_get_around_what_is_in_the_way():
    executor, rng = made(), np.random.default_rng(0)
    while True:
        goal = HOME_Q_RAD + rng.uniform(-1.2, 1.2, (2, 6))
        ends = executor.desired_q_rad, goal
        if not CLEARANCE.is_clear(goal.reshape(1, 12)).all():
            continue
        if len(plan_path(CLEARANCE, *ends, LIMITS, np.random.default_rng(0))) > 3:
            break
    first, again = (plan_to(*ends, executor.gate, executor.law, np.random.default_rng(0)) for _ in range(2))
    np.testing.assert_array_equal(first.q_rad, again.q_rad)
    assert executor.execute(first).wait().state == GoalState.SUCCEEDED
    np.testing.assert_allclose(executor.measured_q_rad, goal, atol=1e-4)
    check_sent(executor)


def test_one_arm_alone_moves():
    executor, goal = made(), np.array(HOME_Q_RAD)
    goal[1, 0] += 0.4
    trajectory = plan_to(HOME_Q_RAD, goal, executor.gate, executor.law, np.random.default_rng(0), arms=("right",))
    assert trajectory.arms == ("right",)
    with pytest.raises(PlanningError, match="the right arm has to stay"):
        plan_to(HOME_Q_RAD, goal, executor.gate, executor.law, np.random.default_rng(0), arms=("left",))


def test_configurations_have_names(tmp_path):
    arms, q_rad = configuration_of("home", HOME_Q_RAD)
    assert arms == ARMS
    np.testing.assert_array_equal(q_rad, HOME_Q_RAD)
    arms, q_rad = configuration_of(",".join(map(str, range(12))), HOME_Q_RAD)
    assert arms == ARMS
    np.testing.assert_array_equal(q_rad.ravel(), range(12))
    arms, q_rad = configuration_of("right:-1, 2e-1, 3, 4, 5, 6", HOME_Q_RAD)
    assert arms == ("right",)
    assert q_rad.tolist() == [[-1.0, 0.2, 3.0, 4.0, 5.0, 6.0]]
    path = write_trajectory(tmp_path / "there.json", wave(arms=("left",), start=HOME_Q_RAD + 0.3))
    arms, q_rad = configuration_of(str(path), HOME_Q_RAD)
    assert arms == ("left",)
    np.testing.assert_allclose(q_rad[0], HOME_Q_RAD[0] + 0.3)


@pytest.mark.parametrize(
    "text", ["", "away", "1,2,3,4,5,6", "left:1,2", "up:1,2,3,4,5,6", "both:" + ",".join("1" * 12), "1,2,x", "home:"]
)
def test_other_texts_are_no_configuration(text):
    hint = r" \(did you mean 'home'\?\)" if text == "home:" else ""
    must = "it must be home, 12 joint angles, left: or right:"
    with pytest.raises(TrajectoryError, match=f"is no configuration{hint}: {must}"):
        configuration_of(text, HOME_Q_RAD)


def test_points_without_times_are_numbered_on_request(tmp_path):
    names = [f"left/{joint}" for joint in JOINTS]
    table = ",".join(names) + "\n" + "".join(",".join(str(k + j) for j in range(6)) + "\n" for k in range(3))
    message = {"joint_names": names, "points": [{"positions": [float(k + j) for j in range(6)], "time_from_start": {}}
                                               for k in range(3)]}  # fmt: skip
    path = tmp_path / "points.csv"
    path.write_text(table)
    for found in (
        parse_trajectory(table.encode(), "csv", number_points=True),
        parse_trajectory(json.dumps(message).encode(), "json", number_points=True),
        read_trajectory(path, number_points=True),
    ):
        np.testing.assert_array_equal(found.time_s, [0.0, 1.0, 2.0])
        np.testing.assert_array_equal(found.q_rad[:, 0, 0], [0.0, 1.0, 2.0])
    for data, kind in ((table.encode(), "csv"), (json.dumps(message).encode(), "json")):
        with pytest.raises(TrajectoryError, match=r"it must be time_s|times must increase"):
            parse_trajectory(data, kind)
    timed = wave()
    path = write_trajectory(tmp_path / "timed.csv", timed)
    np.testing.assert_array_equal(read_trajectory(path, number_points=True).time_s, timed.time_s)
