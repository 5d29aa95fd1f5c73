"""The model is a UR10: kinematics, masses and limits of the tables, contacts where they belong, honest distances."""

import itertools
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from mujoco import batch

from dual_ur10.assets import scene
from dual_ur10.assets.scene import HOME_Q_RAD, ArmMount, SceneSettings
from dual_ur10.errors import DualUR10Error, MissingExtraError, SettingsError, UnknownNameError
from dual_ur10.ur10 import (
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
    DHParameters,
)

CALIBRATED = DHParameters(
    a_m=(0.0003, -0.6111, -0.5731, 0.0002, -0.0001, 0.0),
    d_m=(0.1281, 0.004, -0.0035, 0.1632, 0.1163, 0.0919),
    alpha_rad=(1.5712, 0.0011, -0.0007, 1.5699, -1.5715, 0.0004),
    theta_rad=(0.001, -0.012, 0.02, -0.009, 0.0004, -0.0007),
)
# Only d2 + d3 + d4 can be observed, so a calibration may move the frames by metres.
SHIFTED = DHParameters(
    d_m=(0.1273, 2.0, -1.9985, 0.1624, 0.1157, 0.0922), alpha_rad=(np.pi / 2, 0.001, 0, np.pi / 2, -np.pi / 2, 0)
)
CROSSING = (-0.9, 0.9)
UNEQUAL = SceneSettings(
    left=ArmMount((-0.75, 0.6, 0.0), 0.3, CALIBRATED), right=ArmMount((-0.92, -0.45, 0.08), -2.1, NOMINAL_DH)
)


def dh_product(q, dh=NOMINAL_DH):
    """Textbook product of standard DH matrices: flange in UR's base frame, (4, 4)."""
    T = np.eye(4)
    for theta, a, d, alpha in zip(np.add(q, dh.theta_rad), dh.a_m, dh.d_m, dh.alpha_rad, strict=True):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return T


