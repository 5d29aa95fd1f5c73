"""Bar and block: initial poses, and grippers that lift and hold them."""

import itertools

import mujoco
import numpy as np
import pytest

from dual_ur10.assets import props
from dual_ur10.assets.props import (
    BAR,
    BAR_LENGTH_M,
    BAR_MASS_KG,
    BAR_WELDS,
    BAR_WIDTH_M,
    BLOCK,
    BLOCK_MASS_KG,
    BLOCK_SIZE_M,
    GRIP_DISTANCE_M,
    TARGET,
)
from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from tests.sim2real.control.reference_cell import angle, site_pose
from ur_core import kinematics
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, NOMINAL_DH
from ur_core.mjcf.gains import COMPLIANT
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

SIZES = {BAR: (BAR_WIDTH_M, BAR_LENGTH_M, BAR_WIDTH_M), BLOCK: BLOCK_SIZE_M}
STEPS = np.linspace(0.0, 0.1, 51)  # m, heights of a lift


def configurations(settings, arm, tcp_m, quat):
    """Return joint positions (n, 6) that bring the tcp to points (n, 3) in the cell, with one orientation."""
    orientation = quat_to_matrix(np.array(quat))
    flange = np.asarray(tcp_m) - orientation[:, 2] * TOOL.tcp_m - settings.mounts[arm].position_m
    position, rotation = kinematics.to_base_link(flange, orientation)
    return np.array([kinematics.nearest(each, rotation, HOME_Q_RAD[arm], NOMINAL_DH) for each in position])


class Rig:
    """The cell in plain MuJoCo, arms on their position servos."""

    def __init__(self, settings):
        self.settings = settings
        self.model = build_model(settings, visuals=False)
        self.data = mujoco.MjData(self.model)

    def place(self, paths, opening):
        for arm in (0, 1):
            self.data.qpos[8 * arm : 8 * arm + 8] = *paths[arm][0], opening / 2, opening / 2
            self.data.ctrl[7 * arm : 7 * arm + 7] = *paths[arm][0], opening
        mujoco.mj_forward(self.model, self.data)

    def run(self, seconds):
        mujoco.mj_step(self.model, self.data, round(seconds / self.model.opt.timestep))

    def follow(self, paths, seconds):
        n = round(seconds / self.model.opt.timestep)
        for u in np.linspace(0, 1, n):
            at = u * u * (3 - 2 * u) * (len(STEPS) - 1)
            for arm in (0, 1):
                for joint in range(6):
                    self.data.ctrl[7 * arm + joint] = np.interp(at, range(len(STEPS)), paths[arm][:, joint])
            mujoco.mj_step(self.model, self.data)

    def in_gripper(self, arm, place):
        """Return the pose (4, 4) of a site or body in the gripper."""
        mujoco.mj_kinematics(self.model, self.data)
        gripper = site_pose(self.data, f"{arm}/tcp")
        thing = np.eye(4)
        named = self.data.body(place) if place == "block/block" else self.data.site(place)
        thing[:3, :3], thing[:3, 3] = named.xmat.reshape(3, 3), named.xpos
        return np.linalg.inv(gripper) @ thing


def slip_m(before, after):
    return np.linalg.norm(after[:3, 3] - before[:3, 3])


