"""Flange pose, Jacobian and frames against pinocchio and an independent product of DH matrices."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from tests.kinematics.reference_arm import calibration, independent_pose, random_q
from ur_core import kinematics
from ur_core.errors import SettingsError
from ur_core.kinematics.forward import elbow_flange_and_tcp
from ur_core.kinematics.ur10 import DH_D_M, NOMINAL_DH, DHParameters


@pytest.fixture(scope="module")
def urdf_style() -> tuple[pin.Model, int, int]:
    """Return the arm by the joint origins of ROS' description of the UR10, with frames base_link, base and tool0."""
    origins = [
        (0, 0, 0.1273, 0, 0, 0),
        (0, 0, 0, np.pi / 2, 0, 0),
        (-0.612, 0, 0, 0, 0, 0),
        (-0.5723, 0, 0.163941, 0, 0, 0),
        (0, -0.1157, 0, np.pi / 2, 0, 0),
        (0, 0.0922, 0, -np.pi / 2, 0, 0),
    ]
    model = pin.Model()
    half_rotation = pin.SE3(pin.utils.rotate("z", np.pi), np.zeros(3))
    joint, parent = 0, half_rotation  # base_link_inertia, rotated against base_link
    for number, (x, y, z, roll, _, _) in enumerate(origins):
        origin = pin.SE3(pin.utils.rotate("x", roll), np.array([x, y, z], dtype=float))
        joint = model.addJoint(joint, pin.JointModelRZ(), parent * origin, f"joint_{number}")
        parent = pin.SE3.Identity()
    base = model.addFrame(pin.Frame("base", 0, 0, half_rotation, pin.FrameType.OP_FRAME))
    tool = model.addFrame(pin.Frame("tool0", joint, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    return model, base, tool


def test_flange_pose_matches_the_dh_product() -> None:
    for dh in (NOMINAL_DH, calibration(1)):
        q = random_q(1000)
        position, rotation = kinematics.flange_pose(q, dh)
        expected = independent_pose(q, dh)
        assert np.abs(position - expected[0]).max() < 1e-12
        assert np.abs(rotation - expected[1]).max() < 1e-12


def test_flange_pose_matches_pinocchio_in_base_and_base_link(urdf_style: tuple[pin.Model, int, int]) -> None:
    model, base, tool = urdf_style
    data = model.createData()
    q = random_q(1000, 1)
    position, rotation = kinematics.flange_pose(q, NOMINAL_DH)
    position_link, rotation_link = kinematics.to_base_link(position, rotation)
    for row, angles in enumerate(q):
        pin.framesForwardKinematics(model, data, angles)
        in_link = data.oMf[tool]
        in_base = data.oMf[base].actInv(in_link)
        assert np.abs(in_base.translation - position[row]).max() < 1e-9
        assert np.abs(in_base.rotation - rotation[row]).max() < 1e-9
        assert np.abs(in_link.translation - position_link[row]).max() < 1e-9
        assert np.abs(in_link.rotation - rotation_link[row]).max() < 1e-9


def test_known_configuration() -> None:
    # Arm straight out along -x of base, tool along -y: signs of the table, derived by hand.
    position, rotation = kinematics.flange_pose(np.zeros(6), NOMINAL_DH)
    np.testing.assert_allclose(position, [-0.612 - 0.5723, -0.163941 - 0.0922, 0.1273 - 0.1157], atol=1e-15)
    np.testing.assert_allclose(rotation[:, 2], [0, -1, 0], atol=1e-15)


def test_quaternion_pose_is_the_same_pose() -> None:
    q = random_q(100, 2).reshape(4, 25, 6)
    position, rotation = kinematics.flange_pose(q, NOMINAL_DH)
    also, quat = kinematics.flange_pose_quat(q, NOMINAL_DH)
    np.testing.assert_array_equal(position, also)
    assert quat.shape == (4, 25, 4)
    expected = Rotation.from_matrix(rotation.reshape(-1, 3, 3))
    found = Rotation.from_quat(np.roll(quat, -1, -1).reshape(-1, 4))
    assert (expected * found.inv()).magnitude().max() < 1e-14
    in_link = Rotation.from_quat(np.roll(kinematics.quat_to_base_link(quat), -1, -1).reshape(-1, 4))
    link_rotation = kinematics.to_base_link(position, rotation)[1].reshape(-1, 3, 3)
    assert (Rotation.from_matrix(link_rotation) * in_link.inv()).magnitude().max() < 1e-14


def test_batch_shape_does_not_matter() -> None:
    q = random_q(30, 3)
    position, rotation = kinematics.flange_pose(q.reshape(2, 3, 5, 6), NOMINAL_DH)
    np.testing.assert_allclose(position[1, 2, 4], kinematics.flange_pose(q[29], NOMINAL_DH)[0], atol=1e-15)
    assert kinematics.jacobian(q.reshape(2, 3, 5, 6), NOMINAL_DH).shape == (2, 3, 5, 6, 6)
    found = kinematics.nearest(position, rotation, q.reshape(2, 3, 5, 6), NOMINAL_DH)
    np.testing.assert_allclose(found[1, 2, 4], q[29], atol=1e-9)
    assert kinematics.inverse(position, rotation, NOMINAL_DH)[0].shape == (2, 3, 5, 8, 6)


@pytest.mark.parametrize("dh", [NOMINAL_DH, calibration(2)], ids=["nominal", "calibrated"])
def test_jacobian_matches_differences(dh: DHParameters) -> None:
    q, step = random_q(50, 4), 1e-6
    jac = kinematics.jacobian(q, dh)
    for joint in range(6):
        ahead = independent_pose(q + step * np.eye(6)[joint], dh)
        behind = independent_pose(q - step * np.eye(6)[joint], dh)
        linear = (ahead[0] - behind[0]) / (2 * step)
        angular = Rotation.from_matrix(ahead[1] @ behind[1].transpose(0, 2, 1)).as_rotvec() / (2 * step)
        assert np.abs(jac[:, :3, joint] - linear).max() < 1e-8
        assert np.abs(jac[:, 3:, joint] - angular).max() < 1e-8


def test_elbow_and_flange_position() -> None:
    q = random_q(1000, 5).reshape(10, 2, 50, 6)
    elbow, flange = kinematics.elbow_and_flange_position(q, "ur10")
    assert np.abs(flange - kinematics.flange_pose(q, NOMINAL_DH)[0]).max() < 1e-12
    bare = replace(NOMINAL_DH, d_m=(float(DH_D_M[0]), 0, 0, float(DH_D_M[3]), *DH_D_M[4:].tolist()))
    upper = [np.eye(4)] * 1000
    for joint in range(2):
        upper = [
            pose @ _link(bare, joint, angle) for pose, angle in zip(upper, q.reshape(-1, 6)[:, joint], strict=True)
        ]
    assert np.abs(elbow.reshape(-1, 3) - np.array(upper)[:, :3, 3]).max() < 1e-12


def _link(dh: DHParameters, joint: int, angle: float) -> np.ndarray:
    rotation, twist = pin.utils.rotate("z", angle), pin.utils.rotate("x", dh.alpha_rad[joint])
    offset = pin.SE3(twist, np.array([dh.a_m[joint], 0, dh.d_m[joint]]))
    return (pin.SE3(rotation, np.zeros(3)) * offset).homogeneous


@pytest.mark.parametrize("shape", [(), (5,), (2, 1), (2, 7), (6, 2)])
@pytest.mark.parametrize(
    "function",
    [
        lambda q: kinematics.flange_pose(q, NOMINAL_DH),
        lambda q: kinematics.flange_pose_quat(q, NOMINAL_DH),
        lambda q: kinematics.jacobian(q, NOMINAL_DH),
        lambda q: kinematics.elbow_and_flange_position(q, "ur10"),
        lambda q: elbow_flange_and_tcp(q, np.zeros((2, 3)), ("ur10", "ur10")),
        lambda q: kinematics.nearest(np.zeros(3), np.eye(3), q, NOMINAL_DH),
    ],
)
def test_six_joints_are_needed(function, shape: tuple[int, ...]) -> None:
    with pytest.raises(SettingsError, match=rf"need the shape \(\.\.\., 6\), found {re.escape(str(shape))}"):
        function(np.zeros(shape))


def test_import_does_not_wait_for_pinocchio() -> None:
    code = "import sys, ur_core.kinematics; assert 'pinocchio' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_everything_named_is_there() -> None:
    assert all(hasattr(kinematics, name) for name in kinematics.__all__)
