"""Props of one's own: MJCF with what other layers need of it, in the model, the state and the collision model."""

from __future__ import annotations

import pickle

import mujoco
import numpy as np
import pytest

from dual_ur10 import CellConfig
from dual_ur10.assets.collision_model import build_collision_model, clearance_pairs
from dual_ur10.assets.prop import HeldCapsule, Prop
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import Equipment, SceneSettings, home_q_rad
from dual_ur10.assets.visuals import cameras
from dual_ur10.envs.core.randomization import Randomization, apply_sample
from dual_ur10.envs.core.sensing import Sensing
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.control.adapter import Command
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.mjcf.camera import Camera
from ur_core.mjcf.gains import STIFF

PEG = Prop(
    name="peg",
    mjcf="""<mujoco><asset><material name="red" rgba="1 0 0 1"/></asset><worldbody><body name="stick" pos="0 0 0.05">
    <freejoint/><geom name="tip" type="box" size=".01 .01 .05" mass=".1" material="red"/>
    <geom type="box" size=".011 .011 .01" material="red" group="2" contype="0" conaffinity="0"/>
    </body></worldbody></mujoco>""",
    held=(HeldCapsule((0, 0, -0.03), (0, 0, 0.03), 0.012), None),
    noise=2.0,
    mass=0.5,
)
CASE = Prop(
    name="case",
    mjcf="""<mujoco><compiler angle="degree"/><worldbody><body mocap="true" pos="0.1 0.3 0.02">
    <geom type="box" size=".1 .1 .02"/><body name="lid" pos="-.1 0 .03">
    <joint name="lid" type="hinge" axis="0 -1 0" range="0 90" damping="0.1"/>
    <geom type="box" size=".1 .1 .005" pos=".1 0 0" mass="0.2"/></body></body></worldbody></mujoco>""",
)
SHELF = Prop(
    name="shelf",
    mjcf='<mujoco><worldbody><body pos="0.3 0 0.1"><geom type="box" size=".05 .05 .1"/></body></worldbody></mujoco>',
)
SCENE = Equipment(grippers=True, props=(PEG, CASE, SHELF), cameras=(Camera("hole", (0.5, 0.2, 0.4), (0.1, 0.3, 0.0)),))


def xml(body="<freejoint/><geom size='.01' mass='.1'/>", rest="", attributes=""):
    return f"<mujoco>{rest}<worldbody><body {attributes}>{body}</body></worldbody></mujoco>"


@pytest.fixture(scope="module")
def config():
    return CellConfig(equipment=SCENE, timestep_s=0.002, gains=STIFF)


def scene_of(equipment):
    return build_model(SceneSettings(equipment=equipment))


def start_of(config, n, **values):
    return Start(np.tile(home_q_rad((config.left, config.right)), (n, 1, 1)), np.full((n, 2), 0.08), **values)


def test_free_placed_fixed_and_articulated_props():
    assert (PEG.free, PEG.placed, PEG.tracked, PEG.joints, PEG.body) == (True, False, True, (), "peg/stick")
    assert (CASE.free, CASE.placed, CASE.tracked, CASE.joints, CASE.body) == (False, True, True, ("lid",), "case/body")
    assert (SHELF.free, SHELF.placed, SHELF.tracked, SHELF.posed) == (False, False, False, False)
    assert pickle.loads(pickle.dumps(SCENE)) == SCENE
    assert hash(SCENE) == hash(pickle.loads(pickle.dumps(SCENE)))


def test_a_spec_is_as_good_as_its_text():
    spec = mujoco.MjSpec.from_string(PEG.mjcf)
    again = Prop(name="peg", mjcf=spec)
    models = [build_model(SceneSettings(equipment=Equipment(props=(each,)))) for each in (PEG, again)]
    assert models[0].body("peg/stick").mass == models[1].body("peg/stick").mass
    assert np.array_equal(models[0].geom_size, models[1].geom_size)


