"""Tilted bases: whatever uses the pose of a base uses all of it."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import Equipment, SceneSettings, home_q_rad
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.errors import SettingsError
from dual_ur10.policies.scripted.base import on_table
from dual_ur10.sim2real.analysis.tracks import flange_of
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.recording.header import _mount, _plain_mount
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import MAX_TILT_RAD, ArmMount, Frames, to_base, yaw_and_tilt
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix
from ur_core.kinematics.ur10 import ARMS

MOUNTS = (
    ArmMount((-0.75, 0.6, 0.02), 0.2, tilt_rad=(0.05, -0.03)),
    ArmMount((-0.75, -0.6, 0.0), -0.3, tilt_rad=(-0.04, 0.06)),
)
TILTED = CellConfig(left=MOUNTS[0], right=MOUNTS[1])
LEVEL = tuple(dataclasses.replace(each, tilt_rad=(0.0, 0.0)) for each in MOUNTS)
HOME = home_q_rad(MOUNTS)


def test_a_mount_is_rotated_and_then_tilted():
    mount = ArmMount((0.0, 0.0, 0.0), math.pi / 2, tilt_rad=(0.02, 0.0))
    x, _, z = quat_to_matrix(mount.quat).T
    np.testing.assert_allclose(x, (0.0, math.cos(0.02), math.sin(0.02)), atol=1e-12)  # faced +y, and looks up
    np.testing.assert_allclose(z, (0.0, -math.sin(0.02), math.cos(0.02)), atol=1e-12)
    yaw_rad, tilt_rad = yaw_and_tilt(-mount.quat)
    assert (yaw_rad, *tilt_rad) == pytest.approx((math.pi / 2, 0.02, 0.0), abs=1e-12)
    with pytest.raises(SettingsError, match=r"at most 5° about each axis .* Level the base"):
        ArmMount((0.0, 0.0, 0.0), tilt_rad=(0.0, -MAX_TILT_RAD * 1.001))
    with pytest.raises(SettingsError, match="2 finite numbers"):
        ArmMount((0.0, 0.0, 0.0), tilt_rad=(math.nan, 0.0))


@pytest.mark.parametrize("build", [build_model, build_collision_model])
def test_all_models_and_formulas_put_the_flanges_at_one_place(build):
    model = build(SceneSettings(left=MOUNTS[0], right=MOUNTS[1]))
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    frames = Frames(MOUNTS)
    for _ in range(5):
        q = rng.uniform(-3.0, 3.0, (2, 6))
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        own = [flange_pose_quat(q[arm], mount.dh) for arm, mount in enumerate(MOUNTS)]
        position_m = frames.position_to_cell(np.array([each[0] for each in own]))
        rotation = quat_to_matrix(frames.quat_to_cell(np.array([each[1] for each in own])))
        for arm, name in enumerate(ARMS):
            site = data.site(f"{name}/flange")
            np.testing.assert_allclose(position_m[arm], site.xpos, atol=1e-9)
            np.testing.assert_allclose(rotation[arm], site.xmat.reshape(3, 3), atol=1e-9)
            (there,), (turned,) = flange_of(MOUNTS[arm], q[arm][None])
            np.testing.assert_allclose(there, site.xpos, atol=1e-9)
            np.testing.assert_allclose(turned, rotation[arm], atol=1e-9)
        np.testing.assert_allclose(frames.position_to_base(position_m), [each[0] for each in own], atol=1e-12)


def test_steps_of_the_tool_are_along_the_axes_of_the_cell():
    adapter = EnvSetup.resolve("SineTracking", {"action_mode": "tcp_delta", "cell": TILTED}).make_adapter()
    np.testing.assert_allclose(adapter._to_base, to_base(MOUNTS)[1], atol=1e-12)


def state_of(cell, q_rad=HOME):
    """State after half a second at rest."""
    simulated, open_m = MujocoCell(cell, 5), np.full((1, 5, 2), 0.05) if cell.equipment.grippers else None
    simulated.reset(Start(q_rad[None], gripper_m=None if open_m is None else open_m[:, 0]))
    command = Command(np.tile(q_rad, (1, 5, 1, 1)), open_m)
    for _ in range(12):
        state = simulated.advance(command).state
    return state


def test_a_rotated_plant_stays_tilted():
    turn = (0.01, -0.02)
    cell = dataclasses.replace(TILTED, perturbation=Perturbation(base_turn_rad=turn))
    true = tuple(dataclasses.replace(e, yaw_rad=e.yaw_rad + t) for e, t in zip(MOUNTS, turn, strict=True))
    found = state_of(cell)
    expected = Frames(true).position_to_cell(found.flange_base_m)
    np.testing.assert_allclose(found.flange_m, expected, atol=1e-9)
    assert np.abs(Frames(MOUNTS).position_to_cell(found.flange_base_m) - expected).max() > 0.005


def test_gravity_is_compensated_on_a_tilted_base():
    np.testing.assert_allclose(state_of(TILTED).q_rad[0], HOME, atol=1e-6)


def test_an_object_on_the_table_lies_level():
    frames, rng = Frames(MOUNTS), np.random.default_rng(2)
    true = Poses(np.tile([0.1, 0.05, 0.03], (2, 1)), np.tile(quat_from_rotvec([0.0, 0.0, 0.4]), (2, 1)))
    noise = quat_from_rotvec(rng.normal(0.0, 0.002, (2, 3)) * [1.0, 1.0, 0.0])
    seen = Poses(
        frames.position_to_base(np.add(true.position_m, (0.0, 0.0, 0.004))),
        frames.quat_to_base(quat_multiply(noise, true.quat)),
    )
    found = on_table(seen, MOUNTS, 0.03)
    np.testing.assert_allclose(frames.position_to_cell(found.position_m), true.position_m, atol=1e-12)
    np.testing.assert_allclose(quat_to_matrix(frames.quat_to_cell(found.quat)), quat_to_matrix(true.quat), atol=2e-5)


def test_an_empty_gripper_at_rest_feels_nothing():
    equipment, felt = Equipment(grippers=True), []
    q_rad = HOME + np.array([[0.0, 0.1, -0.2, 0.4, 0.5, 0.3]])
    for mounts in (LEVEL, MOUNTS):
        cell = CellConfig(left=mounts[0], right=mounts[1], equipment=equipment)
        felt.append(np.abs(state_of(cell, q_rad).wrench).max())
    assert felt[0] < 1e-3
    assert felt[1] < 1e-3


def test_a_recording_keeps_the_tilt():
    assert [_mount(_plain_mount(each)) for each in MOUNTS] == [*MOUNTS]


def test_shoulders_of_the_handover_are_those_of_the_arms():
    task = EnvSetup.resolve("Handover", {"cell": TILTED}).make_task()
    expected = Frames(MOUNTS).position_to_cell(np.array([[0.0, 0.0, mount.model.d_m[0]] for mount in MOUNTS]))
    np.testing.assert_allclose(task._goals.to_block.others[0, 3:, :3], expected, atol=1e-12)
