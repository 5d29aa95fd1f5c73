"""Goals on a cell that moves as the law of `servoj` does: results, stops, replacement, streams, and what is refused."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import ClosedError, SettingsError, StartError, TrajectoryError
from dual_ur10.sim2real.trajectory import joint_trajectory, path_check
from dual_ur10.sim2real.trajectory.goal import START_RAD, GoalState, TrajectoryGoal
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.sim2real.trajectory.joint_trajectory import MOST_DURATION_S, JointTrajectory, ResultCode
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from tests.sim2real.trajectory.following import DIRECTIONS, TICKS, check_sent, made, part, wave
from tests.soak import scaled
from ur_core.processes.machine_load import too_busy

LATENCIES = pytest.mark.parametrize("latency_ticks", [0, 5])


def steps(executor, periods):
    for _ in range(periods):
        executor.step()


def assert_on_path(feedback, trajectory, tolerance_rad=2e-4):
    wanted = Interpolation(trajectory)(feedback.path_s).q_rad
    np.testing.assert_allclose(feedback.desired_q_rad, wanted, atol=tolerance_rad)


@LATENCIES
@pytest.mark.parametrize(("order", "points", "error_rad"), [(2, 9, 2e-5), (1, 9, 2e-5), (0, 51, 1e-4)])
def test_a_goal_is_reached_without_lag(latency_ticks, order, points, error_rad):
    executor, trajectory = made(latency_ticks), wave(order=order, points=points)
    seen = []
    handle = executor.execute(trajectory)
    result = handle.wait(seen.append)
    assert (result.state, result.code, result.reason) == (GoalState.SUCCEEDED, ResultCode.SUCCESSFUL, "reached")
    assert handle.state == GoalState.SUCCEEDED
    assert result.largest_error_rad.max() < error_rad
    assert result.largest_flange_error_m.max() < 2 * error_rad
    np.testing.assert_allclose(executor.measured_q_rad, trajectory.q_rad[-1], atol=1e-4)
    for each in seen:
        assert_on_path(each, trajectory, 2e-3 if order == 0 else 2e-4)
    assert len(seen) >= trajectory.duration_s / executor.law.period_s
    check_sent(executor)
    executor.step()
    assert executor.cell.finished == 1


def test_feedback_begins_with_the_goals_own_time():
    executor, seen = made(5), []
    executor.execute(wave()).wait()
    executor.execute(wave(start=executor.desired_q_rad, amplitude=-0.1)).wait(seen.append)
    path_s = [each.path_s for each in seen]
    assert path_s[0] == 0.0
    assert (np.diff(path_s) >= 0.0).all()


def test_both_arms_end_at_the_same_tick():
    executor = made()
    executor.execute(wave(points=5)).wait()
    moved = np.abs(np.diff(executor.cell.sent, axis=0)).max(axis=2) > 1e-9
    left, right = (int(np.flatnonzero(moved[:, arm])[-1]) for arm in range(2))
    assert left == right


def test_the_other_arm_stays_where_it_is():
    executor = made()
    result = executor.execute(wave(arms=("right",))).wait()
    assert result.succeeded
    assert result.largest_error_rad.shape == (1, 6)
    sent = np.array(executor.cell.sent)
    assert (sent[:, 0] == HOME_Q_RAD[0]).all()
    assert np.abs(sent[-1, 1] - HOME_Q_RAD[1]).max() > 0.2


def test_a_later_first_point_is_reached_from_where_the_arms_are():
    executor = made()
    goal = HOME_Q_RAD + 0.2 * DIRECTIONS
    assert executor.execute(JointTrajectory(("left", "right"), [1.0], goal[None])).wait().succeeded
    np.testing.assert_allclose(executor.measured_q_rad, goal, atol=1e-4)
    check_sent(executor)


def test_a_violated_path_tolerance_stops_both_arms_within_two_ticks():
    executor = made()
    handle = executor.execute(wave(amplitude=0.5))
    steps(executor, 60)
    decided_before = executor.time_s
    executor.cell.offset_rad[1, 2] = 0.06
    executor.step()
    assert executor.time_s - decided_before < 2.5 * executor.law.tick_s
    assert handle.state == GoalState.ABORTED
    assert (handle.result.code, handle.result.reason) == (ResultCode.PATH_TOLERANCE_VIOLATED, "path tolerance")
    assert "right/elbow_joint is 0.06" in handle.result.text
    assert "allowed are 0.0500 rad" in handle.result.text
    assert executor.moves
    handle.wait()
    assert not executor.moves
    rest = executor.measured_q_rad
    steps(executor, 125)
    assert np.abs(executor.measured_q_rad - rest).max() < 1e-3
    assert_on_path(handle.feedback, handle.goal.trajectory)
    check_sent(executor)
    executor.cell.offset_rad[:] = 0.0
    assert executor.execute(wave(start=executor.desired_q_rad, amplitude=-0.1)).wait().succeeded


def test_a_tolerance_of_its_own_for_each_joint():
    executor = made()
    tolerance = np.full((2, 6), 0.1)
    tolerance[0, 3] = 0.01
    executor.cell.offset_rad[:] = 0.015
    result = executor.execute(TrajectoryGoal(wave(), path_tolerance_rad=tolerance, goal_tolerance_rad=0.1)).wait()
    assert result.reason == "path tolerance"
    assert "left/wrist_1_joint" in result.text


def test_a_tiny_tolerance_is_told_apart_from_what_was_found():
    result = made().execute(TrajectoryGoal(wave(), path_tolerance_rad=1e-9)).wait()
    found, allowed = re.search(r"is (\S+) rad, allowed are (\S+) rad, from its path", result.text).groups()
    assert float(found) > float(allowed) == 1e-9


@pytest.mark.parametrize(
    ("joint", "angle", "text"),
    [
        (0, -12.6, "left/shoulder_pan_joint is at -12.600 rad, allowed are at least -6.283 rad: are these degrees?"),
        (2, 3.3, "left/elbow_joint is at 3.300 rad, allowed are at most 3.142 rad: choose another angle"),
    ],
)
def test_a_start_outside_the_joint_range_says_so_first(joint, angle, text):
    start = HOME_Q_RAD.copy()
    start[0, joint] = angle
    with pytest.raises(SettingsError, match=f"^{re.escape(text)}$"):
        made().start(start)


def test_an_arm_beside_the_goal_violates_the_goal_tolerance():
    executor = made()
    executor.cell.offset_rad[0, 1] = 0.015
    result = executor.execute(TrajectoryGoal(wave(), goal_time_s=0.4)).wait()
    assert (result.state, result.code) == (GoalState.ABORTED, ResultCode.GOAL_TOLERANCE_VIOLATED)
    assert "left/shoulder_lift_joint is 0.01" in result.text
    assert 2.4 <= result.time_s <= 2.5


@LATENCIES
def test_a_stop_of_an_arm_aborts_the_goal_of_both(latency_ticks):
    executor = made(latency_ticks)
    handle = executor.execute(wave())
    steps(executor, 30)
    following = executor.execute(TrajectoryGoal(wave(), start_s=1.5))
    executor.cell.fault = "both arms were stopped: left: safety mode 3"
    result = handle.wait()
    assert (result.state, result.code, result.reason) == (
        GoalState.ABORTED,
        ResultCode.PATH_TOLERANCE_VIOLATED,
        "stopped",
    )
    assert "safety mode 3" in result.text
    assert following.state == GoalState.REJECTED
    later = executor.execute(wave())
    assert (later.state, later.result.code) == (GoalState.REJECTED, ResultCode.INVALID_GOAL)
    assert "safety mode 3" in later.result.text
    with pytest.raises(StartError, match="safety mode 3"):
        executor.step()
    executor.cell.fault = None
    executor.start(HOME_Q_RAD)
    assert executor.execute(wave()).wait().succeeded


def test_a_diverged_simulation_aborts_the_goal():
    executor = made()
    handle = executor.execute(wave())
    steps(executor, 10)
    executor.cell.diverged = True
    assert handle.wait().reason == "diverged"
    assert executor.execute(wave()).state == GoalState.REJECTED


def test_a_missed_deadline_aborts_the_goal_and_a_pause_between_goals_does_not():
    executor = made(5)
    handle = executor.execute(wave(amplitude=0.1))
    steps(executor, 30)
    executor.cell.pauses = 1
    late = handle.wait()
    assert late.reason == "late"
    assert late.text == too_busy("this program missed the deadline of a period, and both arms stopped")
    executor.cell.pauses = 2
    result = executor.execute(wave(start=executor.desired_q_rad, amplitude=-0.1)).wait()
    assert result.succeeded


def test_a_refused_target_brakes_both_arms():
    executor = made()
    handle = executor.execute(wave())
    steps(executor, 60)
    executor.stepper.law = dataclasses.replace(executor.law, lookahead_s=0.2)
    result = handle.wait()
    assert (result.code, result.reason) == (ResultCode.PATH_TOLERANCE_VIOLATED, "refused")
    assert "allowed at most" in result.text
    check_sent(executor)
    assert np.abs(np.diff(executor.cell.sent[-3:], axis=0)).max() < 1e-4
    assert executor.execute(wave()).state == GoalState.REJECTED


def test_the_scaling_stretches_time_and_keeps_the_path():
    executor, trajectory = made(), wave(amplitude=0.5)
    handle = executor.execute(trajectory)
    steps(executor, 40)
    executor.scaling = 0.25
    steps(executor, 40)
    assert handle.feedback.scaling == pytest.approx(0.25)
    assert_on_path(handle.feedback, trajectory)
    executor.scaling = 1.0
    result = handle.wait()
    assert result.succeeded
    assert result.largest_error_rad.max() < 5e-5
    assert result.time_s > 2.4
    check_sent(executor)


@pytest.mark.parametrize(
    ("scaling", "first_s", "takes"), [(0.05, 3.9, ""), (0.01, 10.0, "1000 s"), (1.0, 81.0, "81 s")]
)
def test_a_way_to_a_late_first_point_that_takes_long_to_check_is_refused(scaling, first_s, takes):
    executor, later = made(), wave()
    executor.scaling = scaling
    handle = executor.execute(dataclasses.replace(later, time_s=first_s + later.time_s))
    steps(executor, 3)
    if not takes:
        assert handle.state == GoalState.ACTIVE
        return
    assert handle.state == GoalState.REJECTED
    assert f"takes {takes} at a scaling of {scaling:g}, allowed are 79.952 s. Let the first" in handle.result.text


@pytest.mark.parametrize("value", [0.0, 1.1, -1, "1", True, np.nan])
def test_other_scalings_are_refused(value):
    executor = made()
    with pytest.raises(SettingsError, match="scaling"):
        executor.scaling = value


# Random instants.


def draw(rng):
    """Return an executor and a motion of random size, duration and order."""
    executor = made(int(rng.choice([0, 5])))
    order = int(rng.integers(3))
    duration = rng.uniform(1.0, 3.0)
    amplitude = rng.uniform(0.05, 0.25) * duration * (1.0 if order else 0.25)  # lines have corners
    points = int(rng.integers(4, 20)) if order else int(duration / 0.04)
    return executor, wave(duration, points, amplitude, order)


def test_a_goal_is_cancelled_at_random_instants():
    for seed in range(scaled(400, 40)):
        rng = np.random.default_rng(seed)
        executor, trajectory = draw(rng)
        handle = executor.execute(trajectory)
        steps(executor, int(rng.integers(0, int(trajectory.duration_s / executor.law.period_s) + 20)))
        over = handle.result is not None
        handle.cancel()
        result = handle.wait()
        assert (result.state, result.code) == (
            GoalState.SUCCEEDED if over else GoalState.PREEMPTED,
            ResultCode.SUCCESSFUL,
        ), (seed, result.text)
        check_sent(executor)
        if handle.feedback is not None:
            assert_on_path(handle.feedback, trajectory, 3e-3 if trajectory.qd_rad_s is None else 5e-4)
            rest = executor.measured_q_rad
            steps(executor, 20)
            assert np.abs(executor.measured_q_rad - rest).max() < 1e-3, seed


def test_a_goal_is_replaced_at_random_instants():
    for seed in range(scaled(400, 40)):
        rng = np.random.default_rng(seed)
        executor, trajectory = draw(rng)
        handle = executor.execute(trajectory)
        periods = int(rng.integers(0, int(trajectory.duration_s / executor.law.period_s)))
        steps(executor, periods)
        at_once = bool(rng.integers(2))
        second = wave(rng.uniform(1.0, 2.0), 7, rng.uniform(-0.2, 0.2), 1, first_s=0.0 if at_once else 2.0)
        deferred_s = executor.time_s + rng.uniform(0.0, 1.0) if rng.integers(2) else None
        after = executor.execute(TrajectoryGoal(second, start_s=deferred_s))
        result = after.wait()
        first = handle.wait()
        check_sent(executor)
        if after.state == GoalState.REJECTED:
            assert at_once, (seed, result.text)
            assert result.code == ResultCode.INVALID_GOAL
            assert first.succeeded, (seed, first.text)
            continue
        assert result.succeeded, (seed, result.text)
        ended = first.state == GoalState.SUCCEEDED
        assert ended or (first.state, first.reason) == (GoalState.PREEMPTED, "replaced"), (seed, first.text)
        np.testing.assert_allclose(executor.measured_q_rad, second.q_rad[-1], atol=1e-3)


def test_a_stream_runs_out_of_points_at_random_instants():
    for seed in range(scaled(400, 40)):
        rng = np.random.default_rng(seed)
        executor = made(int(rng.choice([0, 5])))
        duration = rng.uniform(1.0, 3.0)
        order = int(rng.integers(3))
        amplitude = rng.uniform(0.05, 0.2) * duration * (1.0 if order else 0.25)
        trajectory = wave(duration, int(duration * 25) + 1, amplitude, order)
        known = 20
        last = int(rng.integers(known, len(trajectory)))
        handle = executor.execute(TrajectoryGoal(part(trajectory, 0, known), stream=True))
        while known < last and handle.result is None:
            executor.step()
            if trajectory.time_s[known - 1] < executor.time_s + 0.8:
                count = min(int(rng.integers(1, 4)), last - known)
                handle.append(part(trajectory, known, known + count))
                known += count
        if known == len(trajectory) and rng.integers(2):
            handle.complete()
        result = handle.wait()
        check_sent(executor)
        if handle.goal.stream:
            assert (result.state, result.code, result.reason) == (
                GoalState.ABORTED,
                ResultCode.GOAL_TOLERANCE_VIOLATED,
                "underrun",
            ), (seed, result.text)
            assert handle.feedback.path_s < trajectory.time_s[known - 1]
        else:
            assert result.succeeded, (seed, result.text)
        assert_on_path(handle.feedback, trajectory, 3e-3 if trajectory.qd_rad_s is None else 5e-4)


def test_a_stream_goes_on_for_long_without_keeping_its_past(monkeypatch):
    monkeypatch.setattr(joint_trajectory, "MOST_DURATION_S", 3.0)  # ahead of the arms
    executor = made()
    trajectory = wave(20.0, 501, 0.4)
    handle = executor.execute(TrajectoryGoal(part(trajectory, 0, 30), stream=True))
    for known in range(30, 501):
        handle.append(part(trajectory, known, known + 1))
        while handle.result is None and executor.time_s < trajectory.time_s[known] - 0.5:
            executor.step()
    assert len(handle.goal.trajectory) < 60
    later = executor.stepper.course.path_s(executor.time_s) + 3.01
    with pytest.raises(TrajectoryError, match=r"the last point is 3\.01 s ahead, allowed are at most 3 s in one goal"):
        handle.append(dataclasses.replace(part(trajectory, 500, 501), time_s=[later]))
    handle.complete()
    result = handle.wait()
    assert result.succeeded, result.text
    assert result.largest_error_rad.max() < 2e-5
    with pytest.raises(TrajectoryError, match="succeeded"):
        handle.append(part(trajectory, 0, 1))


# What is refused.


def through_the_table():
    down = HOME_Q_RAD.copy()
    down[0, 1] += 0.6
    return JointTrajectory(("left", "right"), [0.0, 4.0], np.stack([HOME_Q_RAD, down]), np.zeros((2, 2, 6)))


@pytest.mark.parametrize(
    ("trajectory", "text"),
    [
        (wave(0.5, amplitude=0.6), r"refused between points 0 and 1, at 0\.000 s right/wrist_1_joint: joint accel"),
        (wave(1.0, order=1, amplitude=1.5), r"refused between points \d and \d, at 0\.\d+ s \w+/\w+: joint speed"),
        (wave(3.0, amplitude=3.0), "left/flange: Cartesian speed"),
        (through_the_table(), r"between points 0 and 1, at 2\.\d+ s left/\w+ and table: distance"),
        (wave(2.0, points=3, order=0, amplitude=0.6), "joint acceleration"),
        (wave(start=HOME_Q_RAD + 2 * START_RAD), r"point 0 of left/\w+ is at .* allowed are 0\.01 rad"),
    ],
)
def test_a_path_that_cannot_be_followed_is_rejected_and_nothing_moves(trajectory, text):
    executor = made()
    result = executor.execute(trajectory).wait()
    assert (result.state, result.code) == (GoalState.REJECTED, ResultCode.INVALID_GOAL)
    assert re.search(text, result.text), result.text
    assert (np.array(executor.cell.sent) == HOME_Q_RAD).all()


@pytest.mark.parametrize("time_s", [[0.0, MOST_DURATION_S + 1.0], [MOST_DURATION_S + 1.0]])
@pytest.mark.parametrize("stream", [False, True])
def test_a_goal_that_lasts_too_long_is_rejected(time_s, stream):
    executor = made()
    running = executor.execute(wave())
    steps(executor, 10)
    points = JointTrajectory(("left", "right"), time_s, [HOME_Q_RAD] * len(time_s))
    result = executor.execute(TrajectoryGoal(points, stream=stream)).result
    assert (result.state, result.code) == (GoalState.REJECTED, ResultCode.INVALID_GOAL)
    assert "is 3601 s ahead, allowed are at most 3600 s in one goal: cut the trajectory into goals" in result.text
    assert running.wait().succeeded


@pytest.mark.parametrize("arms_move", [False, True])
@given(st.data())
def test_finite_points_of_any_size_raise_nothing(arms_move, data):
    executor = made()
    running = executor.execute(wave()) if arms_move else None
    steps(executor, 10)
    count, order = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 2))
    exponents = st.integers(-320, 308)
    gaps = [10.0 ** min(data.draw(exponents), 3) for _ in range(count)]
    time_s = np.unique(np.cumsum(gaps))
    values = np.zeros((3, len(time_s), 2, 6)) + np.stack([HOME_Q_RAD, np.zeros((2, 6)), np.zeros((2, 6))])[:, None]
    for _ in range(data.draw(st.integers(1, 3))):
        place = tuple(data.draw(st.integers(0, size - 1)) for size in (order + 1, *values.shape[1:]))
        values[place] = data.draw(st.sampled_from([-1.0, 1.0])) * 10.0 ** data.draw(st.integers(2, 308))
    points = JointTrajectory(("left", "right"), time_s, *values[: order + 1])
    handle = executor.execute(TrajectoryGoal(points, stream=True))
    steps(executor, 20)
    assert handle.state != GoalState.SUCCEEDED
    assert running is None or handle.state != GoalState.REJECTED or running.state == GoalState.ACTIVE
    check_sent(executor)


@pytest.mark.parametrize(
    ("time_s", "speed", "where"),
    [
        ([0.0, 1.0, 2.0], 1e308, "between points 0 and 1"),
        ([0.0, 1e-310, 1.0], 0.0, "between points 0 and 1"),
    ],
)
def test_points_that_cannot_be_computed_are_named(time_s, speed, where):
    executor = made()
    q = HOME_Q_RAD + np.array([0.0, 0.0, 0.1])[:, None, None]
    points = JointTrajectory(("left", "right"), time_s, q, np.array([0.0, speed, 0.0])[:, None, None] * np.ones((2, 6)))
    text = executor.execute(points).result.text
    assert text.startswith(f"the path is too steep to compute {where}: correct their times")
    stream = executor.execute(TrajectoryGoal(part(wave(), 0, 3), stream=True))
    with pytest.raises(TrajectoryError, match="the path is too steep to compute between points 2 and 3"):
        stream.append(part(dataclasses.replace(wave(), q_rad=np.full((9, 2, 6), 1e200)), 3, 4))
    assert stream.state == GoalState.PENDING


def test_the_targets_of_a_long_path_are_not_computed_at_once(monkeypatch):
    whole = made().execute(through_the_table()).result.text
    counts, windows = [], TargetLaw.windows
    monkeypatch.setattr(path_check, "_WINDOWS_AT_ONCE", 7)
    monkeypatch.setattr(
        TargetLaw,
        "windows",
        lambda law, course, from_s, count: counts.append(count) or windows(law, course, from_s, count),
    )
    assert made().execute(through_the_table()).result.text == whole
    assert len(counts) > 10
    assert max(counts) == 7


def test_arms_that_are_not_where_they_were_commanded_begin_nothing():
    executor = made()
    executor.cell.offset_rad[1, 0] = 0.03
    result = executor.execute(wave()).wait()
    assert result.state == GoalState.REJECTED
    assert "right/shoulder_pan_joint is measured at" in result.text


def test_a_rejected_replacement_leaves_the_running_goal_alone():
    executor = made()
    handle = executor.execute(wave())
    steps(executor, 30)
    assert executor.execute(wave(0.3, amplitude=0.5)).wait().state == GoalState.REJECTED
    assert handle.wait().succeeded


def test_a_start_in_the_past_has_a_code_of_its_own():
    executor = made()
    steps(executor, 10)
    result = executor.execute(TrajectoryGoal(wave(), start_s=0.1)).result
    assert result.code == ResultCode.OLD_HEADER_TIMESTAMP


@LATENCIES
def test_a_deferred_start_waits_for_its_time_and_counts_from_it(latency_ticks):
    """Feedback of arms that follow later counts from the begin until they show the motion; the motion does not wait."""
    executor = made(latency_ticks)
    handle = executor.execute(TrajectoryGoal(wave(), start_s=0.5))
    steps(executor, 30)
    assert handle.state == GoalState.PENDING
    steps(executor, 10)
    assert executor.stepper.course.path_s(executor.time_s) == pytest.approx(executor.time_s - 0.5, abs=1e-12)
    assert handle.wait().time_s == pytest.approx(2.5, abs=0.1)


def test_an_arm_that_moves_must_be_in_the_goal_that_replaces_its():
    executor = made()
    handle = executor.execute(wave())
    steps(executor, 30)
    result = executor.execute(wave(arms=("left",))).result
    assert result.code == ResultCode.INVALID_JOINTS
    assert handle.wait().succeeded


def test_goals_wait_until_aborted_motion_has_ended():
    executor = made()
    executor.execute(wave(amplitude=0.5))
    steps(executor, 60)
    executor.cell.offset_rad[0, 0] = 0.06
    executor.step()
    assert "wait until they rest" in executor.execute(wave()).result.text


def test_a_pending_goal_is_cancelled_or_replaced_by_another():
    executor = made()
    first = executor.execute(TrajectoryGoal(wave(), start_s=1.0))
    second = executor.execute(TrajectoryGoal(wave(), start_s=1.0))
    assert (first.state, first.result.reason) == (GoalState.PREEMPTED, "replaced")
    second.cancel()
    assert (second.state, second.result.reason) == (GoalState.PREEMPTED, "cancelled")
    steps(executor, 80)
    assert (np.array(executor.cell.sent) == HOME_Q_RAD).all()


def test_points_of_a_stream_must_continue_it():
    executor, trajectory = made(), wave(3.0, 76)
    handle = executor.execute(TrajectoryGoal(part(trajectory, 0, 30), stream=True))
    steps(executor, 5)
    for points, text in (
        (part(trajectory, 20, 25), "times must increase"),
        (part(wave(3.0, 76, order=1), 30, 31), "exactly where the points before do"),
        (part(wave(3.0, 76, arms=("left",)), 30, 31), "send all of its arms"),
        (part(wave(3.0, 76, amplitude=2.0), 30, 31), "joint"),
    ):
        with pytest.raises(TrajectoryError, match=text):
            handle.append(points)
    with pytest.raises(TrajectoryError, match="it must be at rest"):
        handle.complete()
    handle.append(part(trajectory, 30, 76))
    handle.complete()
    assert handle.wait().succeeded


def test_a_closed_executor_and_one_without_a_start_move_nothing():
    executor = made()
    executor.start(HOME_Q_RAD)
    executor.close()
    with pytest.raises(ClosedError):
        executor.execute(wave())
    with pytest.raises(ClosedError):
        executor.step()


def test_a_new_start_ends_what_runs():
    executor = made()
    handle, after = executor.execute(wave()), None
    steps(executor, 20)
    after = executor.execute(TrajectoryGoal(wave(), start_s=1.0))
    executor.start(HOME_Q_RAD)
    assert handle.state == GoalState.PREEMPTED
    assert after.state == GoalState.REJECTED
    assert executor.time_s == 0.0
    assert executor.law.ticks == TICKS
