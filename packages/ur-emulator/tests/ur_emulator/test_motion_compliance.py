"""Force mode and freedrive."""

from __future__ import annotations

import numpy as np
import pytest

from tests.ur_emulator.motion_runs import DT, Q0, TICK_S, at_rest, motion, pose, positions, run, until_done
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S

DOWN = ([0.0] * 6, [0, 0, 1, 0, 0, 0], [0.0, 0.0, -20.0, 0.0, 0.0, 0.0], 2, [0.05] * 6)


def _push(arm, ticks, wrench):
    for _ in range(ticks):
        arm.plan(wrench=wrench(arm) if callable(wrench) else wrench)


def test_force_mode_moves_in_the_selected_axis_only():
    arm = motion()
    start = arm.arm.tcp(arm.q, arm.tool)
    arm.force_mode(*DOWN)
    _push(arm, 200, [30.0, 20.0, 0.0, 1.0, 2.0, 3.0])
    end = arm.arm.tcp(arm.q, arm.tool)
    assert end.position[2] - start.position[2] < -0.02
    assert np.abs(end.position - start.position)[:2].max() < 1e-3
    assert np.abs(end.rotation - start.rotation).max() < 5e-3


def test_force_mode_keeps_its_speed_limit():
    arm = motion()
    arm.force_mode(DOWN[0], DOWN[1], [0.0, 0.0, -500.0, 0.0, 0.0, 0.0], 2, [0.05] * 6)
    fastest = 0.0
    for _ in range(150):
        arm.plan()
        fastest = max(fastest, np.linalg.norm(arm.tcp_speed(arm.q, arm.qd)[:3]))
    assert 0.04 < fastest < 0.0505


@pytest.mark.parametrize("stiffness", [500.0, 20_000.0])
def test_force_mode_reaches_its_force_on_a_spring(stiffness):
    arm = motion()
    floor = positions(arm.q)[2] - 0.005

    def wrench(arm):
        return [0.0, 0.0, stiffness * max(0.0, floor - positions(arm.q)[2]), 0.0, 0.0, 0.0]

    arm.force_mode(*DOWN)
    _push(arm, 1500, wrench)
    assert wrench(arm)[2] == pytest.approx(20.0, rel=0.02)
    assert np.abs(arm.qd).max() < 1e-3


def test_force_mode_continues_during_a_move():
    arm = motion()
    start = positions(arm.q)
    goal = pose(arm, 0.0, 0.1)
    arm.force_mode(*DOWN)
    until_done(arm, arm.move_linear(goal, 1.0, 0.1))
    off = positions(arm.q) - start
    assert off[1] == pytest.approx(0.1, abs=3e-3)
    assert off[2] < -0.02


@pytest.mark.parametrize("kind", ["move", "servo"])
def test_a_motion_continues_smoothly_after_force_mode(kind):
    arm = motion()
    if kind == "move":
        arm.move_linear(pose(arm, 0.0, 0.2), 1.0, 0.1)
    arm.force_mode(*DOWN)
    paths = []
    for ticks in (60, 60, 60):
        for _ in range(ticks):
            if kind == "servo":
                arm.servo_joints(Q0, TICK_S, 0.1, 300)
            paths.append(run(arm, 1)[1:])
        arm.end_force_mode()
    rate = np.diff(np.concatenate(paths), axis=0) / DT
    assert np.abs(np.diff(rate, axis=0)).max() / DT < 20.0
    if kind == "servo":
        assert np.abs(arm.q - Q0).max() < 1e-3


def test_the_arm_stops_at_the_end_of_force_mode():
    arm = motion()
    arm.force_mode(*DOWN)
    run(arm, 100)
    speed = np.abs(arm.qd).max()
    assert speed > 0.01
    arm.end_force_mode()
    path = at_rest(arm, 200)
    assert np.abs(np.diff(path, 2, axis=0)).max() / DT**2 <= 8.0 * (1 + 1e-6)
    q = arm.q.copy()
    until_done(arm, arm.move_joints(q + 0.05, 1.0, 1.0))
    assert np.allclose(arm.q, q + 0.05)


