"""Scene without a task: its objects, its observations, and that nothing ends it."""

import sys

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.assets.prop import Prop
from dual_ur10.envs import parallel_env
from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core.kinematics.frames import Frames

FREE = "DualUR10/Free-v0"
CUP = """<mujoco><worldbody><body name="cup" pos="0.2 -0.3 0.05"><freejoint/>
<geom type="cylinder" size="0.03 0.05" mass="0.2"/></body></worldbody></mujoco>"""
POST = """<mujoco><worldbody><body name="post" pos="0.4 0 0.05"><geom type="box" size="0.02 0.02 0.05"/></body>
</worldbody></mujoco>"""


def made(**keywords):
    return gym.make(FREE, disable_env_checker=True, **keywords)


def fields(env, observation):
    return env.unwrapped.core.task.layout.split(observation)


def test_nothing_is_to_be_done_and_nothing_ends():
    env = made()
    assert env.spec.max_episode_steps is None
    env.reset(seed=0)
    for _ in range(20):
        observation, reward, terminated, truncated, info = env.step(np.zeros(14, np.float32))
        assert env.observation_space.contains(observation)
        assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, False, False)
    limited = made(max_episode_steps=2)
    limited.reset(seed=0)
    limited.step(np.zeros(14, np.float32))
    assert limited.step(np.zeros(14, np.float32))[3]


def test_a_motion_that_the_gate_refuses_ends_it_only_on_demand():
    down = np.array([0, 1, 0, 0, 0, 0, 1] * 2, np.float32)
    for keywords, ends in (({}, False), ({"on_refusal": "terminate"}, True)):
        env = made(at_limits="refuse", **keywords)
        env.reset(seed=0)
        rewards, terminated = [], False
        for _ in range(60):
            _, reward, terminated, _, info = env.step(down)
            rewards.append(reward)
            if terminated or "safety" in info:
                break
        assert "safety" in info
        assert terminated is ends
        assert rewards[-1] == (0.0 if ends else -1.0)


@pytest.mark.parametrize(
    ("objects", "names"),
    [(("block", "bar"), ["block", "bar"]), ("bar", ["bar"]), ((), []), (["block"], ["block"])],
)
def test_objects_lie_on_the_table_and_are_observed_by_name(objects, names):
    env = made(objects=objects)
    first, other = (fields(env, env.reset(seed=seed)[0]) for seed in (0, 1))
    found = [name.removesuffix("_base_m") for name in first if name.endswith("_base_m") and "flange" not in name]
    assert found == names
    frames = Frames((env.unwrapped.core.config.left, env.unwrapped.core.config.right))
    for name in names:
        in_cell = frames.position_to_cell(first[f"{name}_base_m"])
        np.testing.assert_allclose(in_cell[0], in_cell[1], atol=1e-9)
        assert in_cell[0, 2] == pytest.approx(0.02, abs=1e-4)
        assert np.abs(first[f"{name}_base_m"] - other[f"{name}_base_m"]).max() > 1e-3


def test_the_bar_has_the_same_place_in_every_row():
    one, many = made(objects="bar"), gym.make_vec(FREE, 3, vectorization_mode="vector_entry_point", objects="bar")
    observation, _ = one.reset(seed=5)
    np.testing.assert_array_equal(many.reset(seed=[3, 5, 7])[0][1], observation)


def test_props_of_ones_own_are_where_their_text_has_them(tmp_path, monkeypatch):
    (tmp_path / "my_cups.py").write_text(
        f"from dual_ur10.assets.prop import Prop\nCUP = Prop(name='cup', mjcf='''{CUP}''')\nNO_PROP = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    cup = Prop(name="cup", mjcf=CUP)
    for given in (cup, "my_cups:CUP"):
        env = made(objects=("block", given, Prop(name="post", mjcf=POST)))
        observed = fields(env, env.reset(seed=0)[0])
        assert "post_base_m" not in observed  # it stands still
        frames = Frames((env.unwrapped.core.config.left, env.unwrapped.core.config.right))
        np.testing.assert_allclose(frames.position_to_cell(observed["cup_base_m"])[1], [0.2, -0.3, 0.05], atol=1e-3)
    with pytest.raises(SettingsError, match="is int: it must be a Prop"):
        made(objects=("my_cups:NO_PROP",))
    sys.modules.pop("my_cups")


@pytest.mark.parametrize(
    ("objects", "error", "message"),
    [
        (("blok",), UnknownNameError, r"object 'blok' \(did you mean 'block'\?\)"),
        ((3,), UnknownNameError, "object '3'"),
        (("block", "block"), SettingsError, "two props have the name 'block'"),
        (5, SettingsError, "several in a tuple"),
        (("no_module:CUP",), SettingsError, "cannot be imported"),
    ],
)
def test_wrong_objects_are_named(objects, error, message):
    with pytest.raises(error, match=message):
        made(objects=objects)


def test_two_agents_observe_their_halves():
    env = parallel_env(FREE)
    observations, _ = env.reset(seed=0)
    assert {name: len(values) for name, values in observations.items()} == {"left": 47, "right": 47}
    env.close()