def test_what_is_drawn_only_has_no_effect_on_the_simulation(config):
    drawn, bare = (build_model(config.scene, visuals=visuals) for visuals in (True, False))
    assert drawn.ngeom > bare.ngeom
    assert drawn.nq == bare.nq
    assert np.array_equal(drawn.body("peg/stick").inertia, bare.body("peg/stick").inertia)
    assert bare.geom("peg/tip").solref[0] == 0.004  # as stiff as the physics step allows
    soft = build_model(SceneSettings(equipment=Equipment(props=(Prop(name="peg", mjcf=PEG.mjcf, rigid=False),))))
    assert soft.geom("peg/tip").solref[0] == 0.02
    assert np.allclose(bare.joint("case/lid").range, [0, np.pi / 2])  # degrees, as its own compiler has them


def test_poses_and_joints_are_in_the_state_by_name(config):
    n = 3
    cell = MujocoCell(config, 5, n=n)
    peg = np.tile([0.1, -0.2, 0.2, 1.0, 0.0, 0.0, 0.0], (n, 1))
    peg[:, 0] += [0.0, 0.01, 0.02]
    case = np.tile([0.2, 0.25, 0.02, 1.0, 0.0, 0.0, 0.0], (n, 1))
    begun = cell.reset(start_of(config, n, objects={"peg": peg, "case": case}, joints={"lid": np.full(n, 0.7)})).state
    assert list(begun.objects) == ["peg", "case"]
    assert np.array_equal(np.concatenate(begun.objects["peg"], axis=1), peg)
    assert np.array_equal(np.concatenate(begun.objects["case"], axis=1), case)
    assert begun.joints["lid"].tolist() == [0.7] * n
    for _ in range(25):
        state = cell.advance(Command(np.tile(home_q_rad((config.left, config.right)), (n, 5, 1, 1)), None)).state
    assert np.allclose(state.objects["peg"].position_m[:, 2], 0.05, atol=1e-3)  # it fell on the table
    assert (state.joints["lid"] < 0.5).all()
    again = cell.reset(start_of(config, 1), np.array([1])).state  # what a start leaves out is as in the MJCF
    assert again.objects["peg"].position_m[1].tolist() == [0, 0, 0.05]
    assert again.objects["peg"].position_m[0, 0] == state.objects["peg"].position_m[0, 0]
    assert (again.joints["lid"][1], again.objects["case"].position_m[1, 0]) == (0.0, 0.1)
    with pytest.raises(UnknownNameError, match=r"unknown prop that is placed.* 'shelf': use one of 'peg', 'case'"):
        cell.reset(start_of(config, n, objects={"shelf": peg}))
    with pytest.raises(UnknownNameError, match=r"unknown joint.* 'door'.* use one of 'lid'"):
        cell.reset(start_of(config, n, joints={"door": np.zeros(n)}))
    cell.close()


def test_each_measured_object_has_errors_of_its_own(config):
    chosen = Randomization(object_noise_m=0.01, object_noise_rad=0.02, object_mass=0.3)
    sensing = Sensing(config, chosen, 0.04, 2)
    assert sensing.tracked == ("peg", "case")
    sampled = chosen.sample([np.random.default_rng(seed) for seed in (0, 1)], len(sensing.tracked))
    cell = MujocoCell(config, 5, n=2, varied=chosen.varied)
    plant = config.perturbation.expanded(2)
    state = cell.reset(start_of(config, 2), perturbation={**plant, **apply_sample(plant, sampled)}).state
    sensing.reset(state, np.arange(2), [0, 1], sampled)
    seen = sensing.begun(state)
    errors = {name: seen.objects[name].position_m - state.objects[name].position_m for name in sensing.tracked}
    assert np.allclose(errors["peg"], 2.0 * sampled["object_offset_m"][:, 0])  # its noise is twice that of others
    assert np.allclose(errors["case"], sampled["object_offset_m"][:, 1])
    batch = cell._physics._batch
    mass = batch.expand("body_mass")[:, batch.model.body("peg/stick").id]
    assert np.allclose(mass, 0.1 * (1 + 0.5 * (sampled["object_mass_scale"] - 1)))  # varies half as much
    one = chosen.sample([np.random.default_rng(0)])
    assert np.array_equal(one["object_offset_m"][0, 0], sampled["object_offset_m"][0, 0])
    cell.close()


def test_the_gate_measures_what_a_gripper_may_hold(config):
    pairs = clearance_pairs(config.scene)
    held = {first for first, _ in pairs if "held" in first}
    assert held == {"left/held_peg"}
    model = build_collision_model(config.scene)
    geom = model.geom("left/held_peg")
    assert geom.size[:2].tolist() == [0.012, 0.03]
    assert model.nsensor == len(pairs)


