"""speedj, speedl, stopj, stopl, and the ends of programs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.motion_runs import (
    DT,
    Q0,
    SUBSTEPS,
    TICK_S,
    at_rest,
    motion,
    pose,
    positions,
    run,
    until_done,
    until_fault,
)
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from ur_emulator.motion.tool_kinematics import rotvec_of


def test_speedj_returns_at_its_speed():
    arm = motion()
    speed = np.array([0.4, -0.2, 0.1, 0.0, 0.3, -0.4])
    path, ticks = until_done(arm, arm.speed_joints(speed, 2.0))
    assert ticks == math.ceil(0.4 / 2.0 / TICK_S)
    rate = np.diff(path, axis=0) / DT
    assert np.abs(np.diff(rate, axis=0)).max() <= 2.0 * DT * (1 + 1e-6)
    arm.plan()
    assert np.abs(arm.qd - speed).max() < 1e-9
    # It moves along a line all the time.
    fraction = (path - Q0) @ speed / (speed @ speed)
    assert np.abs(path - Q0 - np.outer(fraction, speed)).max() < 1e-12


def test_speedj_returns_after_t_at_any_speed():
    arm = motion()
    _, ticks = until_done(arm, arm.speed_joints([2.0] * 6, 0.5, 10 * TICK_S))
    assert ticks == 10
    assert arm.qd == pytest.approx(0.5 * (10 * TICK_S - DT / 2))


@pytest.mark.parametrize("tick_s", [0.008, 0.002])
def test_a_stream_of_speedj_accelerates_as_one_does(tick_s):
    """The control script of ur_rtde calls it in every control period."""
    once, stream = motion(tick_s=tick_s, substeps=1), motion(tick_s=tick_s, substeps=1)
    once.speed_joints([0.5] * 6, 1.4, 1.0)
    for _ in range(50):
        stream.speed_joints([0.5] * 6, 1.4, tick_s)
        assert np.abs(once.plan() - stream.plan()).max() < 1e-9


def test_speedj_is_reduced_to_the_limits_in_its_direction():
    arm = motion(np.zeros(6))
    arm.speed_joints([4.0, 2.0, 0.0, 0.0, 0.0, 2.0], 40.0, 0.5)
    run(arm, 30)
    assert np.allclose(arm.qd, JOINT_SPEED_RAD_S[0] * np.array([1, 0.5, 0, 0, 0, 0.5]))


@pytest.mark.parametrize("kind", ["joints", "linear"])
def test_a_speed_without_renewal_decays(kind):
    arm = motion()
    if kind == "joints":
        until_done(arm, arm.speed_joints([0.5] * 6, 5.0))
    else:
        until_done(arm, arm.speed_linear([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], 1.0))
    before = arm.qd.copy()
    path = run(arm, arm.assumptions.starved_ticks)
    assert np.abs(arm.qd).max() > 0.9 * np.abs(before).max()
    path = at_rest(arm)
    assert arm.fault is None
    assert np.abs(np.diff(path, 2, axis=0)).max() / DT**2 <= 8.0 * (1 + 1e-6)


def test_speedj_stops_before_a_joint_limit():
    start = np.zeros(6)
    start[2] = 2.5
    arm = motion(start)
    until_fault(arm, "C150A0", lambda _: arm.speed_joints([0, 0, 1.5, 0, 0, 0], 5.0, TICK_S), 400)
    at_rest(arm)
    assert JOINT_RANGE_RAD[2] - 0.05 < arm.q[2] <= JOINT_RANGE_RAD[2]
    arm.fault = None
    until_done(arm, arm.speed_joints([0, 0, -0.5, 0, 0, 0], 5.0, 0.4))
    assert arm.fault is None


def test_speedl_moves_the_tcp_straight_at_its_speed():
    arm = motion()
    arm.set_tcp([0.0, 0.05, 0.1, 0.0, 0.3, 0.0])
    start = arm.arm.tcp(arm.q, arm.tool)
    twist = np.array([0.05, -0.08, 0.06, 0.0, 0.2, 0.1])
    for _ in range(100):
        arm.speed_linear(twist, 0.5, TICK_S, 1.0)
        arm.plan()
    frame = arm.arm.tcp(arm.q, arm.tool)
    reached = np.linalg.norm(twist[:3]) / 0.5
    expected = start.position + twist[:3] * (0.8 - reached / 2)
    assert np.abs(frame.position - expected).max() < 1e-9
    turned = np.array(rotvec_of(frame.rotation @ start.rotation.T))
    assert np.abs(turned - twist[3:] * (0.8 - np.linalg.norm(twist[3:]) / 2)).max() < 1e-9
    assert np.abs(np.array(arm.tcp_speed(arm.q, arm.qd)) - twist).max() < 1e-3


def test_speedl_rotates_the_tool_by_more_than_180_degrees():
    arm = motion()
    axis = arm.arm.tcp(arm.q, arm.tool).rotation[:, 2]
    arm.speed_linear([0.0, 0.0, 0.0, *axis], 5.0, 10.0)
    path = run(arm, 530)
    assert arm.q[5] - Q0[5] == pytest.approx(530 * TICK_S - 0.1, abs=1e-6)
    assert np.abs(np.diff(path, axis=0)).max() < 1.01 * DT
    assert np.abs(arm.q - Q0)[:5].max() < 1e-6


def test_speedl_into_a_singularity_is_a_fault():
    arm = motion()
    speeds = until_fault(arm, "C154A0", lambda _: arm.speed_linear([0.0, 0.0, 0.3, 0.0, 0.0, 0.0], 1.0, TICK_S))
    assert (np.abs(speeds) <= JOINT_SPEED_RAD_S * (1 + 2e-6)).all()
    at_rest(arm)


def test_stopj_keeps_the_direction_of_the_joints():
    arm = motion()
    arm.speed_joints([0.5, -0.4, 0.3, 0.2, -0.1, 0.6], 5.0, 1.0)
    run(arm, 50)
    start, speed = arm.q.copy(), arm.qd.copy()
    path, ticks = until_done(arm, arm.stop_joints(2.0))
    assert ticks == math.ceil(0.6 / 2.0 / TICK_S - 1e-6)
    assert np.abs(path[-1] - start - speed * 0.15).max() < 1e-9
    assert np.abs(np.cross((path - start)[:, :3], speed[:3])).max() < 1e-12
    assert not arm.moving


@pytest.mark.parametrize("before", ["movel", "speedl", "movej"])
def test_stopl_keeps_the_direction_of_the_tcp(before):
    arm = motion()
    if before == "movel":
        arm.move_linear(pose(arm, 0.1, 0.1, -0.2), 1.0, 0.3)
    elif before == "speedl":
        arm.speed_linear([0.1, 0.1, -0.2, 0.0, 0.0, 0.0], 1.0, 1.0)
    else:
        arm.move_joints(Q0 + np.array([0.3, 0.2, -0.3, 0.1, 0.2, 0.3]), 1.0, 0.5)
    run(arm, 50)
    speed = np.array(arm.tcp_speed(arm.q, arm.qd))
    start = positions(arm.q)
    path, _ = until_done(arm, arm.stop_linear(0.8))
    at = positions(path)
    tolerance = 1e-6 if before != "movej" else 1e-3  # its direction changed during the last step
    out = (at - start) @ speed[:3] / (speed[:3] @ speed[:3])
    assert np.abs(at - start - np.outer(out, speed[:3])).max() < tolerance
    assert (np.diff(out) >= -1e-12).all()
    assert (
        np.linalg.norm(at[-1] - start) <= np.linalg.norm(speed[:3]) ** 2 / (2 * 0.8) * 1.02 + 1e-9 or before == "movej"
    )
    assert not arm.moving


def test_the_arm_stops_at_the_end_of_a_program():
    arm = motion()
    handle = arm.move_joints(Q0 + 1.0, 2.0, 1.0)
    run(arm, 80)
    speed = np.abs(arm.qd).max()
    arm.halt()
    assert handle.aborted
    assert arm.moving
    path = at_rest(arm)
    assert (len(path) - 1) / SUBSTEPS == math.ceil(speed / 8.0 / TICK_S)
    assert np.abs(np.diff(path, 2, axis=0)).max() / DT**2 <= 8.0 * (1 + 1e-6)


def test_brakes_hold_the_arm_in_place():
    arm = motion()
    handle = arm.move_joints(Q0 + 1.0, 2.0, 1.0)
    run(arm, 30)
    q = arm.q.copy()
    arm.hold()
    assert handle.aborted
    assert not arm.moving
    assert not arm.plan()[:, 1:].any()
    assert np.array_equal(arm.q, q)


@settings(max_examples=scaled(300))
@given(
    speed=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    a=st.floats(0.5, 40.0),
    stop=st.floats(0.5, 40.0),
    ticks=st.integers(1, 40),
)
def test_stopj_never_speeds_up(speed, a, stop, ticks):
    arm = motion(np.zeros(6))
    arm.speed_joints(speed, a, 10.0)
    run(arm, ticks)
    before = np.abs(arm._rate)
    path, _ = until_done(arm, arm.stop_joints(stop))
    if arm.fault is None:
        assert (np.abs(np.diff(path, axis=0)) / DT <= before + 1e-9).all()
        assert np.abs(np.diff(path, 2, axis=0)).max(initial=0.0) / DT**2 <= stop * (1 + 1e-6) + 1e-9