@pytest.mark.parametrize("force_n", [20.0, 60.0])
def test_a_gripper_lifts_the_block_and_holds_it(force_n):
    rig = Rig(SceneSettings(timestep_s=0.002, equipment=Equipment(True, (BLOCK,), grip_force_n=force_n)))
    rig.data.qpos[16:19] = 0.0, 0.3, 0.02
    points = np.array([[0.0, 0.3, 0.025 + height] for height in STEPS])
    paths = [configurations(rig.settings, 0, points, props.BLOCK_GRIP_QUAT), np.tile(HOME_Q_RAD[1], (len(STEPS), 1))]
    rig.place(paths, 0.06)
    assert (
        angle(rig.in_gripper("left", "block/block")[:3, :3], quat_to_matrix(np.array(props.BLOCK_GRIP_QUAT)).T) < 1e-6
    )
    rig.run(0.1)
    rig.data.ctrl[6] = 0.0
    rig.run(0.5)
    start, height = rig.in_gripper("left", "block/block"), rig.data.body("block/block").xpos[2]
    rig.follow(paths, 1.5)
    rig.run(2.0)
    end = rig.in_gripper("left", "block/block")
    assert rig.data.body("block/block").xpos[2] - height == pytest.approx(0.1, abs=0.002)
    assert slip_m(start, end) < 1e-4
    assert angle(start[:3, :3], end[:3, :3]) < 2e-4
    assert rig.data.qpos[6] + rig.data.qpos[7] == pytest.approx(BLOCK_SIZE_M[1], abs=2e-4)


def test_two_grippers_lift_the_bar_and_hold_it():
    settings = SceneSettings(timestep_s=0.001, equipment=Equipment(True, (BAR,), grip_force_n=120.0))
    rig = Rig(settings)
    paths = [
        configurations(settings, arm, [[0.0, y, 0.025 + height] for height in STEPS], props.GRIP_QUAT)
        for arm, y in ((0, 0.5), (1, -0.5))
    ]
    rig.place(paths, 0.06)
    rig.run(0.1)
    rig.data.ctrl[[6, 13]] = 0.0
    rig.run(0.5)
    starts, height = [rig.in_gripper(arm, f"bar/{arm}_grip") for arm in ARMS], rig.data.body("bar/bar").xpos[2]
    rig.follow(paths, 1.5)
    rig.run(2.0)
    assert rig.data.body("bar/bar").xpos[2] - height == pytest.approx(0.1, abs=0.004)
    for arm, start in zip(ARMS, starts, strict=True):
        assert slip_m(start, rig.in_gripper(arm, f"bar/{arm}_grip")) < 2e-4
    # Both wrists together carry the bar, which quivers by some thousandths: by how much depends on the processor.
    slices = sensor_slices(rig.model)
    carried = sum(
        (rig.data.site(f"{arm}/wrench").xmat.reshape(3, 3) @ rig.data.sensordata[slices[f"{arm}/wrench_force"]])[2]
        for arm in ARMS
    )
    assert carried == pytest.approx((BAR_MASS_KG + 2 * TOOL.mass_kg) * 9.81, rel=5e-3)


@pytest.fixture(params=[0.001, 0.002])
def welded(request):
    settings = SceneSettings(timestep_s=request.param, gains=COMPLIANT, equipment=Equipment(True, (BAR,), BAR_WELDS))
    rig = Rig(settings)
    rig.data.qpos[16:19] = 0.0, 0.0, 0.12
    paths = [
        configurations(settings, arm, [[0.0, y, 0.12 + height] for height in STEPS], props.GRIP_QUAT)
        for arm, y in ((0, 0.5), (1, -0.5))
    ]
    rig.place(paths, 0.04)
    return rig, paths


def test_welded_grippers_stay_still(welded):
    rig, _ = welded
    rig.model.body_gravcomp[rig.model.body("bar/bar").id] = 1.0  # so that nothing moves at all
    q = rig.data.qpos.copy()
    speed = 0.0
    for _ in range(500):
        mujoco.mj_step(rig.model, rig.data)
        speed = max(speed, np.abs(rig.data.qvel).max())
    assert np.abs(rig.data.qpos - q).max() < 1e-6
    assert speed < 1e-4
    assert rig.data.ncon == 0


