"""Arms of all models in MuJoCo: kinematics, dynamics, limits, shapes and gains."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import (
    HOME_Q_RAD,
    SceneSettings,
    default_mount,
    home_q_rad,
)
from dual_ur10.sim2real.control.clearance import Clearance
from tests.kinematics.reference_arm import calibration, random_q
from ur_core import kinematics
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import ARMS, LINKS, NOMINAL_DH, DHParameters, nominal_dh
from ur_core.mjcf.arm import arm_spec
from ur_core.mjcf.arm_shape import fit_bodies, fit_shape
from ur_core.mjcf.gains import COMPLIANT, STIFF, Gains, gains_of, stability_number

OWN = Gains((9000.0, 15000.0, 7000.0, 3000.0, 2500.0, 2000.0), (600.0, 700.0, 300.0, 50.0, 40.0, 30.0))

PAIRS = [(name, name) for name in ROBOTS] + [("ur5e", "ur10e")]
BOTH = pytest.mark.parametrize("robots", PAIRS, ids="+".join)


def scene(robots: tuple[str, str], **values: object) -> SceneSettings:
    left, right = (default_mount(arm, robot) for arm, robot in enumerate(robots))
    return SceneSettings(left=left, right=right, **values)  # type: ignore[arg-type]


@lru_cache(maxsize=len(PAIRS))
def model_of(robots: tuple[str, str]) -> mujoco.MjModel:
    return build_model(scene(robots), visuals=False)


@BOTH
def test_a_simulated_arm_has_the_figures_of_its_model(robots: tuple[str, str]) -> None:
    model = model_of(robots)
    data, sensors = mujoco.MjData(model), sensor_slices(model)
    q, zero = random_q(20, 3), np.zeros(6)
    for row in range(0, 20, 2):
        data.qpos[:] = q[row : row + 2].ravel()
        mujoco.mj_forward(model, data)
        for arm, robot in enumerate(robots):
            position, _ = kinematics.flange_pose(q[row + arm], nominal_dh(robot))
            found = data.sensordata[sensors[f"{ARMS[arm]}/flange_base_pos"]]
            np.testing.assert_allclose(found, position, atol=1e-9)
            torque = kinematics.inverse_dynamics(q[row + arm], zero, zero, robot=robot)
            np.testing.assert_allclose(data.qfrc_bias[6 * arm : 6 * arm + 6], torque, atol=1e-6)
    for arm, robot in enumerate(robots):
        facts, joints = ROBOTS[robot], slice(6 * arm, 6 * arm + 6)
        masses = [float(model.body(f"{ARMS[arm]}/{link}").mass[0]) for link in LINKS]
        assert masses == pytest.approx(facts.mass_kg, rel=1e-12)
        np.testing.assert_allclose(model.jnt_actfrcrange[joints, 1], facts.joint_torque_nm, rtol=1e-12)
        np.testing.assert_allclose(model.dof_armature[joints], facts.armature_kg_m2, rtol=1e-12)


@pytest.mark.parametrize("robot", ["ur5e", "ur20"])
def test_a_calibrated_arm_of_another_model_is_where_its_parameters_say(robot: str) -> None:
    nominal, error = nominal_dh(robot), calibration(3, 0.2)
    rows = ("a_m", "d_m", "alpha_rad", "theta_rad")
    parts = [
        np.add(getattr(nominal, each), np.subtract(getattr(error, each), getattr(NOMINAL_DH, each))) for each in rows
    ]
    dh = DHParameters(*map(tuple, parts), robot=robot)  # type: ignore[misc]
    mount = ArmMount((-0.75, 0.6, 0.0), 0.0, dh, robot)
    model = build_model(SceneSettings(left=mount, right=default_mount(1, robot)), visuals=False)
    data, sensors = mujoco.MjData(model), sensor_slices(model)
    data.qpos[:6] = q = random_q(1, 5)[0]
    mujoco.mj_forward(model, data)
    found = data.sensordata[sensors["left/flange_base_pos"]]
    np.testing.assert_allclose(found, kinematics.flange_pose(q, dh)[0], atol=1e-9)


@BOTH
def test_both_arms_begin_apart_with_their_flanges_over_the_table(robots: tuple[str, str]) -> None:
    settings = scene(robots)
    home = home_q_rad(settings.mounts)
    model = model_of(robots)
    data = mujoco.MjData(model)
    data.qpos[:] = home.ravel()
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    Clearance(settings).check_start(home[None])
    sensors = sensor_slices(model)
    for arm, name in enumerate(ARMS):
        found = data.sensordata[sensors[f"{name}/flange_pos"]]
        np.testing.assert_allclose(found, (0.0, 0.6 - 1.2 * arm, 0.4), atol=1e-6)


def test_the_shape_of_the_ur10_follows_from_itself() -> None:
    plain, fitted = (arm_spec(NOMINAL_DH, STIFF) for _ in range(2))
    fit_bodies(fitted, ROBOTS["ur10"])
    fit_shape(fitted, ROBOTS["ur10"])
    for link in ("base_link", *LINKS):
        one, other = plain.body(link), fitted.body(link)
        for a, b in zip(one.geoms, other.geoms, strict=True):
            where = "pos" if np.isnan(a.fromto[0]) else "fromto"
            np.testing.assert_allclose(getattr(b, where), getattr(a, where), atol=1e-12)
            np.testing.assert_allclose(b.size, a.size, atol=1e-12)
        if link in LINKS:
            np.testing.assert_allclose(other.ipos, one.ipos, atol=1e-12)
            np.testing.assert_allclose(other.fullinertia, one.fullinertia, atol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_housings_of_neighbouring_links_meet(robot: str) -> None:
    spec = arm_spec(nominal_dh(robot), STIFF)

    def ends(link: str, axis: int) -> np.ndarray:
        """Ends of the drawn cylinders and of rubber rings between housings, along an axis of the body."""
        drawn = [geom for geom in spec.body(link).geoms if not np.isnan(geom.fromto[0])]
        rows = [np.reshape(geom.fromto, (2, 3)) for geom in drawn if geom.classname.name == "visual"]
        return np.concatenate(rows)[:, axis]

    upper, fore = ends("upper_arm_link", 2), ends("forearm_link", 2)
    assert -ends("shoulder_link", 1).min() == pytest.approx(upper[0])  # the first one is the housing at the shoulder
    assert upper[-2:].min() == pytest.approx(fore[1])  # the elbow
    assert fore[-1] == pytest.approx(ends("wrist_1_link", 2).min())
    assert -ends("wrist_1_link", 1).min() == pytest.approx(ends("wrist_2_link", 2).min())
    assert ends("wrist_2_link", 1).max() == pytest.approx(ends("wrist_3_link", 2).min())


@pytest.mark.parametrize("robot", ROBOTS)
def test_gains_are_as_stable_as_their_number_says(robot: str) -> None:
    model = model_of((robot, robot))
    data, mass = mujoco.MjData(model), np.zeros((12, 12))
    worst = dict.fromkeys((STIFF, COMPLIANT, OWN), 0.0)
    for q in random_q(30, 8):
        data.qpos[:] = np.tile(q, 2)
        mujoco.mj_forward(model, data)
        for joint in range(12):  # mj_fullM changed its arguments with MuJoCo 4.0
            mujoco.mj_mulM(model, data, mass[joint], np.eye(12)[joint])
        for gains in worst:
            kp, kv = gains_of(robot, gains)
            servo = 2 * 0.001 * np.diag(kv) + 0.001**2 * np.diag(kp)
            found = np.abs(np.linalg.eigvals(np.linalg.solve(mass[:6, :6], servo))).max()
            worst[gains] = max(worst[gains], float(found))
    for gains, number in worst.items():
        assert number <= stability_number(gains, 0.001, robots=(robot,))
        assert number >= 0.2 * stability_number(gains, 0.001, robots=(robot,))
    assert gains_of("ur10", OWN) == (OWN.kp_nm_rad, OWN.kv_nms_rad)


def test_mounts_name_their_model_and_nothing_contradicts_it() -> None:
    assert (home_q_rad((default_mount(0), default_mount(1))) == HOME_Q_RAD).all()
    assert default_mount(0) == ArmMount((-0.75, 0.6, 0.0))
    mount = ArmMount((-0.5, 0.6, 0.0), robot="ur5e")
    assert mount.dh == nominal_dh("ur5e")
    assert mount.model is ROBOTS["ur5e"]
    assert ArmMount((-0.5, 0.6, 0.0), 0.0, nominal_dh("ur5e"), "ur5e") == mount
    with pytest.raises(UnknownNameError, match="robot model 'ur5f'"):
        ArmMount((0.0, 0.0, 0.0), robot="ur5f")
    for dh, robot in ((nominal_dh("ur5e"), "ur10"), (nominal_dh("ur5e"), "ur10e"), (calibration(1), "ur5e")):
        with pytest.raises(SettingsError, match="name one model"):
            ArmMount((0.0, 0.0, 0.0), 0.0, dh, robot)
    with pytest.raises(SettingsError, match="meshes=True with ur5e and ur5e"):
        scene(("ur5e", "ur5e"), meshes=True)
