"""Model of the UR10 against the tables: kinematics, masses, limits and dynamics."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dual_ur10.assets import cell_spec
from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.assets.visuals import CAMERAS
from dual_ur10.errors import DualUR10Error
from tests.assets.test_arm_shape import OWN
from tests.sim2real.control.reference_cell import (
    CALIBRATED,
    SHIFTED,
    UNEQUAL,
    angle,
    dh_product,
    planar,
    random_q,
    site_pose,
)
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import (
    ARMS,
    DH_A_M,
    DH_ALPHA_RAD,
    DH_D_M,
    JOINT_RANGE_RAD,
    JOINT_TORQUE_NM,
    JOINTS,
    LINK_COM_M,
    LINK_INERTIA_KG_M2,
    LINK_MASS_KG,
    LINKS,
    NOMINAL_DH,
)
from ur_core.mjcf.gains import COMPLIANT, MOST_UNSTABLE, STIFF, stability_number


@pytest.fixture(scope="module")
def model():
    return build_model(SceneSettings())


@pytest.mark.parametrize(
    "settings",
    [SceneSettings(), UNEQUAL, SceneSettings(right=ArmMount((-0.75, -0.6, 0.0), 0.0, SHIFTED))],
    ids=["nominal", "calibrated", "shifted"],
)
def test_the_flange_pose_follows_from_dh(settings):
    model = build_model(settings)
    data = mujoco.MjData(model)
    slices = sensor_slices(model)
    for q in random_q(np.random.default_rng(0), 1000):
        data.qpos[:] = q.ravel()
        mujoco.mj_forward(model, data)
        for i, (arm, mount) in enumerate(zip(ARMS, settings.mounts, strict=True)):
            flange = site_pose(data, f"{arm}/flange")
            in_base = dh_product(q[i], mount.dh)
            in_base_link = planar((0, 0, 0), np.pi) @ in_base
            in_cell = planar(mount.position_m, mount.yaw_rad) @ in_base_link
            for frame, expected in ((f"{arm}/base", in_base), (f"{arm}/base_link", in_base_link)):
                found = np.linalg.inv(site_pose(data, frame)) @ flange
                assert np.abs(found[:3, 3] - expected[:3, 3]).max() < 1e-9
                assert angle(found[:3, :3], expected[:3, :3]) < 1e-9
            assert np.abs(flange - in_cell).max() < 1e-9
            assert np.abs(data.sensordata[slices[f"{arm}/flange_base_pos"]] - in_base[:3, 3]).max() < 1e-9
            assert np.abs(data.sensordata[slices[f"{arm}/flange_pos"]] - in_cell[:3, 3]).max() < 1e-9
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, data.sensordata[slices[f"{arm}/flange_base_quat"]])
            assert angle(rotation.reshape(3, 3), in_base[:3, :3]) < 1e-9


def test_a_shifted_calibration_leaves_the_links_in_place():
    q = HOME_Q_RAD.ravel()
    places = []
    for dh in (NOMINAL_DH, SHIFTED):
        model = build_model(SceneSettings(left=ArmMount((-0.75, 0.6, 0.0), 0.0, dh)))
        data = mujoco.MjData(model)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        places.append(np.array([data.body(f"left/{link}").xipos for link in LINKS]))
    assert np.abs(places[1] - places[0]).max() < 0.005


def test_sensor_order(model):
    kinds = ("flange_base_pos", "flange_base_quat", "flange_pos")
    assert [model.sensor(i).name for i in range(model.nsensor)] == [f"{arm}/{kind}" for kind in kinds for arm in ARMS]
    assert list(sensor_slices(model).values())[-1] == slice(17, 20)


def test_order_of_joints_and_actuators(model):
    names = [f"{arm}/{joint}" for arm in ARMS for joint in JOINTS]
    assert [model.joint(i).name for i in range(model.njnt)] == names
    assert [model.actuator(i).name for i in range(model.nu)] == names
    assert model.actuator_trnid[:, 0].tolist() == list(range(12))
    assert model.jnt_dofadr.tolist() == list(range(12))


def test_a_foreign_order_is_refused(monkeypatch):
    monkeypatch.setattr(cell_spec, "JOINTS", JOINTS[::-1])
    with pytest.raises(DualUR10Error, match="expected"):
        build_model(SceneSettings(timestep_s=0.0031))  # a model that nothing has compiled before


def test_masses_and_limits(model):
    for i, arm in enumerate(ARMS):
        masses = [model.body(f"{arm}/{link}").mass[0] for link in LINKS]
        assert masses == LINK_MASS_KG.tolist()
        assert sum(masses) == pytest.approx(28.435)
        joints = slice(6 * i, 6 * i + 6)
        assert np.array_equal(model.jnt_range[joints], np.stack([-JOINT_RANGE_RAD, JOINT_RANGE_RAD], 1))
        assert model.jnt_limited[joints].all()
        assert np.array_equal(model.jnt_actfrcrange[joints], np.stack([-JOINT_TORQUE_NM, JOINT_TORQUE_NM], 1))
        assert (model.jnt_actgravcomp[joints] == 1).all()
        assert (model.dof_armature[joints] == 0.1).all()
        assert (model.dof_damping[joints] == 0).all()
        assert np.allclose(model.jnt_solref[joints], [0.004, 1])


def test_torque_saturates_at_the_limit(model):
    data = mujoco.MjData(model)
    data.qpos[:] = HOME_Q_RAD.ravel()
    data.ctrl[:] = data.qpos + 1.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator.tolist() == [*JOINT_TORQUE_NM, *JOINT_TORQUE_NM]


@pytest.mark.parametrize("gains", [STIFF, COMPLIANT, OWN])
def test_gains(gains):
    model = build_model(SceneSettings(gains=gains))
    kp, kv = gains.kp_nm_rad, gains.kv_nms_rad
    assert model.actuator_gainprm[:, 0].tolist() == [*kp, *kp]
    assert model.actuator_biasprm[:, 1].tolist() == [-k for k in (*kp, *kp)]
    assert model.actuator_biasprm[:, 2].tolist() == [-k for k in (*kv, *kv)]


def eigenvalues(model, gains, timestep_s, configurations):
    """Return the largest eigenvalue of M^-1 (2 h kv + h² kp) of the left arm in each configuration."""
    data, found = mujoco.MjData(model), []
    kp, kv = np.array(gains.kp_nm_rad), np.array(gains.kv_nms_rad)
    weight = 1 / np.sqrt(2 * timestep_s * kv + timestep_s**2 * kp)
    for q_rad in configurations:
        data.qpos[:6] = q_rad
        mujoco.mj_forward(model, data)
        inertia = np.zeros((12, 12))
        mujoco.mj_fullM(model, data, inertia)
        found.append(1 / np.linalg.eigvalsh(inertia[:6, :6] * weight * weight[:, None])[0])
    return np.array(found)


def test_stability_numbers_bound_sampled_configurations(model):
    configurations = np.random.default_rng(0).uniform(-np.pi, np.pi, (3000, 6))
    numbers = {}
    for gains, tight in ((STIFF, 0.9), (COMPLIANT, 0.9), (OWN, 0.6)):
        for timestep_s in (0.001, 0.002):
            sampled = eigenvalues(model, gains, timestep_s, configurations)
            numbers[gains, timestep_s] = stability_number(gains, timestep_s, robots=("ur10",))
            assert tight * numbers[gains, timestep_s] < sampled.max() <= numbers[gains, timestep_s]
    assert numbers[COMPLIANT, 0.001] < MOST_UNSTABLE < min(numbers[COMPLIANT, 0.002], numbers[STIFF, 0.001])


def test_euler_keeps_stable_with_the_lightest_sampled_masses():
    """An episode may sample half of the masses, of a plant that is as light as Euler allows."""
    model = build_model(SceneSettings())
    light = stability_number(COMPLIANT, 0.001, robots=("ur10",)) / MOST_UNSTABLE / 2
    model.body_mass[:] *= light
    model.body_inertia[:] *= light
    configurations = np.random.default_rng(1).uniform(-np.pi, np.pi, (3000, 6))
    assert eigenvalues(model, COMPLIANT, 0.001, configurations).max() < 3.3


def test_gravity_compensation_holds_the_arms(model):
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = HOME_Q_RAD.ravel()
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - HOME_Q_RAD.ravel()).max() < 1e-6
    model.body_gravcomp[:] = 0
    try:
        for _ in range(100):
            mujoco.mj_step(model, data)
    finally:
        model.body_gravcomp[1:] = 1
    assert np.abs(data.qpos - HOME_Q_RAD.ravel()).max() > 1e-4  # so gravity compensation held them


def test_home(model):
    data = mujoco.MjData(model)
    data.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_forward(model, data)
    for arm, y in zip(ARMS, (0.6, -0.6), strict=True):
        assert np.allclose(data.site(f"{arm}/flange").xpos, [0, y, 0.4], atol=1e-6)
        assert np.allclose(data.site(f"{arm}/flange").xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-6)
        assert data.body(f"{arm}/forearm_link").xpos[2] > 0.6  # elbow up
    assert data.ncon == 0
    assert np.abs(HOME_Q_RAD).max() < np.pi
    jacobian = np.zeros((6, 12))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("left/flange").id)
    assert np.linalg.svd(jacobian[:, :6], compute_uv=False).min() > 0.1  # away from singularities


def test_options(model):
    assert model.opt.timestep == 0.002
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.impratio == 1.0
    assert model.opt.disableflags == mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1920, 1080)
    assert [model.camera(i).name for i in range(model.ncam)] == list(CAMERAS)


def test_a_diverged_simulation_does_not_start_again(model):
    data = mujoco.MjData(model)
    data.time, data.qpos[0] = 1.0, np.nan
    mujoco.mj_step(model, data)
    assert data.time > 1.0


def arm_alone(arm, settings, q, v):
    """Return mass matrix and gravity torque of one arm in the cell, without armature."""
    model = build_model(settings)
    model.dof_armature[:] = 0
    model.body_gravcomp[:] = 0
    data = mujoco.MjData(model)
    dofs = slice(6 * ARMS.index(arm), 6 * ARMS.index(arm) + 6)
    data.qpos[dofs], data.qvel[dofs] = q, v
    mujoco.mj_forward(model, data)
    mass = np.zeros((12, 12))
    for j in range(12):  # mj_fullM changed its arguments with MuJoCo 4.0
        mujoco.mj_mulM(model, data, mass[j], np.eye(12)[j])
    return mass[dofs, dofs], data.qfrc_bias[dofs]


def test_dynamics_against_pinocchio():
    pin = pytest.importorskip("pinocchio")
    reference, parent = pin.Model(), 0
    placement = pin.SE3(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))  # base in base_link
    for i in range(6):
        c, s = np.cos(DH_ALPHA_RAD[i]), np.sin(DH_ALPHA_RAD[i])
        distal = pin.SE3(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([DH_A_M[i], 0, DH_D_M[i]]))
        ixx, iyy, izz, ixy, ixz, iyz = LINK_INERTIA_KG_M2[i]
        inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        parent = reference.addJoint(parent, pin.JointModelRZ(), placement, JOINTS[i])
        reference.appendBodyToJoint(parent, pin.Inertia(LINK_MASS_KG[i], LINK_COM_M[i], inertia), distal)
        placement = distal
    data = reference.createData()
    rng = np.random.default_rng(4)
    for q in random_q(rng, 20)[:, 0]:
        v = rng.normal(size=6)
        mass, bias = arm_alone("right", SceneSettings(), q, v)
        expected = pin.crba(reference, data, q)
        assert np.abs(mass - np.triu(expected) - np.triu(expected, 1).T).max() < 1e-9
        assert np.abs(bias - pin.rnea(reference, data, q, v, np.zeros(6))).max() < 1e-9


@pytest.mark.parametrize("dh", [NOMINAL_DH, CALIBRATED, SHIFTED], ids=["nominal", "calibrated", "shifted"])
def test_inertias_are_given_in_the_distal_frames(dh):
    model = build_model(SceneSettings(left=ArmMount((-0.75, 0.6, 0.0), 0.0, dh)))
    data = mujoco.MjData(model)
    q = np.random.default_rng(5).uniform(-3, 3, 6)
    data.qpos[:6] = q
    mujoco.mj_forward(model, data)
    base = planar((0, 0, 0), np.pi)[:3, :3]
    for i in range(6):
        zeros = (0.0,) * (5 - i)
        row = {key: (*getattr(dh, key)[: i + 1], *zeros) for key in ("a_m", "d_m", "alpha_rad", "theta_rad")}
        R = base @ dh_product([*q[: i + 1], *zeros], SimpleNamespace(**row))[:3, :3]
        origin = data.body(f"left/{LINKS[i + 1]}").xpos if i < 5 else data.site("left/flange").xpos
        body = data.body(f"left/{LINKS[i]}")
        assert np.abs(body.xipos - origin - R @ LINK_COM_M[i]).max() < 1e-9
        axes = body.ximat.reshape(3, 3)
        found = axes @ np.diag(model.body(f"left/{LINKS[i]}").inertia) @ axes.T
        ixx, iyy, izz, ixy, ixz, iyz = LINK_INERTIA_KG_M2[i]
        expected = R @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ R.T
        assert np.abs(found - expected).max() < 1e-9
