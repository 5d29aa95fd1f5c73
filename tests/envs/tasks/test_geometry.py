"""Measured grasps against compositions of poses."""

import numpy as np

from dual_ur10 import ArmMount
from dual_ur10.assets.robotiq_2f85 import ROBOTIQ_2F85 as TOOL
from dual_ur10.envs.tasks.geometry import Grasps, frame_of
from dual_ur10.kinematics.frames import Frames
from dual_ur10.kinematics.poses import Poses, compose, relative_to
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from dual_ur10.sim2real.config.cell import CellState

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
        back = np.array([0.0, 0.0, TOOL.tcp_m]) + rng.uniform(-0.07, 0.07, (N, 2, 3))
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
    tool = compose(flange, Poses(np.array([0.0, 0.0, TOOL.tcp_m]), np.eye(4)[0]))
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
