"""Cameras as data: of the cell, of environments, props and tools; where they are in the model and in the images."""

import dataclasses

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.prop_part import PropPart
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import Equipment, SceneSettings
from dual_ur10.assets.visuals import CAMERAS, cameras
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.evaluation.film import stills, take
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import rotate
from ur_core.mjcf.camera import Camera
from ur_core.tools.generic_140 import GENERIC_140
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85

CASE = """<mujoco><compiler angle="degree"/><worldbody><body mocap="true" pos="0.1 0.3 0.02">
    <geom type="box" size=".1 .1 .02"/><body name="lid" pos="-.1 0 .03"><joint name="lid" axis="0 -1 0" range="0 90"/>
    <geom type="box" size=".1 .1 .005" pos=".1 0 0" mass="0.2"/></body></body></worldbody></mujoco>"""
EYE = Camera("eye", (0.1, 0.02, 0.1), (0.1, 0.0, 0.0), 60.0, body="lid")
SIDE = Camera("side", (0.0, 0.2, 0.1), (0.0, 0.0, 0.15), up=(-1.0, 0.0, 0.0))
TOOLS = dataclasses.replace(GENERIC_140, cameras=(SIDE,)), ROBOTIQ_2F85
NUMBERS = st.floats(-2.0, 2.0)
POINT = st.tuples(NUMBERS, NUMBERS, NUMBERS)


def scene(**equipment):
    return SceneSettings(equipment=Equipment(**equipment))


def case(*views):
    return Prop(name="case", mjcf=CASE, cameras=views)


