"""Settings of the scene, its specs, its models and its visuals."""

import dataclasses
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.collision_model import build_collision_model, compose_collision_model
from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.assets.props import BAR, BAR_WELDS, BLOCK, TARGET
from dual_ur10.assets.scene import build_model, compose, sensor_slices
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings, default_mount
from dual_ur10.sim2real.cell.cell_config import CellConfig
from tests.model_hashes import HASHES, hash_of
from tests.sim2real.control.reference_cell import UNEQUAL, contacts, random_q
from ur_core.errors import MissingExtraError, SettingsError, UnknownNameError
from ur_core.kinematics.frames import ArmMount
from ur_core.mjcf.gains import Gains


def test_every_caller_gets_a_model_of_its_own():
    for build in (build_model, build_collision_model):
        model = build(SceneSettings())
        model.body_mass[:] = 0
        assert build(SceneSettings()).body_mass.sum() > 50


def test_specs_can_be_written_and_compiled_again():
    spec = compose(equipped())
    again = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert again.nbody == build_model(equipped()).nbody
    spec.body("left/gripper").add_geom(name="mine", size=(0.01, 0, 0))
    assert spec.compile().ngeom == build_model(equipped()).ngeom + 1


def test_positions_may_be_lists():
    settings = SceneSettings(left=ArmMount([-0.75, 0.6, 0]))
    assert settings == SceneSettings()
    assert hash(settings) == hash(SceneSettings())


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
        (lambda: SceneSettings(integrator="RK4"), UnknownNameError, "'implicitfast', 'Euler'"),
        (lambda: SceneSettings(integrator="Euler"), SettingsError, "up to 11.16, allowed are 2.2"),
        (lambda: SceneSettings(gains="stiff"), SettingsError, "'stiff': they must be Gains, such as STIFF"),
        (lambda: CellConfig(gains=[20000.0]), SettingsError, "must be Gains, such as STIFF and COMPLIANT"),
        (lambda: Gains((1.0,) * 5, (1.0,) * 6), SettingsError, "kp_nm_rad of gains must be 6 finite numbers"),
        (
            lambda: Gains((1.0,) * 6, (1.0,) * 5 + (0.0,)),
            SettingsError,
            "kv_nms_rad of gains .* must be 0.01 to 100000",
        ),
        (lambda: Gains((1e7,) * 6, (1.0,) * 6), SettingsError, "must be 0.01 to 1e\\+06"),
        (lambda: SceneSettings(table_size_m=(0.0, 1.0)), SettingsError, "table"),
        (lambda: SceneSettings(equipment=None), SettingsError, "Equipment"),
        (lambda: Equipment(props="ball"), SettingsError, "must be a tuple of Prop"),
        (lambda: Equipment(props=(BAR, BAR)), SettingsError, "two props have the name 'bar'"),
        (lambda: Equipment(grippers="yes"), SettingsError, "grippers must be True or False, found 'yes'"),
        (lambda: Equipment(grippers=True, props=(BLOCK,), welds=BAR_WELDS), SettingsError, "the props are block"),
        (lambda: Equipment(props=(BAR,), welds=BAR_WELDS), SettingsError, "grippers=False"),
        (lambda: Equipment(grip_force_n=19.9), SettingsError, "19.9: must be within 20 to 235 N"),
        (lambda: Equipment(grip_force_n=236), SettingsError, "236: must be within 20 to 235 N"),
        (lambda: Equipment(grip_force_n=np.nan), SettingsError, "finite"),
        (lambda: SceneSettings(left=ArmMount((-0.75, -0.4, 0.0))), SettingsError, "apart"),
        (lambda: SceneSettings(left=ArmMount((-0.45, 0.6, -0.1))), SettingsError, "inside the table"),
    ],
)
def test_bad_settings(make, error, match):
    with pytest.raises(error, match=match):
        make()


def test_a_base_may_stand_on_the_table():
    model = build_model(SceneSettings(left=ArmMount((-0.3, 0.6, 0.0))))
    assert not contacts(model, HOME_Q_RAD)


def test_meshes_are_visual_only():
    settings = SceneSettings(meshes=True)
    try:
        model = build_model(settings)
    except MissingExtraError as error:
        assert "example-robot-data" in str(error)  # noqa: PT017 - either outcome is a pass
        return
    assert model.nmesh == 7
    plain = build_model(SceneSettings())
    assert np.array_equal(model.body_mass, plain.body_mass)
    assert (model.geom_contype > 0).sum() == (plain.geom_contype > 0).sum()


def test_specs_name_no_file():
    assert "file=" not in compose(SceneSettings()).to_xml()


def equipped(**keywords):
    return SceneSettings(equipment=Equipment(grippers=True, **keywords))


def test_equal_equipment_hashes_alike():
    assert equipped(props=(BAR,), grip_force_n=60) == equipped(props=(BAR,), grip_force_n=np.float64(60.0))
    assert hash(equipped(grip_force_n=60)) == hash(equipped(grip_force_n=np.float32(60.0)))
    assert hash(Equipment(grip_force_n=np.array(60))) == hash(Equipment())
    assert SceneSettings() == SceneSettings(equipment=Equipment())


