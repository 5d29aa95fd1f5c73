"""Grippers: command tracking, synchronous fingers, grip force, mass, wrench and cameras."""

import dataclasses

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.cell_spec import actuator_names, joint_names
from dual_ur10.assets.props import BLOCK
from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.assets.visuals import CAMERAS, cameras
from tests.sim2real.control.reference_cell import UNEQUAL, angle, random_q, site_pose
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

GRIPPERS = SceneSettings(equipment=Equipment(grippers=True))
OPENING = 0.05
GRAVITY = 9.81


def at(settings, q=HOME_Q_RAD, opening=OPENING):
    """Return model and data at rest at the joint positions `q` (2, 6)."""
    model = build_model(settings, visuals=False)
    data = mujoco.MjData(model)
    data.qpos[:16] = np.pad(q, ((0, 0), (0, 2)), constant_values=opening / 2).ravel()
    data.ctrl[:] = np.pad(q, ((0, 0), (0, 1)), constant_values=opening).ravel()
    mujoco.mj_forward(model, data)
    return model, data


def run(model, data, seconds):
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))


def with_timestep(timestep_s, force_n=60.0):
    return SceneSettings(timestep_s=timestep_s, equipment=Equipment(grippers=True, grip_force_n=force_n))


def test_order_of_joints_actuators_and_sensors():
    for settings, props in ((GRIPPERS, ()), (SceneSettings(equipment=Equipment(True, (BLOCK,))), ("block/free",))):
        model = build_model(settings)
        joints = [f"{arm}/{joint}" for arm in ARMS for joint in (*JOINTS, "finger_1_joint", "finger_2_joint")]
        assert [model.joint(i).name for i in range(model.njnt)] == [*joints, *props]
        assert joint_names(settings) == (*joints, *props)
        assert model.jnt_qposadr[:16].tolist() == list(range(16))
        actuators = [f"{arm}/{actuator}" for arm in ARMS for actuator in (*JOINTS, "gripper")]
        assert [model.actuator(i).name for i in range(model.nu)] == actuators == list(actuator_names(settings))
        slices = sensor_slices(model)
        new = [f"{arm}/wrench_{kind}" for kind in ("force", "torque") for arm in ARMS]
        assert list(slices)[6:] == new
        assert [slices[name] for name in new] == [slice(20 + 3 * i, 23 + 3 * i) for i in range(4)]
        assert model.opt.impratio == 100


@pytest.mark.parametrize("settings", [GRIPPERS, dataclasses.replace(UNEQUAL, equipment=Equipment(True))])
def test_frames(settings):
    model, data = at(settings, random_q(np.random.default_rng(0), 1)[0], OPENING)
    mujoco.mj_kinematics(model, data)
    for arm in ARMS:
        flange, wrench, tcp = (site_pose(data, f"{arm}/{name}") for name in ("flange", "wrench", "tcp"))
        assert np.abs(wrench - flange).max() < 1e-9
        inside = np.linalg.inv(flange) @ tcp
        assert np.abs(inside[:3, 3] - [0, 0, TOOL.tcp_m]).max() < 1e-9
        assert angle(inside[:3, :3], np.eye(3)) < 1e-7
        inverse, tip_z = np.linalg.inv(flange), []
        for i, sign in ((1, 1), (2, -1)):
            pad = model.geom(f"{arm}/pad_{i}")
            place = inverse[:3, :3] @ data.geom_xpos[pad.id] + inverse[:3, 3]
            assert np.abs(place - [0, sign * (OPENING / 2 + pad.size[1]), TOOL.tcp_m]).max() < 1e-9
            tip_z.append(place[2] + pad.size[2])
        assert tip_z == pytest.approx([TOOL.fingertip_m] * 2)


@pytest.mark.parametrize("timestep_s", [0.001, 0.002])
@pytest.mark.parametrize("force_n", TOOL.force_n)
def test_fingers_follow_a_ramp_without_overshoot(timestep_s, force_n):
    model, data = at(with_timestep(timestep_s, force_n), opening=0.0)
    for start, end in ((0.0, TOOL.stroke_m), (TOOL.stroke_m, 0.03)):
        commands = np.arange(start, end, np.sign(end - start) * TOOL.speed_m_s[1] * timestep_s)
        for command in (*commands, *[end] * round(0.3 / timestep_s)):
            data.ctrl[6] = command
            mujoco.mj_step(model, data)
            opening = data.qpos[6] + data.qpos[7]
            assert abs(opening - command) < 0.002
            assert min(start, end) - 1e-6 < opening < max(start, end) + 1e-6
            assert abs(data.qpos[6] - data.qpos[7]) < 1e-6
        assert opening == pytest.approx(end, abs=1e-5)
    assert np.abs(data.qpos[14:16]).max() < 1e-6  # the other gripper stays


@pytest.mark.parametrize("timestep_s", [0.001, 0.002])
@pytest.mark.parametrize("load_n", [-50.0, 50.0])
def test_fingers_stay_in_step_under_a_load_on_one(timestep_s, load_n):
    model, data = at(with_timestep(timestep_s))
    finger = model.body("left/finger_1").id
    for _ in range(round(0.5 / timestep_s)):
        data.xfrc_applied[finger, :3] = load_n * data.site("left/tcp").xmat.reshape(3, 3)[:, 1]
        mujoco.mj_step(model, data)
    moved = data.qpos[6:8] - OPENING / 2
    assert (moved * np.sign(load_n) > 5e-4).all()  # the servo yields as far as its stiffness allows ...
    assert abs(moved[0] - moved[1]) < 2e-5  # ... and both fingers move