def planar(position, yaw):
    """Pose of a frame turned about z only, (4, 4)."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = position
    return T


def angle(a, b):
    """Angle between two rotation matrices; exact near zero, unlike the arc cosine of the trace."""
    return 2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))


def site_pose(data, name):
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = data.site(name).xpos, data.site(name).xmat.reshape(3, 3)
    return T


def random_q(rng, n):
    return rng.uniform(-1, 1, (n, 2, 6)) * JOINT_RANGE_RAD


def contacts(model, q):
    """Pairs of geom names in contact at (2, 6) joint positions."""
    data = mujoco.MjData(model)
    data.qpos[:12] = np.ravel(q)
    mujoco.mj_forward(model, data)
    return {tuple(sorted((model.geom(c.geom1).name, model.geom(c.geom2).name))) for c in data.contact if c.dist < 0.0}


@pytest.fixture(scope="module")
def model():
    return scene.build_model(SceneSettings())


@pytest.fixture(scope="module")
def clearance():
    return scene.build_clearance_model(SceneSettings())


@pytest.mark.parametrize(
    "settings",
    [SceneSettings(), UNEQUAL, SceneSettings(right=ArmMount((-0.75, -0.6, 0.0), 0.0, SHIFTED))],
    ids=["nominal", "calibrated", "shifted"],
)
def test_flange_is_where_dh_says(settings):
    model = scene.build_model(settings)
    data = mujoco.MjData(model)
    slices = scene.sensor_slices(model)
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
            turned = np.zeros(9)
            mujoco.mju_quat2Mat(turned, data.sensordata[slices[f"{arm}/flange_base_quat"]])
            assert angle(turned.reshape(3, 3), in_base[:3, :3]) < 1e-9


def test_a_shifted_calibration_leaves_the_links_in_place():
    q = HOME_Q_RAD.ravel()
    places = []
    for dh in (NOMINAL_DH, SHIFTED):
        model = scene.build_model(SceneSettings(left=ArmMount((-0.75, 0.6, 0.0), 0.0, dh)))
        data = mujoco.MjData(model)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        places.append(np.array([data.body(f"left/{link}").xipos for link in LINKS]))
    assert np.abs(places[1] - places[0]).max() < 0.005


def test_sensor_order(model):
    kinds = ("flange_base_pos", "flange_base_quat", "flange_pos")
    assert [model.sensor(i).name for i in range(model.nsensor)] == [f"{arm}/{kind}" for kind in kinds for arm in ARMS]
    assert list(scene.sensor_slices(model).values())[-1] == slice(17, 20)


def test_order_of_joints_and_actuators(model):
    names = [f"{arm}/{joint}" for arm in ARMS for joint in JOINTS]
    assert [model.joint(i).name for i in range(model.njnt)] == names
    assert [model.actuator(i).name for i in range(model.nu)] == names
    assert model.actuator_trnid[:, 0].tolist() == list(range(12))
    assert model.jnt_dofadr.tolist() == list(range(12))


def test_a_foreign_order_is_refused(monkeypatch):
    monkeypatch.setattr(scene, "JOINTS", JOINTS[::-1])
    with pytest.raises(DualUR10Error, match="expected"):
        scene.build_model(SceneSettings())


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


@pytest.mark.parametrize("name", list(scene.GAINS))
def test_gains(name):
    model = scene.build_model(SceneSettings(gains=name))
    kp, kv = scene.GAINS[name]
    assert model.actuator_gainprm[:, 0].tolist() == [*kp, *kp]
    assert model.actuator_biasprm[:, 1].tolist() == [-k for k in (*kp, *kp)]
    assert model.actuator_biasprm[:, 2].tolist() == [-k for k in (*kv, *kv)]


def test_gravity_compensation_holds_still(model):
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
    assert np.abs(data.qpos - HOME_Q_RAD.ravel()).max() > 1e-4  # so it is gravcomp that held it


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
    assert model.opt.disableflags == mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1920, 1080)
    assert [model.camera(i).name for i in range(model.ncam)] == list(scene.CAMERAS)


def test_a_diverged_simulation_does_not_start_again(model):
    data = mujoco.MjData(model)
    data.time, data.qpos[0] = 1.0, np.nan
    mujoco.mj_step(model, data)
    assert data.time > 1.0


def test_one_collision_capsule_per_link(model):
    for arm in ARMS:
        for link in ("base_link", *LINKS):
            geoms = np.flatnonzero(model.geom_bodyid == model.body(f"{arm}/{link}").id)
            solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
            assert [model.geom(g).name for g in solid] == [f"{arm}/{link}"]
            assert model.geom_type[solid[0]] == mujoco.mjtGeom.mjGEOM_CAPSULE
            assert model.geom_group[solid[0]] == 3
            assert (model.geom_group[np.setdiff1d(geoms, solid)] == 2).all()


def test_capsules_hug_the_drawn_arm(model):
    # Every drawn part lies within 2 cm of some capsule of its arm: points on the parts' rims, at home.
    data = mujoco.MjData(model)
    data.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_forward(model, data)
    capsules = [model.geom(f"left/{link}").id for link in ("base_link", *LINKS)]
    turns = np.linspace(0, 2 * np.pi, 24)
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name
        if name.startswith("left/") and model.geom_group[geom] == 2 and model.geom_type[geom] == 5:
            radius, half = model.geom_size[geom, :2]
            rim = np.concatenate(
                [np.stack([radius * np.cos(turns), radius * np.sin(turns), 0 * turns + z], 1) for z in (-half, half)]
            )
            points = data.geom_xpos[geom] + rim @ data.geom_xmat[geom].reshape(3, 3).T
            outside = np.min([point_to_capsule(model, data, c, points) for c in capsules], axis=0)
            assert outside.max() < 0.02, (name, geom)


def segment(model, data, geom, n=2):
    half = model.geom_size[geom, 1]
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
    return data.geom_xpos[geom] + np.linspace(-half, half, n)[:, None] * axis


def point_to_capsule(model, data, geom, points):
    a, b = segment(model, data, geom)
    t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1) - model.geom_size[geom, 0]


def test_neighbours_never_touch(model):
    """Nor do parts that the arm's build keeps apart in every posture."""
    chain = ("base_link", *LINKS)
    filtered = {frozenset(pair) for pair in itertools.pairwise(chain)}
    filtered |= {
        frozenset(pair)
        for pair in (
            ("wrist_1_link", "wrist_3_link"),
            ("forearm_link", "wrist_2_link"),
            ("base_link", "upper_arm_link"),
            ("base_link", "wrist_1_link"),
            ("base_link", "wrist_2_link"),
            ("shoulder_link", "wrist_1_link"),
            ("shoulder_link", "wrist_2_link"),
        )
    }
    own = set()
    for q in random_q(np.random.default_rng(1), 1500):
        for a, b in contacts(model, q):
            if a.split("/")[0] == b.split("/")[0]:
                own.add(frozenset((a.split("/")[1], b.split("/")[1])))
    assert not own & filtered
    assert frozenset(("wrist_3_link", "shoulder_link")) in own  # the filter does not hide real self-collision


