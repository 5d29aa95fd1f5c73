"""Tools as data: what is made of them, different ones on both arms, tools of others, and refusals."""

import dataclasses
import importlib.metadata
import itertools
import json

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import dual_ur10  # noqa: F401 - registers the environments
from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import DEFAULT_TOOLS, HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.policies import load
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.recording.header import built as built_of
from dual_ur10.sim2real.recording.header import plain
from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.generic_140 import GENERIC_140
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85
from ur_core.tools.tool import Tool, tool_named

MIXED = GENERIC_140, ROBOTIQ_2F85

OWN_XML = """
<mujoco>
  <default><default class="visual"><geom rgba="0.2 0.2 0.8 1"/></default></default>
  <worldbody>
    <body name="gripper" gravcomp="1">
      <inertial mass="0.7" pos="0 0 0.05" diaginertia="0.002 0.002 0.001"/>
      <site name="wrench"/>
      <site name="tcp" pos="0 0 0.16"/>
      <geom type="cylinder" fromto="0 0 0.02 0 0 0.08" size="0.03"/>
      <body name="finger_1" gravcomp="1">
        <inertial mass="0.05" pos="0 0.01 0.13" diaginertia="5e-5 5e-5 1e-5"/>
        <joint name="finger_1_joint" type="slide" axis="0 1 0" range="0 0.05" armature="1"/>
        <geom name="pad_1" class="visual" type="box" pos="0 0.008 0.14" size="0.01 0.008 0.04" condim="4" priority="1"/>
      </body>
      <body name="finger_2" gravcomp="1">
        <inertial mass="0.05" pos="0 -0.01 0.13" diaginertia="5e-5 5e-5 1e-5"/>
        <joint name="finger_2_joint" type="slide" axis="0 -1 0" range="0 0.05" armature="1"/>
        <geom name="pad_2" class="visual" type="box" pos="0 -0.008 0.14" size="0.01 0.008 0.04" condim="4" priority="1"/>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="finger_1" body2="finger_2"/></contact>
  <equality><joint joint1="finger_1_joint" joint2="finger_2_joint"/></equality>
  <tendon><fixed name="opening"><joint joint="finger_1_joint" coef="1"/><joint joint="finger_2_joint" coef="1"/></fixed></tendon>
  <actuator><position name="gripper" tendon="opening" kp="20000" kv="220" ctrlrange="0 0.1"/></actuator>
</mujoco>
"""  # noqa: E501 - MJCF

OWN = dataclasses.replace(
    ROBOTIQ_2F85, name="own", tcp_m=0.16, stroke_m=0.1, mass_kg=0.8, pad_m=(0.02, 0.007, 0.04), mjcf=OWN_XML, visuals=""
)


def scene(tools, **equipment):
    return SceneSettings(equipment=Equipment(grippers=True, tools=tools, **equipment))


def body_points(model, data, body, corners):
    """Return the corners of the boxes of one body that may touch, in the flange's frame of its arm."""
    flange = data.site(f"{body.partition('/')[0]}/flange")
    for geom in np.flatnonzero(model.geom_bodyid == model.body(body).id):
        if model.geom_contype[geom]:
            points = data.geom_xpos[geom] + (corners * model.geom_size[geom]) @ data.geom_xmat[geom].reshape(3, 3).T
            yield (points - flange.xpos) @ flange.xmat.reshape(3, 3)


@pytest.mark.parametrize("tools", [DEFAULT_TOOLS, MIXED, MIXED[::-1]], ids=lambda each: each[0].name)
def test_gate_and_physics_agree_on_the_shape_of_each_tool(tools):
    model, measured = build_model(scene(tools)), build_collision_model(scene(tools))
    data, distances = mujoco.MjData(model), mujoco.MjData(measured)
    distances.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_kinematics(measured, distances)
    corners = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    outermost = []
    for share in (0.0, 0.5, 1.0):
        fingers = [[share * tool.stroke_m / 2] * 2 for tool in tools]
        data.qpos[:16] = np.concatenate([HOME_Q_RAD, fingers], axis=1).ravel()
        mujoco.mj_kinematics(model, data)
        for arm, tool in zip(ARMS, tools, strict=True):
            site = distances.site(f"{arm}/tcp").xpos
            np.testing.assert_allclose(data.site(f"{arm}/tcp").xpos, site, atol=1e-12)
            box = measured.geom(f"{arm}/fingers").size
            middle = tool.fingertip_m - box[2]
            for finger in ("finger_1", "finger_2"):
                for points in body_points(model, data, f"{arm}/{finger}", corners):
                    beyond = np.abs(points - (0.0, 0.0, middle)) - box
                    assert beyond.max() < 1e-9
                    outermost.append((arm, *(beyond.max(axis=0) > -1e-9)))
            palm, own = (each.geom(f"{arm}/palm") for each in (model, measured))
            np.testing.assert_array_equal(palm.size[:2], own.size[:2])
    for arm in ARMS:  # and the box is no larger than the fingers, in any direction
        assert np.any([reached for name, *reached in outermost if name == arm], axis=0).all()


