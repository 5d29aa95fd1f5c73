"""Poses in UR's notation, and the arm's kinematics with a tool."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.motion_runs import Q0, motion
from ur_core.kinematics import flange_pose
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_emulator.motion.tool_kinematics import frame_of, pose_of, rotation_of, rotvec_of

ROTVEC = st.tuples(*(st.floats(-1, 1),) * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
TCP = [0.01, -0.02, 0.15, 0.3, -0.4, 0.5]


@settings(max_examples=scaled(2000, 40))
@given(axis=ROTVEC, angle=st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, 1e-5, np.pi - 1e-9, np.pi])))
def test_rotation_vectors_there_and_back(axis, angle):
    rotvec = angle * np.array(axis) / np.linalg.norm(axis)
    rotation = rotation_of(rotvec)
    assert np.abs(rotation - quat_to_matrix(quat_from_rotvec(rotvec))).max() < 1e-14
    back = np.array(rotvec_of(rotation))
    assert np.linalg.norm(back) <= np.pi + 1e-12
    assert np.abs(rotation_of(back) - rotation).max() < 1e-14
    if angle < 3.0:
        assert np.abs(back - rotvec).max() < 1e-14 + 1e-13 * angle


def test_rotation_vectors_at_zero():
    assert np.array_equal(rotation_of([0.0] * 3), np.eye(3))
    assert rotvec_of(np.eye(3)) == (0.0, 0.0, 0.0)


def test_forward_and_inverse_with_a_tool():
    arm = motion()
    position, rotation = flange_pose(Q0, NOMINAL_DH)
    tool = frame_of(TCP)
    expected = (position + rotation @ tool.position, rotation @ tool.rotation)
    pose = arm.forward(Q0, TCP)
    assert np.allclose(frame_of(pose).position, expected[0], atol=1e-14)
    assert np.allclose(frame_of(pose).rotation, expected[1], atol=1e-14)
    assert not np.allclose(pose, arm.tcp_pose(Q0), atol=1e-3)
    q = arm.inverse(pose, Q0 + 0.05, TCP)
    assert q is not None
    assert np.abs(q - Q0).max() < 1e-9
    arm.set_tcp(TCP)
    assert arm.tcp == tuple(TCP)
    assert arm.tcp_pose(Q0) == pose == arm.forward(Q0)
    assert np.abs(arm.inverse(pose, Q0 + 0.05) - Q0).max() < 1e-9
    assert np.allclose(frame_of(arm.flange_pose(Q0)).position, position)
    assert arm.inverse([3.0, 0, 0, 0, 0, 0], Q0) is None
    assert arm.inverse([60.0, 0, 0, 0, 0, 0], Q0) is None


def test_tcp_speed_is_the_derivative_of_the_pose():
    arm = motion()
    arm.set_tcp(TCP)
    qd = np.array([0.3, -0.2, 0.5, 0.1, -0.7, 0.4])
    h = 1e-5
    before, after = (frame_of(arm.tcp_pose(Q0 + s * h * qd)) for s in (-1, 1))
    speed = [
        *((after.position - before.position) / (2 * h)),
        *(np.array(rotvec_of(after.rotation @ before.rotation.T)) / (2 * h)),
    ]
    assert np.abs(np.array(arm.tcp_speed(Q0, qd)) - speed).max() < 1e-8
    assert arm.tcp_speed(Q0, np.zeros(6)) == (0.0,) * 6


def test_poses_are_plain_floats():
    arm = motion()
    for numbers in (arm.tcp_pose(Q0), arm.tcp_speed(Q0, Q0), arm.flange_pose(Q0), pose_of(frame_of(TCP))):
        assert all(type(each) is float for each in numbers)
        assert len(numbers) == 6