def test_a_bare_scene_has_no_parts_of_equipment():
    for text in (compose(SceneSettings()).to_xml(), compose_collision_model(SceneSettings()).to_xml()):
        for word in ("gripper", "finger", "wrench", "tendon", "equality", "impratio", "freejoint", "mocap"):
            assert word not in text


CELLS = {
    "default": SceneSettings(),
    "unequal": UNEQUAL,
    "grippers": dataclasses.replace(UNEQUAL, equipment=Equipment(grippers=True)),
    "bar": equipped(props=(BAR,)),
    "block": equipped(props=(BLOCK, TARGET)),
    "welded": equipped(props=(BAR,), welds=BAR_WELDS),
    "bar alone": SceneSettings(equipment=Equipment(props=(BAR,))),
    "obstacles": dataclasses.replace(
        equipped(),
        obstacles=(
            Box(name="box", position_m=(0.1, 0.3, 0.5), size_m=(0.3, 0.5, 0.2), rotation_rad=(0.4, -0.3, 0.8)),
            Capsule(name="post", from_m=(-0.2, 0.0, 0.0), to_m=(-0.2, 0.1, 1.2), radius_m=0.05),
            Plane(name="wall", point_m=(0.6, 0.0, 0.0), normal=(-1.0, 0.0, 0.0)),
        ),
    ),
}


@pytest.fixture(scope="module", params=CELLS.values(), ids=list(CELLS))
def with_and_without_visuals(request):
    return build_model(request.param), build_model(request.param, visuals=False)


def test_a_model_without_visuals_has_solid_geoms_only(with_and_without_visuals):
    visual, bare = with_and_without_visuals
    solid = (bare.geom_contype > 0) | (bare.geom_conaffinity > 0)
    assert solid.all()
    names = [bare.geom(i).name for i in range(bare.ngeom)]
    assert set(names) == {visual.geom(i).name for i in range(visual.ngeom) if visual.geom_contype[i]}
    assert (bare.ncam, bare.nlight, bare.ntex) == (0, 0, 0)


def test_a_model_without_visuals_has_the_same_state(with_and_without_visuals):
    visual, bare = with_and_without_visuals
    full = mujoco.mjtState.mjSTATE_INTEGRATION
    assert mujoco.mj_stateSize(visual, full) == mujoco.mj_stateSize(bare, full)
    for size in ("nq", "nv", "na", "nu", "nbody", "nsensordata", "nmocap", "neq", "ntendon"):
        assert getattr(visual, size) == getattr(bare, size)
    assert sensor_slices(visual) == sensor_slices(bare)


def touching(model, data):
    rows = [
        (*sorted((model.geom(c.geom1).name, model.geom(c.geom2).name)), c.dist, *c.pos, c.dim, *c.friction)
        for c in data.contact
    ]
    return sorted(rows)


def test_a_model_without_visuals_has_the_same_dynamics(with_and_without_visuals):
    rng = np.random.default_rng(6)
    touched = 0
    pairs = [(model, mujoco.MjData(model)) for model in with_and_without_visuals]
    for q in random_q(rng, 200):
        first = with_and_without_visuals[0]
        v, goal = rng.normal(size=first.nv), rng.normal(0, 0.01, first.nu)
        found = []
        for model, data in pairs:
            mujoco.mj_resetData(model, data)
            fingers = (model.nu - 12) // 2 * 2
            data.qpos[: 12 + 2 * fingers] = np.pad(q, ((0, 0), (0, fingers)), constant_values=0.02).ravel()
            data.qvel[:] = v
            data.ctrl[:] = np.pad(q, ((0, 0), (0, fingers // 2)), constant_values=0.05).ravel() + goal
            mujoco.mj_forward(model, data)
            forces = (data.qfrc_bias, data.qfrc_gravcomp, data.qfrc_actuator, data.qfrc_constraint, data.qacc)
            found.append((data.M.copy(), *(force.copy() for force in forces), data.sensordata.copy()))
            found[-1] += (touching(model, data),)
        *numbers, contacts_ = zip(*found, strict=True)
        for visual, bare in numbers:
            np.testing.assert_allclose(bare, visual, rtol=1e-9, atol=1e-9)
        touched += len(contacts_[0])
        assert [row[:2] for row in contacts_[0]] == [row[:2] for row in contacts_[1]]
        for visual, bare in zip(*contacts_, strict=True):
            np.testing.assert_allclose(bare[2:], visual[2:], rtol=1e-9, atol=1e-9)
    assert touched > 100


ALL_CELLS = CELLS | {
    "UR3e and UR20": SceneSettings(default_mount(0, "ur3e"), default_mount(1, "ur20"), timestep_s=0.001),
}


@pytest.mark.parametrize("name", ALL_CELLS)
def test_models_are_what_they_were(name):
    settings = ALL_CELLS[name]
    models = build_model(settings), build_model(settings, visuals=False), build_collision_model(settings)
    assert tuple(map(hash_of, models)) == HASHES[name]
