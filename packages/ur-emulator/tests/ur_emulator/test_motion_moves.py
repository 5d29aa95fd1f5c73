"""movej, movel, movep and movec: targets, durations and blends."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

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
)
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, NOMINAL_DH
from ur_emulator.motion.tool_kinematics import rotvec_of
from ur_emulator.motion.trajectories import ACCELERATION_LIMIT_RAD_S2

JOINTS = st.tuples(*(st.floats(-0.95 * r, 0.95 * r) for r in JOINT_RANGE_RAD)).map(np.array)


@settings(max_examples=scaled(1000, 50))
@given(q=JOINTS, a=st.floats(1.0, 60.0), v=st.floats(0.5, 10.0))
def test_movej_ends_at_its_target_in_time_and_keeps_the_limits(q, a, v):
    arm = motion()
    path, ticks = until_done(arm, arm.move_joints(q, a, v))
    assert np.array_equal(arm.q, q)
    assert not arm.moving
    displacement = np.abs(q - Q0)
    a, lead = min(a, 40.0), displacement.max()
    v = min(v, lead / (displacement / JOINT_SPEED_RAD_S).max())
    duration = lead / v + v / a if v * v < a * lead else 2 * math.sqrt(lead / a)
    assert ticks == math.ceil(duration / TICK_S - 1e-6)
    speed = np.diff(path, axis=0) / DT
    assert (np.abs(speed) <= JOINT_SPEED_RAD_S * (1 + 1e-6)).all()
    assert (np.abs(speed).max() <= v * (1 + 1e-6)) or lead < 1e-9
    assert np.abs(np.diff(speed, axis=0)).max() <= a * DT * (1 + 1e-6)
    # All joints move together, along a line.
    fraction = (path - Q0) @ (q - Q0) / ((q - Q0) @ (q - Q0))
    assert np.abs(path - Q0 - np.outer(fraction, q - Q0)).max() < 1e-9


@pytest.mark.parametrize("seconds", [0.4, 0.5, 1.0, 2.345])
def test_t_is_the_time_of_a_move(seconds):
    target = Q0 + np.array([0.3, -0.2, 0.1, 0.0, 0.5, 0.4])
    arm = motion()
    path, ticks = until_done(arm, arm.move_joints(target, 0.01, 0.01, seconds))
    assert ticks == math.ceil(seconds / TICK_S - 1e-6)
    assert np.array_equal(arm.q, target)
    assert not np.array_equal(path[-2 - SUBSTEPS], target)
    arm = motion()
    goal = pose(arm, 0.05, -0.03, 0.04)
    _, ticks = until_done(arm, arm.move_linear(goal, 0.0, 0.0, seconds))
    assert ticks == math.ceil(seconds / TICK_S - 1e-6)
    assert np.allclose(arm.tcp_pose(arm.q), goal, atol=1e-9)


def check_limits(path):
    speed = np.diff(path, axis=0) / DT
    assert np.abs(speed).max() <= JOINT_SPEED_RAD_S[0] * (1 + 1e-6)
    assert np.abs(np.diff(speed, axis=0)).max() <= 40.0 * DT * (1 + 1e-6)


@pytest.mark.parametrize(("displacement", "seconds"), [(2.0, 1.2), (0.14, 0.12)])
def test_t_is_kept_where_only_other_ramps_allow_it(displacement, seconds):
    arm = motion()
    path, ticks = until_done(arm, arm.move_joints(Q0 + np.array([displacement, 0, 0, 0, 0, 0]), 1.0, 1.0, seconds))
    assert ticks == round(seconds / TICK_S)
    check_limits(path)


def test_a_time_that_is_too_short_is_not_kept():
    arm = motion()
    path, ticks = until_done(arm, arm.move_joints(Q0 + np.array([2.0, 0, 0, 0, 0, 0]), 1.0, 1.0, 0.2))
    assert ticks * TICK_S > 2.0 / JOINT_SPEED_RAD_S[0]
    check_limits(path)


def test_movel_is_straight_and_rotates_evenly():
    arm = motion()
    arm.set_tcp([0.02, -0.01, 0.15, 0.3, -0.2, 0.1])
    start = np.array(arm.tcp_pose(arm.q)[:3])
    rotation = arm.arm.tcp(arm.q, arm.tool).rotation
    goal = pose(arm, 0.15, 0.2, -0.25, 0.4, 0.2, -0.3)
    path, _ = until_done(arm, arm.move_linear(goal, 1.2, 0.5))
    poses = [arm.arm.tcp(q, arm.tool) for q in path]
    at = np.array([each.position for each in poses])
    displacement = np.array(goal[:3]) - start
    fraction = (at - start) @ displacement / (displacement @ displacement)
    assert np.abs(at - start - np.outer(fraction, displacement)).max() < 1e-6
    assert np.abs(at[-1] - goal[:3]).max() < 1e-10
    whole = np.array(rotvec_of(poses[-1].rotation @ rotation.T))
    for each, part in zip(poses[::20], fraction[::20], strict=True):
        assert np.abs(np.array(rotvec_of(each.rotation @ rotation.T)) - part * whole).max() < 1e-6
    speed = np.linalg.norm(np.diff(at, axis=0), axis=1) / DT
    # Rotation takes longer here, and leads.
    assert speed.max() == pytest.approx(0.5 * np.linalg.norm(displacement) / np.linalg.norm(whole), rel=1e-3)


def test_movel_of_a_calibrated_arm():
    nominal = NOMINAL_DH
    dh = replace(
        nominal,
        a_m=tuple(np.add(nominal.a_m, [1e-4, 1e-3, -1e-3, 2e-5, 1e-5, 0])),
        alpha_rad=tuple(np.add(nominal.alpha_rad, [1e-3, -1e-3, 2e-3, 1e-3, -1e-3, 0])),
    )
    arm = motion(dh=dh)
    goal = pose(arm, 0.1, 0.05, -0.1)
    until_done(arm, arm.move_linear(goal, 1.2, 0.4))
    assert np.abs(flange_pose(arm.q, dh)[0] - goal[:3]).max() < 1e-9
    assert np.abs(flange_pose(arm.q, NOMINAL_DH)[0] - goal[:3]).max() > 1e-4


def test_movel_slows_down_where_a_joint_would_be_too_fast():
    arm = motion(np.array([0.0, -1.2, 1.6, -2.0, -0.03, 0.0]))  # near the wrist's singularity
    goal = pose(arm, 0.0, 0.3, 0.0)
    path, ticks = until_done(arm, arm.move_linear(goal, 3.0, 1.0))
    assert arm.fault is None
    assert np.allclose(arm.tcp_pose(arm.q)[:3], goal[:3], atol=1e-9)
    assert (np.abs(np.diff(path, axis=0)) <= JOINT_SPEED_RAD_S * DT * (1 + 2e-6)).all()
    assert ticks * TICK_S > 0.3 / 1.0 + 1.0 / 3.0 + 0.05
    at = positions(path)
    assert np.abs(at[:, (0, 2)] - at[0, (0, 2)]).max() < 1e-6


@pytest.mark.parametrize(("tick_s", "substeps"), [(TICK_S, SUBSTEPS), (0.002, 1)])
def test_near_singularities_no_joint_accelerates_more_than_programs_may(tick_s, substeps):
    rng = np.random.default_rng(5)
    faults = 0
    for _ in range(6):
        q = Q0 + rng.uniform(-0.5, 0.5, 6)
        q[4] = rng.uniform(-0.05, 0.05)  # the wrist's singularity
        arm = motion(q, tick_s, substeps)
        goal = np.array(arm.tcp_pose(q)) + rng.uniform(-0.2, 0.2, 6)
        path, _ = until_done(arm, arm.move_linear(goal, 4.0, 1.2))
        rest = at_rest(arm) if arm.moving else path[-1:]
        accelerations = np.diff(np.vstack([q, path, rest[1:]]), 2, axis=0) / (tick_s / substeps) ** 2
        assert np.abs(accelerations).max() <= 1.1 * ACCELERATION_LIMIT_RAD_S2
        assert arm.fault is None or arm.fault.code == "C154A0"
        faults += arm.fault is not None
    assert faults < 3


def _strong(arm, kind):
    """Move as strongly as programs may."""
    if kind == "movel":
        return until_done(arm, arm.move_linear(pose(arm, 0.1, 0.2, -0.1), 40.0, 3.0))[0]
    first, _ = until_done(arm, arm.speed_linear([0.1, 0.4, -0.1, 0.0, 0.5, 0.0], 40.0, 0.15))
    stop = arm.stop_linear(40.0) if kind == "stopl" else arm.speed_linear([0.0] * 6, 40.0)
    return np.vstack([first, until_done(arm, stop)[0][1:]])


@pytest.mark.parametrize("kind", ["movel", "stopl", "speedl"])
def test_the_strongest_motions_of_the_tcp_are_within_the_joints_accelerations(kind):
    arm = motion()
    path = _strong(arm, kind)
    assert arm.fault is None
    assert np.abs(arm.qd).max() < 1e-6
    assert 15.0 < np.abs(np.diff(path, 2, axis=0)).max() / DT**2 <= ACCELERATION_LIMIT_RAD_S2


def test_movec_is_a_circle_through_its_points():
    arm = motion()
    start = np.array(arm.tcp_pose(arm.q))
    centre = start[:3] + np.array([0.0, 0.1, 0.0])
    via, to = start.copy(), start.copy()
    via[:3], to[:3] = centre + np.array([0.1, 0.0, 0.0]), centre + np.array([0.0, 0.1, 0.0])
    path, _ = until_done(arm, arm.move_circular(via, to, 1.0, 0.2))
    at = positions(path)
    assert np.abs(np.linalg.norm(at - centre, axis=1) - 0.1).max() < 1e-9
    assert np.linalg.norm(at - via[:3], axis=1).min() < 1e-3
    assert np.abs(at[-1] - to[:3]).max() < 1e-9
    assert np.abs(at[:, 2] - start[2]).max() < 1e-9


def test_movec_covers_most_of_a_circle():
    arm = motion()
    start = np.array(arm.tcp_pose(arm.q))
    centre = start[:3] + np.array([0.0, 0.08, 0.0])
    via, to = start.copy(), start.copy()
    via[:3], to[:3] = centre + np.array([0.0, 0.08, 0.0]), centre + np.array([-0.08, 0.0, 0.0])
    path, _ = until_done(arm, arm.move_circular(via, to, 1.0, 0.2))
    at = positions(path)
    assert np.abs(np.linalg.norm(at - centre, axis=1) - 0.08).max() < 1e-9
    assert np.linalg.norm(np.diff(at, axis=0), axis=1).sum() == pytest.approx(1.5 * math.pi * 0.08, rel=1e-4)
    assert np.linalg.norm(at - via[:3], axis=1).min() < 1e-3


def test_movec_on_a_line_is_a_line():
    arm = motion()
    path, _ = until_done(arm, arm.move_circular(pose(arm, 0.0, 0.05), pose(arm, 0.0, 0.1), 1.0, 0.2))
    at = positions(path)
    assert np.abs(at[:, (0, 2)] - at[0, (0, 2)]).max() < 1e-9


# Scaling.


@pytest.mark.parametrize("kind", ["joints", "linear"])
def test_half_the_speed_takes_twice_as_long_on_the_same_path(kind):
    ends = []
    for scaling in (1.0, 0.5):
        arm = motion()
        goal = pose(arm, 0.1, 0.1, -0.1)
        handle = arm.move_joints(Q0 + 0.4, 1.0, 0.5, 1.6) if kind == "joints" else arm.move_linear(goal, 1.0, 0.5, 1.6)
        ends.append(until_done(arm, handle, lambda _, s=scaling: s))
    (fast, once), (slow, twice) = ends
    assert (once, twice) == (200, 400)
    assert np.abs(slow[::2] - fast).max() < 1e-9


def test_a_pause_keeps_the_path():
    target = Q0 + np.array([0.5, 0.3, -0.2, 0.1, -0.4, 0.6])
    arm = motion()
    ramp = [*np.linspace(1, 0, 19), *[0.0] * 20, *np.linspace(0, 1, 19)]
    path, _ = until_done(arm, arm.move_joints(target, 1.4, 1.0), lambda k: ramp[k - 20] if 20 <= k < 78 else 1.0)
    fraction = (path - Q0) @ (target - Q0) / ((target - Q0) @ (target - Q0))
    assert np.abs(path - Q0 - np.outer(fraction, target - Q0)).max() < 1e-12
    assert (np.diff(fraction) >= -1e-15).all()
    assert (np.diff(fraction) == 0.0).sum() >= 20 * SUBSTEPS
    assert np.array_equal(arm.q, target)


def test_nothing_moves_at_scaling_zero():
    arm = motion()
    arm.move_joints(Q0 + 0.5, 1.4, 1.0)
    run(arm, 20)
    q = arm.q.copy()
    for _ in range(5):
        plan = arm.plan(0.0)
        assert np.array_equal(plan[:, 0], np.tile(q, (SUBSTEPS, 1)))
        assert not plan[:, 1].any()
    assert arm.moving
    assert not arm.qd.any()


# Blends.


def _distance_to_polyline(points, corners):
    best = np.full(len(points), np.inf)
    for a, b in pairwise(corners):
        fraction = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - a - np.outer(fraction, b - a), axis=1))
    return best


@settings(max_examples=scaled(400))
@given(r=st.floats(0.005, 0.05), v=st.floats(0.1, 0.4), corner=st.floats(0.3, 2.6), rotation=st.floats(-0.15, 0.15))
def test_linear_blends_stay_within_the_radius_and_do_not_stop(r, v, corner, rotation):
    arm = motion()
    start = np.array(arm.tcp_pose(arm.q))
    middle, end = start.copy(), start.copy()
    middle[:3] += [0.0, 0.15, 0.0]
    end[:3] = middle[:3] + 0.15 * np.array([0.0, -math.cos(corner), math.sin(corner)])
    end[3] += rotation
    first, _ = until_done(arm, arm.move_linear(middle, 1.2, v, 0.0, r))
    assert np.linalg.norm(positions(arm.q) - middle[:3]) <= r
    assert arm.moving
    second, _ = until_done(arm, arm.move_linear(end, 1.2, v))
    assert arm.fault is None
    assert np.allclose(arm.tcp_pose(arm.q), end, atol=1e-9)
    path = np.vstack([first, second[1:]])
    at = positions(path)
    off = _distance_to_polyline(at, [start[:3], middle[:3], end[:3]])
    away = np.linalg.norm(at - middle[:3], axis=1)
    assert off[away > r + 1e-9].max() < 1e-6
    assert off.max() <= r
    speed = np.linalg.norm(np.diff(at, axis=0), axis=1) / DT
    blended = speed[away[1:] < 0.8 * r]
    if corner > 1.2 and blended.size:  # nearly turning back is slow in the middle
        assert blended.min() > 0.4 * min(v, math.sqrt(2 * 1.2 * r))
    assert np.abs(np.diff(path, 2, axis=0)).max() / DT**2 < 40.0


def test_a_blend_begins_no_earlier_than_braking():
    arm = motion()
    goal = pose(arm, 0.0, 0.15)
    until_done(arm, arm.move_linear(goal, 1.2, 0.2, 0.0, 0.1))
    left = np.linalg.norm(positions(arm.q) - goal[:3])
    braking = 0.2**2 / (2 * 1.2)
    assert braking - 0.2 * TICK_S <= left <= braking


@pytest.mark.parametrize(
    "command",
    [
        lambda arm: arm.speed_joints([0.3] * 6, 1.0),
        lambda arm: arm.servo_joints(Q0 + 0.01, 1.0, 0.1, 300.0),
        lambda arm: arm.stop_joints(0.5),
        lambda arm: arm.halt(),
    ],
)
def test_only_moves_have_a_waypoint(command):
    target = Q0 + 0.3
    arm = motion()
    assert np.array_equal(arm.waypoint, Q0)
    arm.move_joints(target, 1.4, 1.0)
    run(arm, 10)
    assert np.array_equal(arm.waypoint, target)
    command(arm)
    run(arm, 1)
    assert arm.moving
    assert np.array_equal(arm.waypoint, arm.q)


def test_a_blend_without_another_move_stops_at_the_waypoint():
    arm = motion()
    goal = pose(arm, 0.0, 0.15)
    until_done(arm, arm.move_linear(goal, 1.2, 0.25, 0.0, 0.02))
    assert np.linalg.norm(positions(arm.q) - goal[:3]) > 1e-3
    at_rest(arm)
    assert np.allclose(arm.tcp_pose(arm.q), goal, atol=1e-9)


@pytest.mark.parametrize("kinds", ["jj", "jl", "lj", "ll"])
def test_blends_of_all_kinds_of_moves_end_exactly(kinds):
    arm = motion()
    middle, end = Q0 + np.array([0.3, 0.1, -0.1, 0.05, 0.1, 0.2]), Q0 + np.array([0.5, -0.1, 0.2, 0.1, 0.0, -0.1])
    paths, slowest = [], math.inf
    for kind, q, r in zip(kinds, (middle, end), (0.05, 0.0), strict=True):
        if kind == "j":
            handle = arm.move_joints(q, 1.4, 1.0, 0.0, r)
        else:
            handle = arm.move_linear(arm.tcp_pose(q), 1.2, 0.4, 0.0, r)
        paths.append(until_done(arm, handle)[0])
        if r:
            at = positions(arm.q)
            assert 0.0 < np.linalg.norm(at - positions(middle)) <= 0.05
            slowest = np.abs(arm.qd).max()
    assert arm.fault is None
    assert slowest > 0.1
    assert np.abs(arm.q - end).max() < 1e-9
    path = np.vstack([paths[0], paths[1][1:]])
    near = np.linalg.norm(positions(path) - positions(middle), axis=1) < 0.04
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / DT
    assert speed[near[1:]].min() > 0.1
    assert np.abs(np.diff(path, 2, axis=0)).max() / DT**2 < 40.0


def test_a_path_of_many_blends_arrives():
    arm = motion()
    points = [pose(arm, 0.0, 0.02 * k, 0.01 * (k % 2)) for k in range(1, 12)]
    for k, point in enumerate(points):
        until_done(arm, arm.move_linear(point, 1.2, 0.25, 0.0, 0.015 if k + 1 < len(points) else 0.0))
    assert arm.fault is None
    assert np.allclose(arm.tcp_pose(arm.q), points[-1], atol=1e-9)


@pytest.mark.parametrize("to", ["joints", "linear"])
def test_a_move_from_motion_is_smooth(to):
    arm = motion()
    arm.speed_joints([0.6, -0.4, 0.5, 0.3, -0.6, 0.9], 2.0, 0.4)
    before = run(arm, 50)
    goal = Q0 + np.array([0.5, -0.3, 0.3, 0.0, -0.2, 0.3])
    handle = arm.move_joints(goal, 1.4, 1.0) if to == "joints" else arm.move_linear(arm.tcp_pose(goal), 1.2, 0.3)
    assert arm.moving
    after, _ = until_done(arm, handle)
    assert np.abs(arm.q - goal).max() < 1e-9
    speed = np.diff(np.vstack([before, after[1:]]), axis=0) / DT
    assert np.abs(np.diff(speed, axis=0)).max() / DT < 25.0
    assert np.abs(speed[len(before) - 2 : len(before) + 2]).max(axis=0).min() > 0.25  # it did not stop first


def test_interrupting_a_move_aborts_it():
    arm = motion()
    first = arm.move_joints(Q0 + 0.5, 1.0, 1.0)
    run(arm, 10)
    second = arm.move_joints(Q0, 1.0, 1.0)
    assert first.done
    assert first.aborted
    until_done(arm, second)
    assert not second.aborted
    assert np.array_equal(arm.q, Q0)
