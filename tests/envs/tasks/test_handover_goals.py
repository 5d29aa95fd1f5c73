"""Goals of both tools of a handover: those that are observed are those that the reward leads to."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.geometry import flanges_of
from dual_ur10.envs.tasks.handover.settings import APPROACH_M, GRIPS, MEETING_M, laid_quat, presented_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, length
from ur_core.kinematics.rotations import quat_conjugate, quat_multiply, quat_to_matrix
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL


def begun(seeds=(0,), **keywords):
    core = Core("Handover", keywords, n=len(seeds))
    observation, _ = core.reset([np.random.default_rng(seed) for seed in seeds])
    return core, observation


def fields_of(core, state=None, commanded_q_rad=None):
    """Return what is observed of a state, by its names, with the measured joints as the commanded ones."""
    state = core._state if state is None else state
    commanded = state.q_rad if commanded_q_rad is None else commanded_q_rad
    return core.task.layout.split(core.task.observe(state, core.task.measure(state), commanded))


def goals_now(core, measured):
    """Return the goals of the grippers, (n, 2), the steps, and grips between fingers, of the reward of this instant."""
    steps, closes = core.task._goals(measured.now, measured.grasped)
    return np.array(closes).T, steps, measured.grasped.between


@pytest.mark.parametrize("giver", ["left", "right"])
def test_the_goals_of_the_reward_are_observed(giver):
    core, observation = begun((0, 1), giver=giver)
    script, passed, closing = policies.load("scripted", "DualUR10/Handover-v0", giver=giver), set(), set()
    while True:
        step = core.step(np.asarray(script(observation), dtype=np.float32))
        observation = step.observation
        if step.terminated.any() or step.truncated.any():
            break
        fields = fields_of(core)
        measured = core.task.measure(core._state)
        found, steps, between = goals_now(core, measured)
        passed.add(int(step.info["stage"][0]))
        closing.add(tuple(map(bool, found[0])))
        near_m, near = fields["goal_closeness"][..., 0], fields["goal_closeness"][..., 1]
        left_m, turn = 0.01 * (1.0 / near_m - 1.0), 0.03 * (1.0 / near - 1.0)
        move = 1.0 - np.minimum(left_m, 1.0) + 0.5 * (0.03 / (0.03 + left_m) + 0.3 / (0.3 + left_m))
        rotation = 1.0 - 0.5 * turn + 0.5 * (0.2 / (0.2 + turn) + 1.0 / (1.0 + turn))
        assert np.allclose(0.25 * (move + rotation), steps.nearness, rtol=0, atol=1e-6)
        assert np.array_equal(fields["between"][..., 0], between)
        assert np.array_equal(1.0 - fields["goal_opening"][..., 0], found)
    assert passed == set(range(8))
    assert len(closing) == 4


def test_goals_at_the_start_are_above_the_grip_and_at_home():
    core, _ = begun(range(8), giver="random")
    fields, state = fields_of(core), core._state
    rows, giver = np.arange(8), core.task.first
    tool = state.flange_m + quat_to_matrix(state.flange_quat)[..., 2] * TOOL.tcp_m
    frames = Frames((core.task.cell.left, core.task.cell.right))
    assert np.allclose(frames.position_to_cell(fields["flange_base_m"]), state.flange_m, atol=1e-6)
    assert np.abs(fields["goal_step_m"][rows, 1 - giver]).max() < 2e-3
    assert np.abs(fields["goal_rotation"][rows, 1 - giver]).max() < 0.02
    goal = (tool + fields["goal_step_m"])[rows, giver]
    away = goal - state.objects["block"].position_m
    assert np.linalg.norm(away[:, :2], axis=1).max() < 0.07  # half of the block
    assert (away[:, 2] > 0.02).all()
    assert (away[:, 2] < APPROACH_M + 0.05).all()
    assert (fields["goal_opening"] == 1.0).all()
    assert np.abs(fields["lag_saturated"]).max() < 1e-3  # the tools are where the commanded ones are
    assert np.abs(fields["lag_rotation_saturated"]).max() < 1e-3


@pytest.mark.parametrize("giver", [0, 1])
@pytest.mark.parametrize(("turned_rad", "found_m"), [(0.0, 0.0), (0.6, 0.1 * 2.0 * np.sin(0.3))])
def test_a_rotated_block_is_not_presented(giver, turned_rad, found_m):
    core, _ = begun(giver=["left", "right"][giver])
    core.step(np.zeros((1, 14), dtype=np.float32))
    turn = np.array([np.cos(turned_rad / 2), 0.0, 0.0, np.sin(turned_rad / 2)])
    block = core.cell._physics._props.objects["block"]
    block.position_m[0], block.quat[0] = MEETING_M, quat_multiply(turn, presented_quat(giver))
    core.step(np.zeros((1, 14), dtype=np.float32))
    now = core.task.measure(core._state).now
    assert now.off_m == pytest.approx(found_m, abs=0.015)  # it falls for a moment


LYING = Poses(np.array([0.02, 0.5, 0.02]), np.array([1.0, 0.0, 0.0, 0.0]))
TARGET = Poses(np.array([0.0, -0.5, 0.02]), np.array([np.cos(0.1), 0.0, 0.0, np.sin(0.1)]))
SHOWN = Poses(MEETING_M, presented_quat(0))
CARRIED = Poses(np.add(MEETING_M, (0.0, 0.0, 0.1)), presented_quat(0))
LAID = compose(TARGET, Poses(np.zeros(3), laid_quat(np.array(0.0))))
BEHIND = Poses(np.array([0.0, 0.0, -APPROACH_M]), np.array([1.0, 0.0, 0.0, 0.0]))
STAYS, UP = None, "up"
GIVER = Poses(np.add(GRIPS[0].position_m[0], (0.0, 0.0, 0.007)), GRIPS[0].quat[0])  # with room above the table
RECEIVER = Poses(GRIPS[0].position_m[1], GRIPS[0].quat[1])
WIDE, SHUT, BARELY = 0.085, 0.04, 0.046


def behind(grip):
    return compose(grip, BEHIND)


def goals_of(core, block, holders, widths):
    """Return poses of the goals in the cell frame, goals of the grippers, and commanded tools.

    Args:
        block: Pose of the block. `holders` are the arms whose tools are at their grips of it, with fingers as in
            `widths`; commanded joints, and other arms, are those of the start.
    """
    state = core._state
    position, quat = state.flange_m.copy(), state.flange_quat.copy()
    flanges = flanges_of(compose(Poses(*(np.stack([each, each]) for each in block)), GRIPS[0]))
    for arm in holders:
        position[0, arm], quat[0, arm] = flanges.position_m[arm], flanges.quat[arm]
    objects = {name: Poses(*(each[None] for each in pose)) for name, pose in (("block", block), ("target", TARGET))}
    held = state._replace(flange_m=position, flange_quat=quat, gripper_m=np.array([widths]), objects=objects)
    own = {name: value[0] for name, value in fields_of(core, held, state.q_rad).items()}
    at_home = Poses(state.flange_m[0], state.flange_quat[0])
    tools = compose(at_home, Poses(np.array([0.0, 0.0, TOOL.tcp_m]), np.array([1.0, 0.0, 0.0, 0.0])))
    half = own["goal_rotation"] / 2
    turn = np.concatenate([np.sqrt(1.0 - (half**2).sum(axis=1, keepdims=True)), half], axis=1)
    goals = Poses(tools.position_m + own["goal_step_m"], quat_multiply(turn, tools.quat))
    return goals, own["goal_opening"][:, 0], tools


@pytest.mark.parametrize(
    ("block", "holders", "widths", "expected", "opening"),
    [
        (LYING, (), (WIDE, WIDE), (compose(LYING, behind(GIVER)), STAYS), (1, 1)),  # pick
        (LYING, (0,), (SHUT, WIDE), (UP, STAYS), (0, 1)),  # lift
        (CARRIED, (0,), (SHUT, WIDE), (compose(SHOWN, GIVER), STAYS), (0, 1)),  # present
        (SHOWN, (0,), (SHUT, WIDE), (compose(SHOWN, GIVER), compose(SHOWN, behind(RECEIVER))), (0, 1)),  # take
        (SHOWN, (0, 1), (SHUT, SHUT), (compose(SHOWN, GIVER), compose(SHOWN, RECEIVER)), (1, 0)),  # release
        (SHOWN, (0, 1), (BARELY, SHUT), (compose(SHOWN, GIVER), compose(SHOWN, RECEIVER)), (1, 0)),
        (SHOWN, (0, 1), (WIDE, SHUT), (compose(SHOWN, behind(GIVER)), compose(SHOWN, RECEIVER)), (1, 0)),
        (SHOWN, (1,), (WIDE, SHUT), (compose(SHOWN, behind(GIVER)), compose(LAID, behind(RECEIVER))), (1, 0)),  # place
        (LAID, (), (WIDE, WIDE), (compose(SHOWN, behind(GIVER)), compose(LAID, behind(RECEIVER))), (1, 1)),  # leave
        (LAID, (1,), (WIDE, BARELY), (compose(SHOWN, behind(GIVER)), STAYS), (1, 1)),  # it opens first
    ],
)
def test_each_phase_has_its_goals(block, holders, widths, expected, opening):
    core, _ = begun(object_range_m=0.0)
    found, opens, tools = goals_of(core, block, holders, widths)
    for arm, goal in enumerate(expected):
        if goal is STAYS:
            goal = Poses(tools.position_m[arm], tools.quat[arm])
        elif goal is UP:
            goal = Poses(tools.position_m[arm] + [0.0, 0.0, 0.11], tools.quat[arm])
        assert length(found.position_m[arm] - goal.position_m) < 2e-3, arm  # arms sag at home
        assert np.abs((found.quat[arm] * goal.quat).sum()) > 1 - 1e-5, arm
    assert tuple(opens) == opening


def test_a_goal_half_a_turn_away_is_not_taken_for_reached():
    core, _ = begun()
    state = core._state
    half_turned = quat_multiply(state.flange_quat[0, 0], np.array([0.0, 0.0, 0.0, 1.0]))
    block = quat_multiply(half_turned, quat_conjugate(GRIPS[0].quat[0]))
    turned = state.objects["block"]._replace(quat=block[None])
    fields = fields_of(core, state._replace(objects={**state.objects, "block": turned}))
    assert np.linalg.norm(fields["goal_rotation"][0, 0]) == pytest.approx(2.0, abs=1e-6)
