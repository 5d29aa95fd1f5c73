"""Goals of both tools of a carry: what is observed of them follows from the measured poses."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.geometry import APPROACH_M, flanges_of, frame_of
from dual_ur10.envs.tasks.sync_carry.goals import CarryGoals
from dual_ur10.envs.tasks.sync_carry.path import CarryPath
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, length
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

CARRY = "DualUR10/SyncCarry-v0"
SAME = np.array([1.0, 0.0, 0.0, 0.0])
BAR = Poses(np.array([0.01, -0.02, 0.02]), quat_from_rotvec(np.array([0.0, 0.0, 0.04])))
AHEAD = Poses(np.array([0.05, 0.1, 0.2]), quat_from_rotvec(np.array([0.1, -0.2, 0.3])))
WIDE, SHUT, BARELY = 0.085, 0.04, 0.046
ROOM_M = 0.013


def grips(rigid=False):
    """Return the goals of both tools in the bar's frame."""
    found = CarrySettings(grasp="rigid" if rigid else "friction").grip
    return Poses(found.position_m + np.array([0.0, 0.0, 0.0 if rigid else ROOM_M]), found.quat)


def away(pose, move_m=(0.0, 0.0, 0.0), turn_rad=(0.0, 0.0, 0.0)):
    """Return both tools that grip a bar, moved and rotated in their own frames."""
    return compose(compose(Poses(*(np.stack([each] * 2) for each in pose)), grips()), _step(move_m, turn_rad))


def _step(move_m, turn_rad):
    return Poses(np.array(move_m), quat_from_rotvec(np.array(turn_rad)))


class Ahead:
    """Path with a reference now and another one ahead, at all times."""

    def __init__(self, path, now, ahead):
        self.duration_s, self.references = path.duration_s, (now, ahead)

    def __call__(self, time_s, start):
        return Poses(*(np.stack(each)[None] for each in zip(*self.references, strict=True)))


def observed(tools, width_m, ahead, bar=BAR, **keywords):
    """Return the fields of both arms, (2, ...), for tools that are where they were commanded to be."""
    core = Core("SyncCarry", keywords, n=1)
    core.reset([np.random.default_rng(0)])
    task, state = core.task, core._state
    mounts = task.cell.left, task.cell.right
    frames, flanges = Frames(mounts), flanges_of(tools)
    position, quat = frames.position_to_base(flanges.position_m), frames.quat_to_base(flanges.quat)
    commanded = [
        nearest(position[arm], quat_to_matrix(quat[arm]), state.q_rad[0, arm], mount.dh)
        for arm, mount in enumerate(mounts)
    ]
    state = state._replace(
        flange_m=flanges.position_m[None],
        flange_quat=flanges.quat[None],
        gripper_m=None if width_m is None else np.full((1, 2), width_m),
        objects={"bar": Poses(*(each[None] for each in bar))},
    )
    task._path = Ahead(task._path, bar, ahead)
    fields = task.layout.split(task.observe(state, task.measure(state), np.array([commanded])))
    return {name: value[0] for name, value in fields.items()}


def goals_of(tools, fields):
    half = fields["goal_rotation"] / 2
    turn = np.concatenate([np.sqrt(1.0 - (half**2).sum(axis=1, keepdims=True)), half], axis=1)
    return Poses(tools.position_m + fields["goal_step_m"], quat_multiply(turn, tools.quat))


def assert_same(found, expected):
    assert length(found.position_m - expected.position_m).max() < 1e-6
    assert np.abs((found.quat * expected.quat).sum(axis=1)).min() > 1.0 - 1e-9


@pytest.mark.parametrize(
    ("move_m", "turn_rad", "back_m"),
    [
        ((0.0, 0.0, -0.05), (0.0, 0.0, 0.0), 0.0),  # on the line: straight to the grip
        ((0.02, 0.0, -0.05), (0.0, 0.0, 0.0), 0.02),  # 1.5 times what it is beside the line, less 10 mm
        ((0.0, 0.0, -0.05), (0.0, 0.0, 0.3), 0.1 * 2.0 * np.sin(0.15) - 0.01),
        ((0.2, 0.0, -0.05), (0.0, 0.0, 0.0), APPROACH_M),  # at most
    ],
)
def test_an_open_gripper_comes_from_behind_its_grip(move_m, turn_rad, back_m):
    tools = away(BAR, move_m, turn_rad)
    fields = observed(tools, WIDE, BAR)
    assert_same(goals_of(tools, fields), away(BAR, (0.0, 0.0, -back_m)))
    assert (fields["goal_opening"] == 1.0).all()
    left_m = 0.01 * (1.0 / fields["goal_closeness"][:, 0] - 1.0)
    assert left_m == pytest.approx(length(fields["goal_step_m"]) + back_m, abs=1e-6)


def test_a_gripper_that_holds_the_bar_follows_its_reference():
    tools = away(BAR, (0.003, 0.0, 0.002))
    fields = observed(tools, SHUT, AHEAD)
    assert_same(goals_of(tools, fields), away(AHEAD))
    assert (fields["goal_opening"] == 0.0).all()
    assert (fields["between"] == 1.0).all()


@pytest.mark.parametrize(
    ("above_m", "width_m", "opens"),
    [
        (0.009, WIDE, False),
        (0.011, WIDE, True),
        (0.011, BARELY, False),  # fingers that have begun to close go on
        (0.031, BARELY, True),
    ],
)
def test_fingers_close_where_they_have_arrived(above_m, width_m, opens):
    fields = observed(away(BAR, (0.0, 0.0, -above_m)), width_m, BAR)
    assert (fields["goal_opening"] == opens).all()
    assert fields["opening"] == pytest.approx(np.full((2, 1), width_m / WIDE))


