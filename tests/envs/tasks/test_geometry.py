"""Grasps, steps and distances against compositions of poses."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10 import ArmMount
from dual_ur10.envs.tasks.geometry import TOOL, FrameDistances, Goal, GoalSteps, frame_of, toward
from dual_ur10.envs.tasks.grasps import Grasps
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell.cell import CellState
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, relative_to, rotation_angle, yaw_of, yaw_quat
from ur_core.kinematics.rotations import quat_between, quat_from_rotvec, quat_multiply, quat_to_matrix
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85

N, WIDTH_M = 40, 0.05
FRAMES = Frames((ArmMount((-0.7, 0.6, 0.1), 0.2), ArmMount((-0.8, -0.5, 0.0), -0.3)))


def measured(grip_m, rng, near=False):
    """Return state, poses and what is measured, for random flanges and three random poses."""
    quat = quat_from_rotvec(rng.normal(size=(N, 2, 3)))
    object_quat = quat_from_rotvec(rng.normal(size=(N, 3, 3)))
    poses = np.concatenate([rng.normal(size=(N, 3, 3)), object_quat], axis=2)
    flange_m = rng.normal(size=(N, 2, 3))
    if near:  # each tool within a few centimetres of its grip
        grips = compose(Poses(poses[:, :1, :3], poses[:, :1, 3:]), Poses(grip_m, np.eye(4)[[0]])).position_m
        back = np.array([0.0, 0.0, ROBOTIQ_2F85.tcp_m]) + rng.uniform(-0.07, 0.07, (N, 2, 3))
        flange_m = grips - (quat_to_matrix(quat) @ back[..., None])[..., 0]
    width_m = WIDTH_M + rng.choice([-0.01, 0.0], (N, 2))
    zeros = np.zeros((N, 2, 6))
    state = CellState(
        np.zeros(N), zeros, zeros, zeros[..., :3], quat, flange_m, np.zeros(N, dtype=bool), quat, width_m, zeros
    )
    return state, poses, Grasps(FRAMES, grip_m, WIDTH_M, 3)(Poses(flange_m, quat), width_m, poses)


def test_poses_follow_from_compositions():
    rng = np.random.default_rng(0)
    grip_m = rng.normal(size=(N, 2, 3))
    state, poses, found = measured(grip_m, rng)
    flange = Poses(state.flange_m, state.flange_quat)
    other = relative_to(flange, Poses(flange.position_m[:, ::-1], flange.quat[:, ::-1]))
    assert np.allclose(found.other_flange, np.concatenate(other, axis=2), atol=1e-13)
    tool = compose(flange, Poses(np.array([0.0, 0.0, ROBOTIQ_2F85.tcp_m]), np.eye(4)[0]))
    grip = compose(Poses(poses[:, :1, :3], poses[:, :1, 3:]), Poses(grip_m, np.eye(4)[0]))
    assert np.allclose(found.grip_in_tool_m, relative_to(tool, grip).position_m, atol=1e-13)
    assert np.allclose(found.frames, frame_of(Poses(poses[..., :3], poses[..., 3:])), atol=1e-13)
    assert np.allclose(found.tools, frame_of(tool), atol=1e-13)
    in_bases = found.in_bases
    for k in range(3):
        both = np.repeat(poses[:, k, None], 2, axis=1)
        assert np.allclose(in_bases[:, :, k, :3], FRAMES.position_to_base(both[..., :3]), atol=1e-13)
        assert np.allclose(in_bases[:, :, k, 3:], FRAMES.quat_to_base(both[..., 3:]), atol=1e-13)


def test_a_gripper_holds_what_is_between_its_fingers_at_its_width():
    rng = np.random.default_rng(1)
    state, _, found = measured(rng.normal(size=(N, 2, 3)), rng, near=True)
    between = (np.abs(found.grip_in_tool_m) < [0.06, 0.085 / 4, 0.038 * 0.75]).all(axis=2)
    assert 0.02 < between.mean() < 0.5
    assert np.array_equal(found.between, between)
    assert np.array_equal(found.holding, between & (np.abs(state.gripper_m - WIDTH_M) < 0.001))
    assert found.holding.any()
    assert (found.between & ~found.holding).any()


def random_frames(rng, count):
    quat = quat_from_rotvec(rng.normal(size=(N, count, 3)))
    return Poses(rng.normal(size=(N, count, 3)), quat)


@given(st.integers(0, 2**32 - 1))
def test_steps_lead_to_goals_in_any_frame(seed):
    rng = np.random.default_rng(seed)
    tools, frames = random_frames(rng, 2), random_frames(rng, 3)
    pose = Poses(rng.normal(size=3), quat_from_rotvec(rng.normal(size=3)))
    goals = [Goal(number, pose) for number in (0, 2, 3)] + [Goal(TOOL), Goal(1, pose, further_m=0.2)]
    number, rise_m = rng.integers(0, 5, (2, N)), rng.uniform(-0.1, 0.1, (2, N))
    found = GoalSteps(N, 3, goals)(frame_of(tools), frame_of(frames), number, rise_m)
    for row in range(N):
        for arm in (0, 1):
            tool = Poses(tools.position_m[row, arm], tools.quat[row, arm])
            goal = goals[number[arm, row]]
            at = Poses(np.zeros(3), np.eye(4)[0])
            if goal.frame < 3:
                at = tool if goal.frame == TOOL else Poses(*(part[row, goal.frame] for part in frames))
            there = compose(at, goal.pose)
            move = there.position_m - tool.position_m + [0.0, 0.0, rise_m[arm, row]]
            chord = 2.0 * np.sin(rotation_angle(quat_between(tool.quat, there.quat)) / 2)
            assert found.move_m[row, arm] == pytest.approx(move, abs=1e-12)
            assert found.left_m[row, arm] == pytest.approx(np.linalg.norm(move) + goal.further_m)
            assert found.chord[row, arm] == pytest.approx(chord, abs=1e-5)  # rounding hides half turns
            turned = np.concatenate([[np.sqrt(max(1.0 - chord**2 / 4, 0.0))], found.turn[row, arm] / 2])
            assert abs(quat_multiply(turned, tool.quat) @ there.quat) == pytest.approx(1.0, abs=1e-4)
    assert (found.away == np.maximum(found.left_m / 0.01, found.chord / 0.08)).all()
    d, c = found.left_m, found.chord
    shape = 0.03 / (0.03 + d) + 0.3 / (0.3 + d) + 0.2 / (0.2 + c) + 1.0 / (1.0 + c)
    assert found.nearness == pytest.approx(0.25 * (2.0 - np.minimum(d, 1.0) - c / 2 + shape / 2))


def test_tools_at_joint_positions_are_those_of_the_kinematics():
    rng = np.random.default_rng(3)
    mounts = (ArmMount((-0.7, 0.6, 0.1), 0.2), ArmMount((-0.8, -0.5, 0.0), -0.3))
    q_rad = rng.uniform(-2.0, 2.0, (N, 2, 6))
    tcp_m = np.array([0.15, 0.22])
    steps = GoalSteps(N, 2, (Goal(0), Goal(1)), mounts, tcp_m=tcp_m)
    there = frame_of(random_frames(rng, 2))
    steps(q_rad, there)
    flanges = [flange_pose_quat(q_rad[:, arm], mount.dh) for arm, mount in enumerate(mounts)]
    quat = FRAMES.quat_to_cell(np.stack([each[1] for each in flanges], axis=1))
    flange_m = FRAMES.position_to_cell(np.stack([each[0] for each in flanges], axis=1))
    lever_m = np.array([0.0, 0.0, 1.0]) * tcp_m[:, None]
    tool = compose(Poses(flange_m, quat), Poses(lever_m, np.eye(4)[0]))
    assert np.allclose(steps.tools, frame_of(tool), atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_distances_of_frames_follow_from_their_poses(seed):
    rng = np.random.default_rng(seed)
    one, other = random_frames(rng, 2), random_frames(rng, 3)
    distances, of = FrameDistances(N, 2, (1, 0, 1)), [1, 0, 1]
    distances.others[...] = frame_of(other)
    moved_m, chord, axis_rad = distances(frame_of(one))
    assert moved_m == pytest.approx(np.linalg.norm(one.position_m[:, of] - other.position_m, axis=2))
    angle = rotation_angle(quat_between(one.quat[:, of], other.quat))
    assert chord == pytest.approx(2.0 * np.sin(angle / 2), abs=1e-5)  # rounding hides half turns
    x = [quat_to_matrix(quat)[..., 0] for quat in (one.quat[:, of], other.quat)]
    assert np.cos(axis_rad) == pytest.approx((x[0] * x[1]).sum(axis=2))


def test_each_gripper_has_a_width_and_fingers_of_its_own():
    rng = np.random.default_rng(5)
    grip_m, poses = np.zeros((N, 2, 3)), np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (N, 2, 1))
    wide = dataclasses.replace(ROBOTIQ_2F85, tcp_m=0.3, stroke_m=0.2, pad_m=(0.022, 0.007, 0.1))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (N, 2, 1))
    flange_m = -np.array([[0.0, 0.0, ROBOTIQ_2F85.tcp_m], [0.0, 0.0, 0.3]]) + rng.uniform(-0.05, 0.05, (N, 2, 3))
    opening_m = np.array([WIDTH_M, 0.1]) + rng.choice([-0.01, 0.0, 0.004, 0.03], (N, 2))
    found = Grasps(FRAMES, grip_m, (WIDTH_M, 0.1), 2, (0, 1), (ROBOTIQ_2F85, wide))(
        Poses(flange_m, quat), opening_m, poses
    )
    most = np.array([[0.06, 0.085 / 4, 0.038 * 0.75], [0.06, 0.05, 0.075]])
    assert np.array_equal(found.between, (np.abs(found.grip_in_tool_m) < most).all(axis=2))
    assert found.between[:, 1].sum() > found.between[:, 0].sum() > 0
    wider = opening_m - [WIDTH_M, 0.1]
    assert found.opened == pytest.approx(np.clip(wider / [0.085 - WIDTH_M, 0.1], 0.0, 1.0))
    assert found.closed == pytest.approx(np.maximum(1.0 - np.abs(wider) / [0.085 - WIDTH_M, 0.1], 0.0))
    assert found.cleared == pytest.approx(np.clip(wider / 0.007, 0.0, 1.0))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Grasps(FRAMES, np.zeros((N, 2, 3)), WIDTH_M, 2, (0, 2)), r"held is \[0, 2\]: allowed are 0 to 1"),
        (
            lambda: Grasps(FRAMES, np.zeros((N, 2, 3)), (WIDTH_M, 0.08), 2),
            r"the right tool 'robotiq_2f85' opens by 0.085 m: .* an object of 0.08 m it needs 0.087 m or more",
        ),
        (lambda: GoalSteps(N, 2, [Goal(3)]), r"frame of a goal is \[3\]: allowed are -1 to 2"),
        (lambda: GoalSteps(N, 2, [Goal(-2)]), "frame of a goal"),
        (lambda: FrameDistances(N, 2, [0, 2]), r"of is \[0, 2\]"),
        (lambda: GoalSteps(1, 1, [Goal(0)])(np.zeros((1, 2, 12)), np.zeros((1, 1, 12)), (0, 1)), r"goal is \[0, 1\]"),
    ],
)
def test_indices_beyond_the_arrays_are_refused(make, text):
    with pytest.raises(SettingsError, match=text):
        make()


VECTOR = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@given(VECTOR, VECTOR, VECTOR, VECTOR, st.floats(0.001, 4.0), st.floats(0.001, 4.0))
def test_steps_towards_poses_are_bounded_and_arrive(begin_m, turn, end_m, end_turn, most_m, most_rad):
    begin, end = (
        Poses(at_m[None], quat_from_rotvec(each[None])) for at_m, each in ((begin_m, turn), (end_m, end_turn))
    )
    step = toward(begin, end, most_m, most_rad)
    whole_m = np.linalg.norm(end_m - begin_m)
    whole_rad = rotation_angle(quat_between(begin.quat, end.quat))[0]
    assert np.linalg.norm(step.position_m - begin.position_m) == pytest.approx(min(most_m, whole_m), abs=1e-9)
    assert rotation_angle(quat_between(begin.quat, step.quat))[0] == pytest.approx(min(most_rad, whole_rad), abs=1e-6)
    left_rad = rotation_angle(quat_between(step.quat, end.quat))[0]
    assert left_rad == pytest.approx(max(whole_rad - most_rad, 0.0), abs=1e-6)
    assert np.linalg.norm(end_m - step.position_m[0]) == pytest.approx(max(whole_m - most_m, 0.0), abs=1e-9)


@given(st.floats(-3.1, 3.1), st.floats(-0.5, 0.5))
def test_the_yaw_of_a_tilted_pose_is_that_before_its_tilt(yaw_rad, tilt_rad):
    tilted = quat_multiply(yaw_quat(np.array(yaw_rad)), quat_from_rotvec(np.array([tilt_rad, 0.0, 0.0])))
    assert rotation_angle(quat_between(yaw_of(tilted), yaw_quat(np.array(yaw_rad)))) == pytest.approx(0.0, abs=1e-7)
