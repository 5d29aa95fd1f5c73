"""Goals on two emulated controllers on a virtual clock: the whole runner below the executor."""

import logging
import math

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import StartError
from dual_ur10.follower import LEAD_S, make_follower
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.arm_sender import MOST_LATE_S
from dual_ur10.sim2real.runtime.runner import MARGIN_S, SHOWN_STATES
from dual_ur10.sim2real.trajectory import GoalState, ResultCode, TrajectoryGoal
from dual_ur10.sim2real.trajectory.repeatability import UR10_M, returns, spread_of
from dual_ur10.testing import VirtualCell
from tests.sim2real.trajectory.following import part, wave


@pytest.fixture
def virtual_cell(request):
    with VirtualCell(**getattr(request, "param", {})) as cell:
        yield cell


@pytest.fixture
def executor(virtual_cell):
    with make_follower(virtual_cell) as executor:
        executor.start(HOME_Q_RAD)
        yield executor


def steps(handle, count):
    for _ in range(count):
        handle.step()


nominal = pytest.mark.parametrize("virtual_cell", [{"plant": "nominal"}], indirect=True, ids=["nominal"])


@nominal
def test_goals_follow_each_other_and_both_arms_end_together(virtual_cell, executor, caplog):
    result = executor.execute(wave(1.0)).wait()
    assert result.succeeded, result.text
    assert result.largest_error_rad.max() < 2e-5
    targets = [np.array([numbers[:6] for _, _, numbers in virtual_cell.packages(arm)]) for arm in ("left", "right")]
    ends = [int(np.flatnonzero(np.abs(np.diff(each, axis=0)).max(axis=1) > 1e-9)[-1]) for each in targets]
    assert abs(ends[0] - len(targets[0]) - (ends[1] - len(targets[1]))) <= 1  # a package may be on its way
    virtual_cell.clock.sleep(1.0)  # a program may pause between two goals
    with caplog.at_level(logging.WARNING, "dual_ur10.sim2real.runtime"):
        assert executor.execute(wave(1.0, amplitude=-0.2, start=executor.desired_q_rad)).wait().succeeded
    assert not caplog.records
    assert not virtual_cell.fault


@nominal
def test_a_goal_is_replaced_and_cancelled(executor):
    first = executor.execute(wave(2.0))
    steps(first, 60)
    second = executor.execute(wave(1.0, first_s=1.0))
    steps(second, 80)
    assert first.result.reason == "replaced"
    second.cancel()
    assert second.wait().state == GoalState.PREEMPTED
    assert second.result.largest_error_rad.max() < 1e-3


@nominal
def test_a_stream_without_points_stops(virtual_cell, executor):
    whole = wave(3.0, 76, order=1)
    handle = executor.execute(TrajectoryGoal(part(whole, 0, 25), stream=True))
    steps(handle, 10)
    handle.append(part(whole, 25, 40))
    result = handle.wait()
    assert (result.code, result.reason) == (ResultCode.GOAL_TOLERANCE_VIOLATED, "underrun")
    assert handle.feedback.path_s < whole.time_s[39]
    assert not virtual_cell.fault


def test_a_protective_stop_of_one_arm_aborts_the_goal_of_both(virtual_cell, executor):
    handle = executor.execute(wave(2.0))
    steps(handle, 60)
    virtual_cell.ask("stop", arm="left", mode=3)
    result = handle.wait()
    assert (result.state, result.code) == (GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED)
    assert "left: safety mode 3 (PROTECTIVE_STOP)" in result.text
    read = [np.array(virtual_cell.ask("state", arm=arm, names=["actual_q"])["actual_q"]) for arm in ("left", "right")]
    virtual_cell.clock.sleep(2.0)
    for arm, before in zip(("left", "right"), read, strict=True):
        after = np.array(virtual_cell.ask("state", arm=arm, names=["actual_q"])["actual_q"])
        assert np.abs(after - before).max() < 0.01
    executor.close()
    (box,) = (virtual_cell.system.state_folder() / "black_boxes").glob("*.mcap")  # no run without one
    run = read_run(box)
    assert (run.header.env_id, run.header.source) == ("trajectories", "emulated")
    assert all(len(arm.sent["target_rad"]) > 60 for arm in run.arms)


def test_nothing_follows_a_stop_before_it_is_cleared(virtual_cell, executor):
    handle = executor.execute(wave(2.0))
    steps(handle, 60)
    virtual_cell.ask("stop", arm="left", mode=3)
    handle.wait()
    later = executor.execute(wave(2.0)).result
    assert later.code == ResultCode.INVALID_GOAL
    assert ".clear()" in later.text
    with pytest.raises(StartError):
        executor.step()