def test_welded_grippers_follow_the_reference_without_fields_of_fingers():
    at = Poses(*(np.stack([each] * 2) for each in BAR))
    tools = compose(compose(at, grips(rigid=True)), Poses(np.array([0.02, 0.0, 0.0]), SAME))
    fields = observed(tools, None, AHEAD, grasp="rigid")
    ahead = Poses(*(np.stack([each] * 2) for each in AHEAD))
    assert_same(goals_of(tools, fields), compose(ahead, grips(rigid=True)))
    assert not {"between", "opening", "goal_opening"} & set(fields)
    left_m = 0.01 * (1.0 / fields["goal_closeness"][:, 0] - 1.0)
    assert left_m == pytest.approx(length(fields["goal_step_m"]), abs=1e-6)


@pytest.mark.parametrize("grasp", ["friction", "rigid"])
def test_the_reward_leads_to_the_goals_that_are_observed(grasp):
    """Term "reach", computed from the fields of tools where they are and of the reference now."""
    core = Core("SyncCarry", {"grasp": grasp}, n=2)
    observation, _ = core.reset([np.random.default_rng(seed) for seed in (0, 1)])
    script, task = policies.load("scripted", CARRY, grasp=grasp), copy.deepcopy(core.task)
    task._when = np.zeros(2)  # the reference ahead is that of now
    reached, opened, closing = [], set(), set()
    for _ in range(180):
        step = core.step(script(observation))
        observation = step.observation
        state = core._state
        fields = task.layout.split(task.observe(state, task.measure(state), state.q_rad))
        near_m, near = np.moveaxis(fields["goal_closeness"], -1, 0)
        left_m, turn = 0.01 * (1.0 / near_m - 1.0), 0.03 * (1.0 / near - 1.0)
        move = 1.0 - left_m + 0.5 * (0.03 / (0.03 + left_m) + 0.3 / (0.3 + left_m))
        nearness = (0.25 * (move + 1.0 - 0.5 * turn + 0.5 * (0.2 / (0.2 + turn) + 1.0 / (1.0 + turn)))) ** 2
        grasped = np.ones((2, 2))
        if grasp == "friction":
            wide = fields["opening"][..., 0] * WIDE
            opens = fields["goal_opening"][..., 0] == 1.0
            nearness[opens] *= (0.8 + 0.2 * np.clip((wide - 0.04) / 0.045, 0.0, 1.0))[opens]
            holds = np.abs(wide - 0.04) < 0.001
            grasped = np.where(holds, 1.0, np.where(opens, 0.0, 0.5 * (1.0 - np.abs(wide - 0.04) / 0.045)))
            opened.add(bool(opens.all()))
            closing.update(((grasped > 0.0) & (grasped < 1.0)).ravel().tolist())
        assert step.info["reward/reach"] == pytest.approx(nearness.mean(axis=1), abs=1e-6)
        assert step.info["reward/grasp"] == pytest.approx(grasped.mean(axis=1), abs=1e-6)
        reached.append(nearness.mean())
    assert step.info["clock_s"].min() > 2.0 - (grasp == "rigid") * 1.0
    if grasp == "friction":
        assert reached[0] < 0.9 < reached[-1]
        assert opened == closing == {True, False}


def test_the_saturated_step_and_lag_are_those_of_the_commanded_tool():
    core = Core("SyncCarry", {"action_mode": "tcp_delta"}, n=1)
    observation, _ = core.reset([np.random.default_rng(0)])
    for _ in range(3):
        observation = core.step(np.full((1, 14), 0.5, dtype=np.float32)).observation
    fields, state = core.task.layout.split(observation[0]), core._state
    step = fields["goal_step_m"]
    assert fields["goal_step_saturated"] == pytest.approx(step / (0.01 + np.linalg.norm(step, axis=1, keepdims=True)))
    lag = fields["lag_saturated"]
    lag_m = 0.01 * lag / (1.0 - np.linalg.norm(lag, axis=1, keepdims=True))
    assert np.abs(lag_m).max() > 1e-3
    measured = state.flange_m[0] + quat_to_matrix(state.flange_quat[0])[..., 2] * TOOL.tcp_m
    goal = measured + lag_m + step  # of a tool beside the bar: above its grip
    assert (goal[:, 2] > 0.02).all()
    assert goal[:, 1] == pytest.approx([0.5, -0.5], abs=0.03)


def test_the_observed_speed_is_that_of_the_grips_on_the_reference():
    settings, ahead_s = CarrySettings(path_speed=True), 1e-4
    goals = CarryGoals(1, settings, SceneSettings().mounts)
    begin = Poses(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    for time_s in (1.0, 13.3, 20.1, 24.0):
        bars = CarryPath(30.0)(np.array([[time_s, time_s, time_s + ahead_s]]), begin)
        linear, angular = goals.speeds(SimpleNamespace(frames=frame_of(bars)), ahead_s)
        grips = compose(Poses(bars.position_m[0, :, None], bars.quat[0, :, None]), settings.grip).position_m
        np.testing.assert_allclose(linear[0], (grips[2] - grips[1]) / ahead_s, atol=1e-9)
        turn = quat_multiply(bars.quat[0, 2], bars.quat[0, 1] * [1, -1, -1, -1])
        np.testing.assert_allclose(angular[0], np.tile(2.0 * turn[1:] / ahead_s, (2, 1)), atol=1e-6)
        assert np.abs(linear).max() + np.abs(angular).max() > 0.01