@settings(max_examples=100)
@given(POINT, POINT, st.none() | POINT)
def test_a_camera_faces_its_target_with_up_upwards(position, target, up):
    view = np.subtract(target, position)
    assume(np.linalg.norm(view) > 1e-3)
    if up is not None:
        assume(np.linalg.norm(np.cross(view, up)) > 1e-3 * np.linalg.norm(view) * max(np.linalg.norm(up), 1e-3))
    x, y = np.reshape(Camera("it", position, target, up=up).axes, (2, 3))
    np.testing.assert_allclose([x @ x, y @ y, x @ y], [1.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(-np.cross(x, y), view / np.linalg.norm(view), atol=1e-6)
    assert abs(x @ (up or (0.0, 0.0, 1.0))) < 1e-6 or up is None
    assert y @ (up or (1.0, 0.0, 1.0)) > -1e-9 or up is None


def test_a_camera_of_a_prop_moves_with_its_body():
    settings_ = scene(props=(case(EYE, Camera("top", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))),))
    assert cameras(settings_) == (*CAMERAS, "case/eye", "case/top")
    model = build_model(settings_)
    data, part = mujoco.MjData(model), PropPart(settings_.equipment.props[0], "lid")
    data.mocap_pos[0], data.mocap_quat[0] = (0.2, -0.1, 0.3), np.array([0.8, 0.0, 0.0, 0.6])
    data.joint("case/lid").qpos[0] = 0.7
    mujoco.mj_forward(model, data)
    lid = part(1, {"case": Poses(data.mocap_pos[:1], data.mocap_quat[:1])}, {"lid": np.array([0.7])})
    seen = data.camera("case/eye")
    np.testing.assert_allclose(seen.xpos, compose(lid, Poses(np.array(EYE.position_m), np.eye(4)[0]))[0][0], atol=1e-9)
    forward = rotate(lid.quat[0], np.subtract(EYE.target_m, EYE.position_m))
    np.testing.assert_allclose(-seen.xmat.reshape(3, 3)[:, 2], forward / np.linalg.norm(forward), atol=1e-9)
    assert model.camera("case/eye").fovy[0] == 60.0
    assert model.ncam == len(cameras(settings_))
    assert build_model(settings_, visuals=False).ncam == 0


def test_a_camera_of_a_tool_is_in_the_frame_of_its_flange():
    settings_ = scene(grippers=True, tools=TOOLS)
    assert cameras(settings_) == (*CAMERAS, "left/wrist", "left/side", "right/wrist")
    model = build_model(settings_)
    data = mujoco.MjData(model)
    data.qpos[:16] = np.linspace(-1.0, 1.0, 16)
    mujoco.mj_forward(model, data)
    flange, camera = data.site("left/flange"), data.camera("left/side")
    axes = flange.xmat.reshape(3, 3)
    np.testing.assert_allclose(camera.xpos, flange.xpos + axes @ SIDE.position_m, atol=1e-9)
    assert camera.xmat.reshape(3, 3)[:, 1] @ axes[:, 0] < -0.99
    assert not {"left/wrist", "left/side"} & {*cameras(scene())}  # nothing carries them


@pytest.mark.parametrize("cell", ["mujoco", "echo"])
def test_an_environment_takes_cameras_of_ones_own(cell):
    mine = Camera("mine", (0.6, 0.5, 0.5), (0.0, 0.5, 0.1))
    palm = Camera("palm", (-0.15, 0.0, 0.05), (0.0, 0.0, 0.2), 60.0, body="right/gripper", up=(0.0, 0.0, -1.0))
    size = {"width": 48, "height": 40, "duration_s": 0.2, "cell": cell}
    env = gym.make(
        "DualUR10/Handover-v0", observation="pixels", cameras=(mine, "front", palm), camera=palm,
        render_mode="rgb_array", **size,
    )  # fmt: skip
    observation, _ = env.reset(seed=0)
    assert {*observation} == {"mine", "front", "palm"} == {*env.observation_space}
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(env.render(), observation["palm"])
    assert min(np.std(image) for image in observation.values()) > 10
    kept = take(env, lambda _: np.zeros(14, dtype=np.float32), seed=0)
    (picture,) = stills(kept, [0.0], cameras=("mine", "palm"), width=48, height=40)
    assert picture.shape == (40, 96, 3)
    env.close()
    if cell == "mujoco":
        keywords = {"observation": "pixels", "cameras": (mine, "front", palm), **size}
        envs = gym.make_vec("DualUR10/Handover-v0", num_envs=2, **keywords)
        images, _ = envs.reset(seed=0)
        np.testing.assert_array_equal(images["palm"][0], observation["palm"])
        envs.close()


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: case(dataclasses.replace(EYE, body="lit")), UnknownNameError, "'case': 'lit'|case.*'lit'.*lid"),
        (lambda: case(EYE, EYE), SettingsError, "two cameras of the prop 'case' are named 'eye'"),
        (lambda: dataclasses.replace(GENERIC_140, cameras=(SIDE, SIDE)), SettingsError, "two cameras of the tool"),
        (lambda: Equipment(cameras=(SIDE, SIDE)), SettingsError, "two cameras of the scene are named 'side'"),
        (lambda: Equipment(cameras=("front",)), SettingsError, "must be a tuple of Camera"),
        (lambda: Equipment(cameras=SIDE), SettingsError, "must be a tuple of Camera"),
        (lambda: build_model(scene(cameras=(SIDE,))), SettingsError, "two cameras of the cell are named 'side'"),
        (
            lambda: build_model(scene(grippers=True, tools=(dataclasses.replace(GENERIC_140, cameras=(EYE,)),) * 2)),
            UnknownNameError,
            "body of the camera 'left/eye'.*'left/lid'",
        ),
        (lambda: Camera("1", (0, 0, 1), (0, 0, 0)), SettingsError, "a letter first"),
        (lambda: Camera("a", (0, 0, 1), (0, 0, 1)), SettingsError, "the points must differ"),
        (lambda: Camera("a", (0, 0, 1), (0, 0, 0), up=(0, 0, 2)), SettingsError, "must not be along its view"),
        (lambda: Camera("a", (0, 0, 1), (0, 0, 0), up=(0, 0, 0)), SettingsError, "or 0"),
        (lambda: Camera("a", (0, 0, float("nan")), (0, 0, 0)), SettingsError, "position_m of the camera 'a'"),
        (lambda: Camera("a", (0, 0, 1), (0, 0, 0), body=3), SettingsError, "name of a body"),
    ],
)
def test_cameras_that_clash_or_hang_on_nothing_are_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"cameras": Camera("a", (0, 0, 1), (0, 0, 0), body="left/grip")}, UnknownNameError, "'left/gripper'"),
        ({"camera": Camera("front", (0, 0, 1), (0, 0, 0))}, SettingsError, "two cameras of the cell are named 'front'"),
        ({"cameras": (SIDE, "side")}, SettingsError, "each once"),
        ({"cameras": (3,)}, SettingsError, "3 is no camera: name one"),
        (
            {"cameras": Camera("a", (0, 0, 1), (0, 0, 0)), "camera": Camera("a", (0, 1, 1), (0, 0, 0))},
            SettingsError,
            "two cameras of the scene are named 'a'",
        ),
    ],
)
def test_an_environment_refuses_them_before_anything_is_made(keywords, error, words):
    with pytest.raises(error, match=words):
        EnvSetup.resolve("Handover", {"cell": CellConfig(), **keywords})