def test_a_violated_tolerance_stops_both_arms_and_is_no_fault(virtual_cell, executor):
    handle = executor.execute(TrajectoryGoal(wave(2.0, amplitude=0.6), path_tolerance_rad=3e-4))
    result = handle.wait()
    assert result.code == ResultCode.PATH_TOLERANCE_VIOLATED
    rest = executor.measured_q_rad
    steps(handle, 125)
    assert np.abs(executor.measured_q_rad - rest).max() < 0.01
    assert not virtual_cell.fault


@pytest.mark.parametrize("virtual_cell", [{"plant": "nominal", "family": "e-series"}], indirect=True, ids=["e-series"])
def test_a_stall_shorter_than_the_lead_costs_a_known_motion_nothing(virtual_cell, executor):
    """A motion that is known ahead is written ahead. A policy owes each action by its own deadline."""
    law = executor.law
    stall_s = LEAD_S - MARGIN_S - law.period_s - (1 + SHOWN_STATES) * law.tick_s
    handle = executor.execute(TrajectoryGoal(wave(1.0), path_tolerance_rad=1e-3))
    for _ in range(2):
        steps(handle, round(0.25 / law.period_s))
        virtual_cell.clock.sleep(stall_s)
    result = handle.wait()
    assert result.succeeded, result.text
    assert result.largest_error_rad.max() < 1e-4  # each state is compared with the path of its own time
    assert not virtual_cell.fault


@nominal
def test_a_cancel_leaves_what_is_written_and_stops_the_arms_after_it(executor):
    law, runner = executor.law, executor.cell.runner
    handle = executor.execute(wave(2.0, amplitude=0.3))
    steps(handle, round(0.7 / law.period_s))
    course, cancelled_s = executor.stepper.course, executor.time_s
    sent = [memory.sent_count for memory in runner.arms]
    handle.cancel()
    assert handle.wait().reason == "cancelled"
    assert np.abs(executor.stepper.measured_qd_rad_s).max() < 0.01
    around = math.ceil(2 * LEAD_S / law.period_s)
    wanted = law.windows(course, cancelled_s - around * law.period_s, 2 * around).reshape(-1, 2, 6)
    for arm, memory in enumerate(runner.arms):
        rows = memory.sent(sent[arm])[0].target_rad
        apart = np.array([np.abs(wanted[:, arm] - row).max(axis=1).min() for row in rows])
        first = int(np.flatnonzero(apart > 1e-6)[0])  # the first that is none of the former course's
        assert LEAD_S / 2 <= first * law.tick_s <= LEAD_S + law.period_s + law.tick_s


def test_the_lead_is_what_the_arms_survive():
    assert LEAD_S == MOST_LATE_S


@nominal
def test_a_late_program_aborts_its_goal_and_can_send_another(virtual_cell, executor):
    handle = executor.execute(wave(2.0))
    steps(handle, 40)
    virtual_cell.clock.sleep(0.3)
    assert handle.wait().reason == "late"
    assert not virtual_cell.fault
    assert executor.execute(wave(2.0, start=executor.desired_q_rad, amplitude=0.1)).wait().succeeded


def test_nothing_moves_without_confirmation():
    with VirtualCell(plant="nominal") as cell, make_follower(cell, confirm=lambda question: False) as executor:
        with pytest.raises(StartError, match="not confirmed"):
            executor.start(HOME_Q_RAD)
        assert executor.execute(wave()).state == GoalState.REJECTED


def test_friction_spreads_returns_less_than_the_data_sheet_allows(executor):
    found = list(returns(executor, 2, np.random.default_rng(0)))
    spread = spread_of(np.stack([executor.flanges_m(q_rad) for q_rad in found]))
    assert (spread.iso_9283_m > 1e-7).all()  # the plant has friction
    assert (spread.iso_9283_m < UR10_M / 2).all()


def test_one_arm_alone_moves():
    with VirtualCell(plant="nominal") as cell, make_follower(cell, arm="right") as executor:
        executor.start(HOME_Q_RAD)
        assert executor.execute(wave(1.0, arms=("right",), amplitude=0.1)).wait().succeeded
        for arms in (("left",), ("left", "right")):
            result = executor.execute(wave(1.0, arms=arms, amplitude=0.1)).wait()
            assert (result.code, "the left arm is held" in result.text) == (ResultCode.INVALID_JOINTS, True)
        left = np.array([numbers[:6] for _, _, numbers in cell.packages("left")])
        assert np.ptp(left[-50:], axis=0).max() < 1e-9


def test_a_cell_of_one_arm_takes_no_target_that_moves_the_other():
    with VirtualCell(plant="nominal") as cell, make_follower(cell, arm="right") as executor:
        executor.start(HOME_Q_RAD)
        executor._only = None  # as if nothing above the cell had refused it
        result = executor.execute(wave(1.0, arms=("left",), amplitude=0.1)).wait()
        assert "the left arm is held, and a target would move it" in result.text
        left = np.array([numbers[:6] for _, _, numbers in cell.packages("left")])
        assert np.ptp(left[-50:], axis=0).max() < 1e-9