@pytest.mark.parametrize("apart_m", [1.2, 0.3])
def test_every_possible_contact_is_measured(apart_m):
    settings = SceneSettings(left=ArmMount((-0.75, apart_m / 2, 0.0)), right=ArmMount((-0.75, -apart_m / 2, -0.5)))
    model = scene.build_model(settings)
    measured = {tuple(sorted(pair)) for pair in scene.clearance_pairs()}
    seen = set()
    for q in random_q(np.random.default_rng(2), 1500):
        seen |= contacts(model, q)
    assert seen <= measured
    assert len(seen) > len(measured) / 3


def test_arms_meet(model):
    q = HOME_Q_RAD.copy()
    q[:, 0] += CROSSING  # the left arm swings right, the right arm left, until the wrists meet midway
    assert any({a.split("/")[0], b.split("/")[0]} == set(ARMS) for a, b in contacts(model, q))
    assert not contacts(model, HOME_Q_RAD)


@pytest.mark.parametrize("arm", [0, 1])
def test_arm_meets_table_and_floor(model, arm):
    q = HOME_Q_RAD.copy()
    q[arm, 1] += 0.75  # shoulder forward: the wrist goes down on the table
    assert any("table" in pair and ARMS[arm] in pair[0] for pair in contacts(model, q))
    q = HOME_Q_RAD.copy()
    q[arm] = [np.pi, 0.8, 0.0, 0.0, 0.0, 0.0]  # straight out and down, behind the base
    assert any("floor" in pair and ARMS[arm] in pair[-1] for pair in contacts(model, q))


def test_clearance_is_the_distance_of_the_capsules(model, clearance):
    pairs = scene.clearance_pairs()
    assert clearance.nsensor == clearance.nsensordata == len(pairs) == len(set(pairs))
    assert (clearance.ngeom, clearance.nu) == (16, 0)
    data, twin = mujoco.MjData(model), mujoco.MjData(clearance)
    rng = np.random.default_rng(3)
    close = np.zeros(len(pairs), dtype=int)
    for _ in range(300):
        q = HOME_Q_RAD + rng.uniform(-1.5, 1.5, (2, 6))
        data.qpos[:] = twin.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_forward(clearance, twin)
        assert twin.ncon == 0
        for i, pair in enumerate(pairs):
            a, b = (model.geom(name).id for name in pair)
            expected = mujoco.mj_geomDistance(model, data, a, b, scene.CLEARANCE_CUTOFF_M, np.zeros(6))
            assert twin.sensordata[i] == pytest.approx(expected, abs=1e-6)
            if pair[1] == "floor":
                by_hand = segment(model, data, a)[:, 2].min() - model.geom_size[a, 0] - scene.FLOOR_Z_M
            elif pair[1] != "table":
                by_hand = point_to_capsule(model, data, b, segment(model, data, a, 200)).min() - model.geom_size[a, 0]
            else:
                continue
            by_hand = min(by_hand, scene.CLEARANCE_CUTOFF_M)
            if by_hand > 0.0:
                assert twin.sensordata[i] == pytest.approx(by_hand, abs=2e-3)
            close[i] += expected < scene.CLEARANCE_CUTOFF_M
    assert (close > 0).sum() > len(pairs) / 2  # the comparison was not one of cut-off with cut-off


def test_clearance_in_a_batch(clearance):
    cells = batch.Batch(clearance, 2, 1)
    q, distances = cells.bind("qpos"), cells.bind("sensordata")
    q[0] = HOME_Q_RAD.ravel()
    q[1] = HOME_Q_RAD.ravel()
    q[1, [0, 6]] += CROSSING
    cells.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
    assert distances[0].min() > 0.04
    assert distances[1].min() < 0.0