def test_a_higher_gain_is_faster_and_damping_slower():
    ways = []
    for settings in ({}, {"gain_scaling": 2.0}, {"damping": 1.0}, {"gain_scaling": 0.0}):
        arm = motion()
        arm.force_mode_settings(**settings)
        arm.force_mode(*DOWN)
        run(arm, 50)
        ways.append(np.linalg.norm(positions(arm.q) - positions(Q0)))
    assert ways[1] > 1.5 * ways[0] > 3 * ways[2]
    assert ways[3] < 1e-4


def test_type_1_rotates_the_frame_towards_its_origin():
    arm = motion()
    start = positions(arm.q)
    origin = start + np.array([0.0, 0.3, 0.4])
    arm.force_mode([*origin, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 20.0, 0, 0, 0, 0], 1, [0.05] * 6)
    run(arm, 100)
    displacement = positions(arm.q) - start
    assert np.linalg.norm(displacement) > 0.01
    assert displacement @ [0.0, 0.6, 0.8] == pytest.approx(np.linalg.norm(displacement), rel=1e-3)


def test_type_3_follows_the_speed_of_the_tcp():
    arm = motion()
    start = positions(arm.q)
    arm.speed_linear([0.0, 0.05, 0.0, 0, 0, 0], 1.0, 10.0)
    run(arm, 20)
    arm.force_mode([0.0] * 6, [1, 0, 0, 0, 0, 0], [20.0, 0, 0, 0, 0, 0], 3, [0.05] * 6)
    run(arm, 100)
    displacement = positions(arm.q) - start
    assert displacement[1] > 0.05 * 120 * TICK_S + 0.01
    assert np.abs(displacement[[0, 2]]).max() < 2e-3


def test_freedrive_follows_a_force_and_stands_without_one():
    arm = motion()
    arm.freedrive()
    assert arm.free
    run(arm, 50)
    assert np.array_equal(arm.q, Q0)
    _push(arm, 100, [0.0, 20.0, 0.0, 0.0, 0.0, 0.0])
    moved = positions(arm.q) - positions(Q0)
    assert moved[1] > 0.05
    assert (np.abs(arm.qd) < JOINT_SPEED_RAD_S).all()
    _push(arm, 100, [1.0, -1.0, 1.0, 0.1, 0.1, 0.1])  # noise of the measured force
    assert not arm.moving or np.abs(arm.qd).max() < 1e-4
    arm.end_freedrive()
    assert not arm.free
    at_rest(arm, 200)


def test_free_drive_only_in_free_axes():
    arm = motion()
    arm.freedrive([1, 0, 1, 1, 1, 1])
    _push(arm, 100, [15.0, 15.0, 0.0, 0.0, 0.0, 0.0])
    moved = positions(arm.q) - positions(Q0)
    assert moved[0] > 0.02
    assert abs(moved[1]) < 2e-3


def test_free_drive_ends_with_a_command_and_ends_a_motion():
    arm = motion()
    handle = arm.move_joints(Q0 + 1.0, 1.0, 1.0)
    run(arm, 50)
    arm.freedrive()
    assert handle.aborted
    run(arm, 100)
    assert np.abs(arm.qd).max() < 1e-9
    until_done(arm, arm.move_joints(Q0, 1.0, 1.0))
    assert not arm.free
    assert np.array_equal(arm.q, Q0)


def test_nobody_pushes_a_joint_through_its_limit():
    q = Q0.copy()
    q[2] = JOINT_RANGE_RAD[2] - 0.1
    arm = motion(q)
    arm.freedrive()
    towards = 60.0 * arm.arm.jacobian(arm.q, arm.tool)[:3, 2]
    _push(arm, 500, [*towards, 0.0, 0.0, 0.0])
    assert arm.q[2] > q[2]
    assert (np.abs(arm.q) <= JOINT_RANGE_RAD).all()


def test_the_tcp_does_not_yield_at_scaling_zero():
    arm = motion()
    arm.force_mode(*DOWN)
    for _ in range(20):
        assert not arm.plan(0.0)[:, 1:].any()
    assert np.array_equal(arm.q, Q0)