def test_fingers_do_not_sag():
    q = HOME_Q_RAD.copy()
    q[:, 4] += 1.2
    q[:, 5] += 0.7
    model, data = at(GRIPPERS, q)
    assert abs(data.site("left/tcp").xmat.reshape(3, 3)[2, 1]) > 0.5  # fingers open up and down
    run(model, data, 0.5)
    assert np.abs(data.qpos[[6, 7, 14, 15]] - OPENING / 2).max() < 1e-7
    assert np.abs(data.qpos[:6] - q[0]).max() < 1e-6


@pytest.mark.parametrize("force_n", [20.0, 60.0, 235.0])
def test_pads_press_with_the_force_set(force_n):
    settings = SceneSettings(equipment=Equipment(True, (BLOCK,), grip_force_n=force_n))
    model, data = at(settings)
    data.qpos[16:19] = data.site("left/tcp").xpos  # in the air between the pads
    data.ctrl[6] = 0.0
    model.body_gravcomp[model.body("block/block").id] = 1.0
    run(model, data, 0.5)
    assert data.actuator_force[6] == -force_n
    pressing, force = dict.fromkeys(("left/pad_1", "left/pad_2"), 0.0), np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, force)
        names = {model.geom(contact.geom1).name, model.geom(contact.geom2).name}
        (pad,) = names - {"block/block"}
        pressing[pad] += force[0]
    assert list(pressing.values()) == pytest.approx([force_n, force_n], rel=1e-3)


def test_a_gripper_does_not_touch_itself():
    for opening in (-0.001, 0.0, TOOL.stroke_m):  # closed at full force, the joint limits yield a little
        _, data = at(GRIPPERS, opening=opening)
        assert data.ncon == 0


def test_contact_settings_of_the_pads():
    for timestep_s, time_constant in ((0.0005, 0.002), (0.001, 0.002), (0.002, 0.004)):
        model = build_model(with_timestep(timestep_s))
        for arm in ARMS:
            for i in (1, 2):
                pad = model.geom(f"{arm}/pad_{i}").id
                assert (model.geom_condim[pad], model.geom_priority[pad], model.geom_friction[pad, 0]) == (4, 1, 1.0)
                assert model.geom_solref[pad].tolist() == [time_constant, 1.0]
                assert model.geom_solimp[pad, :3].tolist() == [0.99, 0.999, 0.001]


def test_the_wrench_at_rest_carries_the_gripper():
    q = HOME_Q_RAD.copy()
    q[1, 4] += 1.0
    model, data = at(GRIPPERS, q)
    run(model, data, 0.2)
    slices = sensor_slices(model)
    for arm in ARMS:
        axes = data.site(f"{arm}/wrench").xmat.reshape(3, 3)
        force, torque = (data.sensordata[slices[f"{arm}/wrench_{kind}"]] for kind in ("force", "torque"))
        assert axes @ force == pytest.approx([0, 0, TOOL.mass_kg * GRAVITY], abs=1e-3)
        lever = data.subtree_com[model.body(f"{arm}/gripper").id] - data.site(f"{arm}/wrench").xpos
        assert axes @ torque == pytest.approx(np.cross(lever, axes @ force), abs=1e-3)
    # Straight down, it is along the flange's -z.
    assert data.sensordata[slices["left/wrench_force"]] == pytest.approx([0, 0, -TOOL.mass_kg * GRAVITY], abs=1e-3)


def test_the_wrench_has_the_sign_of_a_push():
    model, data = at(GRIPPERS)
    force = sensor_slices(model)["left/wrench_force"]
    run(model, data, 0.3)
    before = data.sensordata[force].copy()
    push = np.array([5.0, -3.0, 8.0])
    data.xfrc_applied[model.body("left/gripper").id, :3] = push
    run(model, data, 1.0)
    # The wrist opposes the push.
    axes = data.site("left/wrench").xmat.reshape(3, 3)
    assert axes @ (data.sensordata[force] - before) == pytest.approx(-push, abs=0.02)


def test_the_mass_is_that_of_the_data_sheet():
    model = build_model(GRIPPERS)
    for arm in ARMS:
        assert model.body_subtreemass[model.body(f"{arm}/gripper").id] == pytest.approx(TOOL.mass_kg)
    assert TOOL.mass_kg == 0.925


def test_wrist_cameras_see_the_fingertips():
    model = build_model(GRIPPERS)
    assert tuple(model.camera(i).name for i in range(model.ncam)) == cameras(GRIPPERS)
    assert cameras(SceneSettings()) == CAMERAS
    data = mujoco.MjData(model)
    for opening in (0.0, TOOL.stroke_m):
        data.qpos[:16] = np.pad(HOME_Q_RAD, ((0, 0), (0, 2)), constant_values=opening / 2).ravel()
        mujoco.mj_forward(model, data)
        for arm in ARMS:
            camera = model.camera(f"{arm}/wrist").id
            axes = data.cam_xmat[camera].reshape(3, 3)
            for i in (1, 2):
                pad = model.geom(f"{arm}/pad_{i}").id
                tip = data.geom_xpos[pad] + data.geom_xmat[pad].reshape(3, 3)[:, 2] * model.geom_size[pad, 2]
                x, y, z = axes.T @ (tip - data.cam_xpos[camera])
                edge = np.tan(np.radians(model.cam_fovy[camera]) / 2)
                assert z < -0.03
                assert abs(y / z) < edge
                assert abs(x / z) < edge * 4 / 3
            # At home the top of the image is away from the base.
            assert axes[0, 1] > 0.8
