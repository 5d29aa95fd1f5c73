"""Times for paths that have none."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD, home_q_rad
from dual_ur10.errors import TrajectoryError
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.planner import plan_path
from dual_ur10.sim2real.trajectory import path_timing
from dual_ur10.sim2real.trajectory.goal import GoalState
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from dual_ur10.sim2real.trajectory.path_timing import BLEND_RAD, refusal_of, time_path
from tests.sim2real.control.motion_checks import HARD, NARROW, TIGHT, TOOL, AlwaysClear
from tests.sim2real.control.reference_cell import dh_product
from tests.sim2real.trajectory.following import CLEARANCE, check_sent, made
from tests.soak import scaled
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import nominal_dh
from ur_core.servoj import ServojProfile

HOME = np.array(HOME_Q_RAD).reshape(12)
SLOW = MotionLimits(speed_rad_s=0.2, tcp_speed_m_s=0.1, acceleration_rad_s2=0.5, jerk_rad_s3=5.0)
PROFILES = (ServojProfile(), ServojProfile("e-series"), ServojProfile(lookahead_s=0.2, gain=100.0))


def gate_and_law(limits=HARD, profile=PROFILES[0], distances=None):
    law = TargetLaw.of(profile, 2, 1.0, None)
    return SafetyGate(limits, law.tick_s, 2, distances or AlwaysClear()), law


def random_corners(rng, limits=HARD):
    size = rng.choice([1.0, 0.3, 0.01])
    corners = HOME + np.append(np.zeros((1, 12)), size * rng.uniform(-1, 1, (rng.integers(1, 8), 12)), axis=0)
    return np.clip(corners, np.tile(limits.lower_rad, 2) + 0.1, np.tile(limits.upper_rad, 2) - 0.1)


def off_path_rad(trajectory, corners):
    """Return the largest distance of a joint from the straight parts."""
    time = np.linspace(0.0, trajectory.duration_s, 700)
    q = Interpolation(trajectory)(time).q_rad.reshape(len(time), -1)
    parts = [
        start + np.linspace(0.0, 1.0, 3 + int(np.abs(end - start).max() / 2e-3))[:, None] * (end - start)
        for start, end in itertools.pairwise(corners)
    ]
    along = np.concatenate(parts)
    return max(float(np.abs(along - each).max(axis=1).min()) for each in q)


@pytest.mark.parametrize(
    ("limits", "profile"),
    [*zip([HARD, TIGHT, NARROW, TOOL, SLOW], itertools.cycle(PROFILES)), *((HARD, each) for each in PROFILES[1:])],
)
def test_the_gate_releases_every_motion(limits, profile):
    rng = np.random.default_rng(1)
    gate, law = gate_and_law(limits, profile)
    for _ in range(scaled(60)):
        corners = random_corners(rng, limits)
        trajectory = time_path(corners, gate, law)
        assert refusal_of(trajectory, HOME_Q_RAD, gate, law) is None
        assert (np.abs(trajectory.qd_rad_s) <= np.asarray(limits.speed_rad_s)).all()
        assert np.abs(trajectory.qdd_rad_s2).max() <= limits.acceleration_rad_s2
        assert (trajectory.q_rad[[0, -1]].reshape(2, 12) == corners[[0, -1]]).all()
        assert not trajectory.qd_rad_s[[0, -1]].any()
        assert not trajectory.qdd_rad_s2[[0, -1]].any()
        assert trajectory.time_s[0] == 0.0


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("limits", [HARD, TIGHT])
def test_the_first_try_is_released(limits, profile, monkeypatch):
    monkeypatch.setattr(path_timing, "_CARE", (1.0,))
    rng, (gate, law) = np.random.default_rng(1), gate_and_law(limits, profile)
    for _ in range(scaled(160, 40)):
        time_path(random_corners(rng, limits), gate, law)


@pytest.mark.parametrize("blend_rad", [BLEND_RAD, 0.003, 0.1])
def test_it_keeps_its_distance_from_the_straight_parts(blend_rad):
    rng = np.random.default_rng(2)
    gate, law = gate_and_law()
    found = []
    for _ in range(scaled(100)):
        corners = random_corners(rng)
        found.append(off_path_rad(time_path(corners, gate, law, blend_rad=blend_rad), corners) / blend_rad)
    assert max(found) <= 1.0 + 2e-3 / blend_rad  # the parts were sampled
    assert max(found) > 0.3


@pytest.mark.parametrize("length_rad", [2.0, 0.3])
def test_a_straight_path_takes_the_time_of_a_trapezoid(length_rad):
    gate, law = gate_and_law()
    goal = HOME + length_rad * np.eye(12)[5]  # wrist 3 moves no point
    trajectory = time_path(np.array([HOME, goal]), gate, law)
    speed, acceleration = 0.7 * HARD.speed_rad_s[5], 0.5 * HARD.acceleration_rad_s2
    speed = min(speed, np.sqrt(length_rad * acceleration))
    averages = 0.12 + 0.06
    assert trajectory.duration_s == pytest.approx(length_rad / speed + speed / acceleration + averages, abs=0.04)
    assert 0.85 * speed < np.abs(trajectory.qd_rad_s).max() <= 1.001 * speed  # the averages flatten a triangle


def test_a_flange_is_as_fast_as_it_may_be():
    limits = MotionLimits(tcp_speed_m_s=0.25)
    gate, law = gate_and_law(limits)
    goal = HOME + 1.5 * np.eye(12)[0]
    trajectory = time_path(np.array([HOME, goal]), gate, law)
    reach_m = 0.75  # of the flange at home, from the first joint's axis
    assert np.abs(trajectory.qd_rad_s).max() * reach_m == pytest.approx(0.8 * 0.25, rel=0.03)


@pytest.mark.parametrize(
    ("robots", "calibrated"),
    [(("ur3", "ur3"), False), (("ur20", "ur20"), False), (("ur5e", "ur5e"), True), (("ur3e", "ur20"), False)],
    ids=["small", "large", "calibrated", "mixed"],
)
def test_each_model_uses_its_own_cartesian_speed_at_the_first_try(robots, calibrated, monkeypatch):
    monkeypatch.setattr(path_timing, "_CARE", (1.0,))
    limits = MotionLimits(tcp_speed_m_s=0.25).of(robots)
    gate, law = gate_and_law(limits, ServojProfile(robot_model(robots[0]).family))
    home = home_q_rad([ArmMount((0.0, 0.0, 0.0), robot=robot) for robot in robots])
    goal = home + 1.2 * np.eye(6)[0]
    trajectory = time_path(np.array([home, goal]), gate, law)
    time = np.arange(0.0, trajectory.duration_s, 0.002)
    q, fastest = Interpolation(trajectory)(time).q_rad, []
    for arm, robot in enumerate(robots):
        a = np.array(nominal_dh(robot).a_m) - calibrated * np.array([0.0, 0.001, -0.0015, 0.0, 0.0, 0.0])
        dh = dataclasses.replace(nominal_dh(robot), a_m=tuple(a))
        places = np.array([dh_product(each, dh)[:3, 3] for each in q[:, arm]])
        fastest.append(np.linalg.norm(np.diff(places, axis=0), axis=1).max() / 0.002)
    # A calibrated arm may differ from the nominal one by its deviation in length.
    assert 0.97 * 0.8 * 0.25 <= max(fastest) <= (1.001 + 0.005 * calibrated) * 0.8 * 0.25


def test_a_duration_is_kept_or_refused_with_the_shortest():
    gate, law = gate_and_law()
    corners = random_corners(np.random.default_rng(3))
    shortest_s = time_path(corners, gate, law).duration_s
    for duration_s in (shortest_s, shortest_s * 1.7, 60.0):
        trajectory = time_path(corners, gate, law, duration_s=duration_s)
        assert trajectory.duration_s == pytest.approx(duration_s)
        assert refusal_of(trajectory, HOME_Q_RAD, gate, law) is None
    with pytest.raises(TrajectoryError, match=rf"duration_s is 0\.1: .* takes {shortest_s:.3f} s or more\. Allow that"):
        time_path(corners, gate, law, duration_s=0.1)
    with pytest.raises(TrajectoryError, match="is 3601 s ahead, allowed are at most 3600 s"):
        time_path(corners, gate, law, duration_s=3601.0)


@pytest.mark.parametrize("arm", [0, 1])
def test_the_trajectory_of_one_arm_has_no_other(arm):
    gate, law = gate_and_law()
    corners = np.tile(HOME, (3, 1)).reshape(3, 2, 6)
    corners[1:, arm] += [[0.3], [0.5]]
    name = ("left", "right")[arm]
    trajectory = time_path(corners, gate, law, arms=(name,))
    assert trajectory.arms == (name,)
    assert trajectory.q_rad.shape[1:] == (1, 6)
    with pytest.raises(TrajectoryError, match=f"the path moves the {name} arm, which has to stay"):
        time_path(corners, gate, law, arms=(("right", "left")[arm],))


def test_repeated_points_and_reversals_are_passed():
    gate, law = gate_and_law()
    away = HOME + 0.4
    once = time_path(np.array([HOME, away, HOME]), gate, law)
    again = time_path(np.array([HOME, HOME, away, away, away, HOME, HOME]), gate, law)
    np.testing.assert_array_equal(once.q_rad, again.q_rad)
    assert np.abs(once.q_rad.reshape(-1, 12) - HOME).max() == pytest.approx(0.4, abs=BLEND_RAD)


@pytest.mark.parametrize(
    ("path", "changes", "message"),
    [
        (np.zeros((2, 11)), {}, r"must be configurations of both arms, \(points, 2, 6\)"),
        ("home", {}, "must be configurations"),
        (np.zeros((0, 12)), {}, "one point or more"),
        (np.full((2, 12), np.nan), {}, "finite"),
        (np.zeros((1, 12)), {}, "moves no joint"),
        (np.zeros((3, 12)), {}, "moves no joint"),
        (1e5 * np.eye(2, 12), {}, "out of range: left/shoulder_pan_joint is at 100000.*are these degrees"),
        (np.array([[-1e308], [1e308]]) * np.ones(12), {}, "out of range"),
        (6.0 * np.arange(3000)[:, None] % 12 * np.eye(1, 12), {}, "the last point is .* s ahead, allowed are"),
        (np.eye(2, 12), {"blend_rad": 0.0}, "blend_rad is 0.0: it must be above 0"),
        (np.eye(2, 12), {"duration_s": -1.0}, "duration_s is -1.0: it must be above 0"),
        (np.eye(2, 12), {"duration_s": np.inf}, "duration_s is inf: it must be above 0"),
    ],
)
def test_what_cannot_be_timed_is_refused(path, changes, message):
    with pytest.raises(TrajectoryError, match=message):
        time_path(path, *gate_and_law(), **changes)


def test_a_path_through_the_table_is_refused_at_any_speed():
    corners = np.array([HOME, HOME, HOME])
    corners[1, 1] += 0.9
    with pytest.raises(
        TrajectoryError, match=r"refuses .* at any speed: at .* left/.* and table: distance .* Choose ano"
    ):
        time_path(corners, *gate_and_law(distances=CLEARANCE))


def test_planned_paths_are_followed_by_both_arms():
    rng = np.random.default_rng(4)
    executor = made()
    q = HOME
    for _ in range(scaled(60)):
        goal = HOME + rng.uniform(-1.5, 1.5, 12)
        if not CLEARANCE.is_clear(goal[None]).all():
            continue
        path = plan_path(CLEARANCE, q, goal, HARD, rng)
        trajectory = time_path(path, executor.gate, executor.law)
        result = executor.execute(trajectory).wait()
        assert result.state == GoalState.SUCCEEDED, result
        q = goal
    np.testing.assert_allclose(executor.measured_q_rad.reshape(12), q, atol=1e-4)
    check_sent(executor)