def test_cameras_of_a_scene(config):
    assert cameras(config.scene)[-1] == "hole"
    assert build_model(config.scene).camera("hole").pos.tolist() == [0.5, 0.2, 0.4]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"name": "left"}, "none of left, right"),
        ({"name": "my peg"}, "use letters, digits and _"),
        ({"mjcf": "<mujoco"}, "is no XML"),
        ({"mjcf": 3}, "must be MJCF text or a MjSpec"),
        ({"mjcf": "<robot/>"}, "<robot> at its root"),
        ({"mjcf": xml(rest="<actuator/>")}, "has <actuator>"),
        ({"mjcf": "<mujoco><worldbody/></mujoco>"}, "has nothing in its worldbody"),
        ({"mjcf": "<mujoco><worldbody><body/><body/></worldbody></mujoco>"}, "has <body>, <body> in its worldbody"),
        ({"mjcf": xml("<freejoint/><freejoint/>")}, "has 2 free joints"),
        ({"mjcf": xml("<body><freejoint/></body>")}, "or one below its body"),
        ({"mjcf": xml(attributes="mocap='true'")}, "free joint and mocap"),
        ({"mjcf": xml("<joint/>")}, "without a name"),
        ({"mjcf": xml("<body><camera name='eye'/></body>")}, "has a <camera> in its MJCF: leave it out"),
        ({"mjcf": xml("<joint name='a' type='ball'/>")}, "of the type ball: use hinge or slide"),
        ({"mjcf": xml("<joint name='a'/>", "<default><joint type='ball'/></default>")}, "type of joints in a default"),
        ({"noise": -1.0}, "noise of the prop 'peg' is -1"),
        ({"mass": float("nan")}, "must be 1 finite number"),
        ({"held": (None,)}, "each HeldCapsule or None"),
    ],
)
def test_bad_props_are_refused(values, text):
    with pytest.raises(SettingsError, match=text):
        Prop(**{"name": "peg", "mjcf": xml(), **values})


@pytest.mark.parametrize(
    ("mjcf", "text"),
    [
        (xml("<freejoint/>"), "'peg' cannot be compiled: mass and inertia of moving bodies"),
        (xml("<freejoint/><geom size='.1' mass='0'/>"), "'peg' cannot be compiled: mass and inertia"),
        (xml("<geom type='mesh' mesh='a'/>", "<asset><mesh name='a' file='/nowhere.obj'/></asset>"), "nowhere.obj"),
        (xml("<geom type='heart' size='1'/>"), "the MJCF of the prop 'peg' is refused: .*heart"),
        (xml("<geom name='a' size='1'/><geom name='a' size='1'/>"), "repeated name"),
    ],
)
def test_what_mujoco_refuses_is_named(mjcf, text):
    equipment = Equipment(props=(SHELF, Prop(name="peg", mjcf=mjcf)))
    with pytest.raises(SettingsError, match=text):
        build_model(SceneSettings(equipment=equipment))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: HeldCapsule((0, 0, 0), (0, 0, 9), 0.1), "within 2 m of the tool"),
        (lambda: HeldCapsule((0, 0), (0, 0, 0), 0.1), "must be 3 finite numbers"),
        (lambda: HeldCapsule((0, 0, 0), (0, 0, 0), 0.0), "above 0"),
        (lambda: Camera("my cam", (0, 0, 1), (0, 0, 0)), "use letters, digits and _"),
        (lambda: Camera("c", (0, 0, 1), (0, 0, 1)), "must differ"),
        (lambda: Equipment(props=(PEG, PEG)), "two props have the name 'peg'"),
        (lambda: Equipment(props=(CASE, Prop(name="box", mjcf=CASE.mjcf))), "two props have the joint 'lid'"),
        (lambda: Equipment(True, (PEG,), (("left/tcp", "bar/x"),)), "the props are peg"),
        (
            lambda: build_model(SceneSettings(equipment=Equipment(True, (PEG,), (("left/tcp", "peg/x"),)))),
            "no prop has",
        ),
    ],
)
def test_bad_scenes_are_refused(make, text):
    with pytest.raises(SettingsError, match=text):
        make()
