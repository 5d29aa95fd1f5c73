"""servoj: its law, and what stops it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.motion_runs import DT, Q0, SUBSTEPS, TICK_S, at_rest, motion, run, until_fault
from ur_core.kinematics.ur10 import JOINT_SPEED_RAD_S
from ur_core.servoj import ServojLaw
from ur_emulator.profile import Assumptions


def _targets(seed: int, ticks: int) -> np.ndarray:
    steps = np.random.default_rng(seed).uniform(-1, 1, (ticks, 6)) * 0.004
    return Q0 + np.cumsum(steps, axis=0)


@settings(max_examples=scaled(400))
@given(seed=st.integers(0, 2**32), lookahead=st.floats(0.03, 0.2), gain=st.floats(100, 2000), scale=st.floats(0.8, 1.2))
def test_servoj_is_the_servoj_law(seed, lookahead, gain, scale):
    arm = motion(lookahead_scale=scale)
    transition = ServojLaw(lookahead * scale, gain).transition(DT)
    state = np.array([Q0, np.zeros(6)])
    for target in _targets(seed, 60):
        handle = arm.servo_joints(target, TICK_S, lookahead, gain)
        plan = arm.plan()
        assert handle.done
        for row in range(SUBSTEPS):
            assert np.abs(plan[row, 0] - state[0]).max() < 1e-12
            state[0] -= target
            state = transition @ state
            state[0] += target
        assert np.abs(arm.q - state[0]).max() < 1e-12
    assert arm.fault is None


def test_settings_outside_the_range_are_brought_into_it():
    runs = []
    for lookahead, gain in ((0.001, 1e6), (0.03, 2000.0)):
        arm = motion()
        arm.servo_joints(Q0 + 0.02, 0.5, lookahead, gain)
        runs.append(run(arm, 30))
    assert np.array_equal(*runs)


def test_t_is_rounded_up_to_control_periods():
    for t, ticks in ((0.0, 1), (0.002, 1), (TICK_S, 1), (0.009, 2), (3 * TICK_S, 3), (0.1, 13)):
        arm = motion()
        handle = arm.servo_joints(Q0 + 0.001, t, 0.1, 300)
        taken = 0
        while not handle.done:
            arm.plan()
            taken += 1
        assert taken == ticks


def test_servoj_follows_another_motion_without_a_jump():
    arm = motion()
    arm.speed_joints([0.5, -0.5, 0.4, 0.3, 0.2, 1.0], 5.0, 0.4)
    before = run(arm, 50)
    speed = arm.qd.copy()
    target = arm.q + 0.05 * speed
    arm.servo_joints(target, 0.5, 0.1, 300)
    after = run(arm, 50)
    rate = np.diff(np.vstack([before, after[1:]]), axis=0) / DT
    assert np.abs(np.diff(rate, axis=0)).max() / DT < 30.0
    assert np.abs(arm.q - target).max() < 2e-3


def test_servoj_at_half_speed_takes_twice_as_long():
    runs = []
    for scaling, ticks in ((1.0, 40), (0.5, 80)):
        arm = motion()
        arm.servo_joints(Q0 + 0.03, 1.0, 0.1, 300)
        runs.append(run(arm, ticks, scaling))
    assert np.abs(runs[1][::2] - runs[0]).max() < 1e-12


def test_a_target_that_jumps_is_a_fault_and_is_not_executed():
    for joint in range(6):
        for factor, faulty in ((0.999, False), (1.001, True)):
            arm = motion()
            target = Q0.copy()
            target[joint] += factor * 1.5 * JOINT_SPEED_RAD_S[joint] * (0.05 + TICK_S)
            arm.servo_joints(target, 0.002, 0.05, 300)
            assert (arm.fault is not None) == faulty
            arm.plan()
            if arm.fault is not None:
                assert arm.fault.code == "C204A1"
                assert f"joint {joint}" in arm.fault.text
                assert np.array_equal(arm.q, Q0)


def test_a_faulty_target_ends_the_motion_by_a_quick_stop():
    arm = motion()
    for k in range(60):
        arm.servo_joints(Q0 + 0.008 * (k + 1), TICK_S, 0.03, 2000)
        arm.plan()
    speed = arm.qd.copy()
    handle = arm.servo_joints(Q0 + 3.0, TICK_S, 0.03, 2000)
    assert arm.fault is not None
    arm.plan()
    assert handle.done
    assert handle.aborted
    ignored = arm.servo_joints(arm.q, TICK_S, 0.03, 2000)
    assert not ignored.done  # until the tick is over, so that no program spins
    path = at_rest(arm, 30)
    assert ignored.aborted
    rate = np.diff(path, axis=0) / DT
    assert (rate[:-1] * speed >= -1e-12).all()
    assert np.abs(np.diff(rate, axis=0)).max() / DT <= JOINT_SPEED_RAD_S.max() / 0.15 * 1.01


@pytest.mark.parametrize("late", range(6))
def test_a_late_program_is_stopped_while_the_arm_moves(late):
    arm = motion(assumptions=Assumptions(starved_ticks=3))
    for k in range(60):
        arm.servo_joints(Q0 + 0.004 * (k + 1), TICK_S, 0.1, 300)
        arm.plan()
    for _ in range(late):
        arm.plan()
    assert (arm.fault is not None) == (late > 3)
    if arm.fault is not None:
        assert arm.fault.code == "C204A3"
        at_rest(arm)


def test_a_program_may_stop_commanding_at_rest():
    arm = motion()
    for _ in range(100):
        arm.servo_joints(Q0 + 0.001, TICK_S, 0.1, 300)
        arm.plan()
    run(arm, 600)
    assert arm.fault is None
    assert not arm.moving
    assert np.abs(arm.q - Q0 - 0.001).max() < 1e-9


def test_a_pause_is_no_starvation():
    arm = motion()
    for k in range(60):
        arm.servo_joints(Q0 + 0.004 * (k + 1), TICK_S, 0.1, 300)
        arm.plan()
    for scaling in [*np.linspace(0.95, 0.0, 19), *[0.0] * 50]:
        arm.plan(float(scaling))
    assert arm.fault is None
    arm.servo_joints(arm.q, TICK_S, 0.1, 300)
    arm.plan(0.05)
    assert arm.fault is None


def test_a_setpoint_that_is_too_fast_is_a_fault():
    arm = motion()
    ahead = np.array([0, 0, 0, 0, 0, 0.03])
    until_fault(arm, "C204A5", lambda k: arm.servo_joints(Q0 + ahead * (k + 1), TICK_S, 0.03, 2000), 100)
    assert np.abs(arm.qd).max() <= 1.1 * JOINT_SPEED_RAD_S[5]


def test_a_servoj_at_speed_zero_returns():
    arm = motion()
    handle = arm.servo_joints(Q0 + 0.01, 2 * TICK_S, 0.1, 300)
    arm.plan(0.0)
    assert not handle.done
    arm.plan(0.0)
    assert handle.done
    assert np.array_equal(arm.q, Q0)