def arm_alone(arm, settings, q, v):
    """Mass matrix and gravity torque of one arm in the cell, armature taken off."""
    model = scene.build_model(settings)
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
def test_inertials_stand_in_the_distal_frames(dh):
    model = scene.build_model(SceneSettings(left=ArmMount((-0.75, 0.6, 0.0), 0.0, dh)))
    data = mujoco.MjData(model)
    q = np.random.default_rng(5).uniform(-3, 3, 6)
    data.qpos[:6] = q
    mujoco.mj_forward(model, data)
    turn = planar((0, 0, 0), np.pi)[:3, :3]
    for i in range(6):
        zeros = (0.0,) * (5 - i)
        row = {key: (*getattr(dh, key)[: i + 1], *zeros) for key in ("a_m", "d_m", "alpha_rad", "theta_rad")}
        R = turn @ dh_product([*q[: i + 1], *zeros], SimpleNamespace(**row))[:3, :3]
        origin = data.body(f"left/{LINKS[i + 1]}").xpos if i < 5 else data.site("left/flange").xpos
        body = data.body(f"left/{LINKS[i]}")
        assert np.abs(body.xipos - origin - R @ LINK_COM_M[i]).max() < 1e-9
        axes = body.ximat.reshape(3, 3)
        found = axes @ np.diag(model.body(f"left/{LINKS[i]}").inertia) @ axes.T
        ixx, iyy, izz, ixy, ixz, iyz = LINK_INERTIA_KG_M2[i]
        expected = R @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ R.T
        assert np.abs(found - expected).max() < 1e-9


def test_texts_are_cached_and_models_are_not():
    assert scene.compose(SceneSettings()) is scene.compose(SceneSettings())
    assert scene.compose_clearance(SceneSettings()) is scene.compose_clearance(SceneSettings())
    assert scene.compose(SceneSettings()) != scene.compose(SceneSettings(timestep_s=0.001))
    model = scene.build_model(SceneSettings())
    model.body_mass[:] = 0
    assert scene.build_model(SceneSettings()).body_mass.sum() > 50


def test_lists_will_do_as_positions():
    settings = SceneSettings(left=ArmMount([-0.75, 0.6, 0]))
    assert settings == SceneSettings()
    assert scene.compose(settings) is scene.compose(SceneSettings())


def test_import_is_light_and_quiet():
    code = (
        "import sys, dual_ur10.assets.scene as s;"
        "heavy = {'mujoco', 'dm_control', 'glfw', 'OpenGL'} & set(sys.modules);"
        "assert not heavy, heavy;"
        "s.build_model(s.SceneSettings())"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: ArmMount((0.0, np.nan, 0.0)), SettingsError, "finite"),
        (lambda: ArmMount((0.0, 0.0)), SettingsError, "3 finite"),
        (lambda: ArmMount("abc"), SettingsError, "finite"),
        (lambda: ArmMount((0.0, 5.0, 0.0)), SettingsError, "within"),
        (lambda: ArmMount((-1.0, 0.0, -0.8)), SettingsError, "floor"),
        (lambda: ArmMount((-1.0, 0.0, 0.0), 90.0), SettingsError, "rad"),
        (lambda: ArmMount((-1.0, 0.0, 0.0), np.inf), SettingsError, "finite"),
        (lambda: ArmMount((-1.0, 0.0, 0.0), 0.0, None), SettingsError, "DHParameters"),
        (lambda: SceneSettings(left=None), SettingsError, "ArmMount"),
        (lambda: SceneSettings(timestep_s=0.0), SettingsError, "timestep_s"),
        (lambda: SceneSettings(timestep_s=np.nan), SettingsError, "timestep_s"),
        (lambda: SceneSettings(gains="soft"), UnknownNameError, "stiff"),
        (lambda: SceneSettings(gains=[20000.0]), UnknownNameError, "stiff"),
        (lambda: SceneSettings(table_size_m=(0.0, 1.0)), SettingsError, "table"),
        (lambda: SceneSettings(left=ArmMount((-0.75, -0.4, 0.0))), SettingsError, "apart"),
        (lambda: SceneSettings(left=ArmMount((-0.45, 0.6, -0.1))), SettingsError, "inside the table"),
    ],
)
def test_bad_settings(make, error, match):
    with pytest.raises(error, match=match):
        make()


def test_a_base_may_stand_on_the_table():
    model = scene.build_model(SceneSettings(left=ArmMount((-0.3, 0.6, 0.0))))
    assert not contacts(model, HOME_Q_RAD)


def test_meshes_are_looks_only():
    settings = SceneSettings(meshes=True)
    try:
        model = scene.build_model(settings)
    except MissingExtraError as error:
        assert "example-robot-data" in str(error)  # noqa: PT017 - either outcome is a pass
        return
    assert model.nmesh == 7
    plain = scene.build_model(SceneSettings())
    assert np.array_equal(model.body_mass, plain.body_mass)
    assert (model.geom_contype > 0).sum() == (plain.geom_contype > 0).sum()


def test_text_names_no_file():
    assert not list(ET.fromstring(scene.compose(SceneSettings())).iterfind(".//*[@file]"))