def test_every_number_of_a_tool_reaches_the_model():
    model = build_model(scene(MIXED, grip_force_n=100.0))
    for arm, tool in zip(ARMS, MIXED, strict=True):
        assert model.body_subtreemass[model.body(f"{arm}/gripper").id] == pytest.approx(tool.mass_kg)
        servo = model.actuator(f"{arm}/gripper")
        assert servo.ctrlrange.tolist() == [0.0, tool.stroke_m]
        assert servo.forcerange.tolist() == [-100.0, 100.0]
        assert model.cam(f"{arm}/wrist").fovy[0] == 72


@pytest.mark.parametrize("tools", [MIXED, (OWN, GENERIC_140)], ids=["figures", "own MJCF"])
def test_a_handover_between_different_tools(tools):
    env = gym.make("DualUR10/Handover-v0", cell=CellConfig(tools=tools))
    policy = load("scripted", "DualUR10/Handover-v0", cell=CellConfig(tools=tools))
    observation, _ = env.reset(seed=0, options={MOVE_TO_START: True})
    layout = env.unwrapped.core.task.layout
    opened = layout.split(observation)["gripper_m"][:, 0]
    np.testing.assert_allclose(opened, [tool.stroke_m for tool in tools], atol=1e-3)
    for step in range(250):
        assert env.observation_space.contains(observation)
        observation, _, terminated, truncated, info = env.step(policy(observation))
        assert not terminated
        assert not truncated
        if step == 15:  # an action of 1 still means fully open
            np.testing.assert_allclose(layout.split(observation)["gripper_m"][:, 0], opened, atol=1e-3)
        if info["stage"] == 5:  # both hold the block
            break
    assert info["stage"] == 5
    widths = layout.split(observation)["gripper_m"][:, 0]
    np.testing.assert_allclose(widths, [0.04, 0.04], atol=1e-3)
    env.close()


@pytest.mark.parametrize("force_n", [(10.0, 40.0), (80.0, 125.0)])
def test_mounted_grippers_need_not_have_the_force_of_a_task_without_any(force_n):
    tools = dataclasses.replace(GENERIC_140, force_n=force_n), ROBOTIQ_2F85
    equipment = CellConfig(tools=tools, grippers_mounted=True).measured_scene.equipment
    assert (equipment.grippers, equipment.tools) == (True, tools)


def test_a_record_holds_tools():
    for tools in (("generic_140", "robotiq_2f85"), (OWN, GENERIC_140)):
        config = CellConfig(tools=tools)
        again = built_of(CellConfig, json.loads(json.dumps(plain(config))))
        assert again == config
        assert hash(again.equipment) == hash(config.equipment)


def test_short_fingers_have_a_capsule():
    short = dataclasses.replace(GENERIC_140, stroke_m=0.012, finger_thick_m=0.019)
    assert build_collision_model(scene((short, short))).geom("left/fingers_round").size[1] == 0.001


def test_a_tool_of_an_installed_package(monkeypatch):
    assert tool_named(f"{__name__}:OWN") is OWN
    entry = importlib.metadata.EntryPoint("own", f"{__name__}:OWN", "dual_ur10.tools")
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [entry] if group == entry.group else [])
    assert tool_named("own") is OWN
    assert CellConfig(tools=("own", "robotiq_2f85")).equipment.tools == (OWN, ROBOTIQ_2F85)
    for value, words in ((f"{__name__}:MIXED", "expected is a Tool"), ("no_such_module:TOOL", "cannot be loaded")):
        wrong = importlib.metadata.EntryPoint("own", value, "dual_ur10.tools")
        monkeypatch.setattr(importlib.metadata, "entry_points", lambda group, wrong=wrong: [wrong])
        with pytest.raises(SettingsError, match=words):
            tool_named("own")


def changed(**values):
    return lambda: dataclasses.replace(ROBOTIQ_2F85, **values)