def test_welded_grippers_carry_the_bar(welded):
    rig, paths = welded
    rig.follow(paths, 1.5)
    rig.run(0.5)
    assert rig.data.body("bar/bar").xpos[2] == pytest.approx(0.22, abs=0.008)  # soft gains, and no payload set
    for arm in ARMS:
        pose = rig.in_gripper(arm, f"bar/{arm}_grip")
        assert np.linalg.norm(pose[:3, 3]) < 2e-5
        assert angle(pose[:3, :3], np.eye(3)) < 2e-4
    names = {rig.model.geom(g).name for contact in rig.data.contact for g in contact.geom}
    assert not names


@pytest.mark.parametrize(("prop", "grippers"), list(itertools.product((BAR, BLOCK), (False, True))))
def test_a_prop_does_not_move_from_its_initial_pose(prop, grippers):
    model = build_model(SceneSettings(equipment=Equipment(grippers, (prop,))))
    data = mujoco.MjData(model)
    first = 16 if grippers else 12
    arms = np.pad(HOME_Q_RAD, ((0, 0), (0, 2 * grippers)))
    data.qpos[:first] = arms.ravel()
    data.ctrl[:] = np.pad(HOME_Q_RAD, ((0, 0), (0, int(grippers)))).ravel()
    size = 2 * model.geom(f"{prop.name}/{prop.name}").size
    assert data.qpos[first:].tolist() == [0, 0, size[2] / 2, 1, 0, 0, 0]
    assert size.tolist() == list(SIZES[prop])
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos[first : first + 3] - [0, 0, size[2] / 2]).max() < 1e-4
    assert np.abs(data.qvel[-6:]).max() < 1e-6


def test_the_masses_of_the_props():
    for prop, mass in ((BAR, BAR_MASS_KG), (BLOCK, BLOCK_MASS_KG)):
        for visuals in (False, True):
            model = build_model(SceneSettings(equipment=Equipment(props=(prop,))), visuals=visuals)
            body = model.body(prop.body)
            assert body.mass[0] == mass
            x, y, z = SIZES[prop]
            moments = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
            axes = np.zeros(9)
            mujoco.mju_quat2Mat(axes, body.iquat)
            axes = axes.reshape(3, 3)
            assert axes @ np.diag(body.inertia) @ axes.T == pytest.approx(np.diag(moments), abs=1e-12)


def test_grips_of_the_bar():
    model = build_model(SceneSettings(equipment=Equipment(props=(BAR,))))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for arm, y in (("left", 0.5), ("right", -0.5)):
        pose = site_pose(data, f"bar/{arm}_grip")
        assert pose[:3, 3] == pytest.approx([0, y, BAR_WIDTH_M / 2])
        # The tool points down and its fingers open across the bar.
        assert pose[:3, :3] == pytest.approx(np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]]), abs=1e-12)
    assert GRIP_DISTANCE_M == 1.0


def test_from_home_only_wrist_3_moves_to_the_grips():
    down = quat_to_matrix(np.array(props.BLOCK_GRIP_QUAT))
    data = mujoco.MjData(model := build_model(SceneSettings()))
    data.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_forward(model, data)
    for arm in ARMS:
        assert angle(site_pose(data, f"{arm}/flange")[:3, :3], down) < 1e-6
    data.qpos[[5, 11]] -= np.pi / 2
    mujoco.mj_forward(model, data)
    for arm in ARMS:
        assert angle(site_pose(data, f"{arm}/flange")[:3, :3], quat_to_matrix(np.array(props.GRIP_QUAT))) < 1e-6


def test_the_target_is_visual_only():
    for visuals in (False, True):
        model = build_model(SceneSettings(equipment=Equipment(props=(BLOCK, TARGET))), visuals=visuals)
        target = model.body(TARGET.body)
        assert (model.nmocap, target.mocapid[0]) == (1, 0)
        geoms = np.flatnonzero(model.geom_bodyid == target.id)
        assert len(geoms) > 0 if visuals else len(geoms) == 0
        assert not model.geom_contype[geoms].any()
        assert not model.geom_conaffinity[geoms].any()
    assert build_model(SceneSettings(equipment=Equipment(props=(BAR,)))).nmocap == 0