def built(old, new):
    return lambda: build_model(scene((dataclasses.replace(OWN, mjcf=OWN_XML.replace(old, new)), ROBOTIQ_2F85)))


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (changed(name="a b"), SettingsError, "a tool is named 'a b'"),
        (changed(stroke_m=0.0), SettingsError, "stroke_m of the tool 'robotiq_2f85' is 0.0: it must be above 0"),
        (changed(tcp_m=np.nan), SettingsError, "tcp_m"),
        (changed(stroke_m=85), SettingsError, "is 85 m: allowed are 1e-05 to 1 m"),
        (changed(palm_half_m=1e-16), SettingsError, "palm_half_m .* is 1e-16 m: allowed are"),
        (changed(pad_m=(0.02, "thick", 0.04)), SettingsError, "pad_m"),
        (changed(pad_m=0.02), SettingsError, "pad_m of the tool 'robotiq_2f85' is 0.02: it must be 3 numbers"),
        (changed(speed_m_s=0.1), SettingsError, "speed_m_s .* it must be 2 numbers"),
        (changed(force_n=(20.0, 50.0, 80.0)), SettingsError, "force_n .* it must be 2 numbers"),
        (changed(stroke_m=(0.085, 0.085)), SettingsError, "stroke_m"),
        (changed(mjcf=3), SettingsError, "mjcf of the tool 'robotiq_2f85' is 3: it must be text"),
        (changed(drivers="robotiq"), SettingsError, "it must be a tuple of at least one kind"),
        (changed(drivers=()), SettingsError, "drivers"),
        (changed(drivers=("my_lab.grippers",)), SettingsError, "module:Class"),
        (changed(force_n=(50.0, 20.0)), SettingsError, "force_n .* write the least first"),
        (changed(tcp_m=0.05), SettingsError, "it must be beyond palm_m"),
        (changed(mass_kg=0.1), SettingsError, "more than that of both fingers"),
        (changed(finger_thick_m=0.005), SettingsError, "must be more"),
        (built("finger_2_joint", "other"), SettingsError, "has no joint 'finger_2_joint'"),
        (built("<geom", "<gem"), SettingsError, "mjcf of the tool 'own' is wrong"),
        (
            built('pos="0 0 0.16"', 'pos="0 0 0.15"'),
            SettingsError,
            r"site 'tcp' .* \(0, 0, 0.15\) m: .* \(0, 0, 0.16\)",
        ),
        (built('pos="0 0 0.16"', 'pos="0 0.01 0.16"'), SettingsError, r"site 'tcp' .* is at \(0, 0.01, 0.16\) m"),
        (built('"tcp" pos', '"tcp" euler="0 0 90" pos'), SettingsError, "site 'tcp' .* with the flange's axes"),
        (built('name="wrench"', 'name="wrench" pos="0 0 0.01"'), SettingsError, r"site 'wrench' .* at \(0, 0, 0\)"),
        (
            built('ctrlrange="0 0.1"', 'ctrlrange="0 0.2"'),
            SettingsError,
            "stroke_m of the tool 'own' is 0.1, and 0.2 in",
        ),
        (built('size="0.03"', 'size="0.06"'), SettingsError, "outside of palm and fingers as the safety gate knows"),
        (built("0.008 0.04", "0.008 0.06"), SettingsError, "geom 'pad_1' .* enlarge the tool's figures"),
        (lambda: tool_named("robotiq"), UnknownNameError, "did you mean 'robotiq_2f85'"),
        (lambda: tool_named(f"{__name__}:MIXED"), SettingsError, "MIXED is .*: expected is a Tool"),
        (
            lambda: tool_named("no_such_module:TOOL"),
            SettingsError,
            "the tool, 'no_such_module:TOOL', cannot be imported",
        ),
        (lambda: tool_named("a:b:c"), SettingsError, "cannot be imported"),
        (lambda: Equipment(tools=("robotiq_2f85",)), SettingsError, "the left and the right arm"),
        (lambda: Equipment(tools=(ROBOTIQ_2F85, 3)), SettingsError, "3 among the tools"),
        (lambda: Equipment(grippers=True, tools=MIXED, grip_force_n=200.0), SettingsError, "10 to 125 N, as the tool"),
        (
            lambda: CellConfig(equipment=Equipment(tools=MIXED), tools=MIXED[::-1]),
            SettingsError,
            "needs the tools generic_140 and robotiq_2f85, and the cell has robotiq_2f85 and generic_140",
        ),
        (
            lambda: build_model(scene((dataclasses.replace(GENERIC_140, visuals="no:draw"), ROBOTIQ_2F85))),
            SettingsError,
            "visuals of the tool",
        ),
    ],
)
def test_bad_tools(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_tools_are_hashable_and_plain():
    for tool in (*MIXED, OWN):
        assert tool == Tool(**json.loads(json.dumps(dataclasses.asdict(tool))))
        assert hash(tool) == hash(dataclasses.replace(tool))
