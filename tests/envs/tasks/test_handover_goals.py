"""Goals of both tools of a handover: those that agents observe are those that the reward leads to."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.assets.gripper import TCP_M
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.handover.goals import BACK_M
from dual_ur10.envs.tasks.handover.settings import MEETING_M, presented_quat
from dual_ur10.kinematics.frames import Frames
from dual_ur10.kinematics.rotations import quat_multiply, quat_to_matrix


def begun(seeds=(0,), **keywords):
    core = Core("Handover", keywords, n=len(seeds))
    observation, _ = core.reset([np.random.default_rng(seed) for seed in seeds])
    return core, observation


def own_fields(core, observation):
    """Return what agents observe by its names, with the measured joints in place of the commanded ones."""
    both = observation.copy()
    arms = core.task.layout.split(both)
    arms["commanded_q_rad"][...] = arms["q_rad"]
    own = core.task.observe_agents(both)
    layout = core.task.agent_layout_for(core.task.settings)
    return {name: own[..., layout.indices([name])] for name in layout.names}


@pytest.mark.parametrize("giver", ["left", "right"])
def test_agents_observe_the_goals_of_the_reward(giver):
    core, observation = begun((0, 1), giver=giver)
    script, passed, closing = policies.load("scripted", "DualUR10/Handover-v0", giver=giver), set(), set()
    roles = [0, 1] if giver == "left" else [1, 0]
    while True:
        step = core.step(np.asarray(script(observation), dtype=np.float32))
        observation = step.observation
        if step.terminated.any() or step.truncated.any():
            break
        fields, facts = own_fields(core, observation), core.task._stages.facts
        passed.add(int(step.info["stage"][0]))
        closing.add(tuple(facts[0, 8:10]))
        near_m, near = fields["nearness"][..., 0], fields["nearness"][..., 1]
        left_m, turn = 0.01 * (1.0 / near_m - 1.0), 0.03 * (1.0 / near - 1.0)
        move = 1.0 - np.minimum(left_m, 1.0) + 0.5 * (0.03 / (0.03 + left_m) + 0.3 / (0.3 + left_m))
        rotation = 1.0 - 0.5 * turn + 0.5 * (0.2 / (0.2 + turn) + 1.0 / (1.0 + turn))
        assert np.allclose(0.25 * (move + rotation)[:, roles], facts[:, 6:8], rtol=0, atol=1e-6)
        assert np.array_equal(fields["between"][:, roles, 0], facts[:, :2])
        assert np.array_equal(1.0 - fields["goal_opening"][:, roles, 0], facts[:, 8:10])
    assert passed == set(range(8))
    assert len(closing) == 4


def test_goals_at_the_start_are_above_the_grip_and_at_home():
    core, observation = begun(range(8), giver="random")
    fields, state = own_fields(core, observation), core._state
    rows, giver = np.arange(8), core.task._giver
    tool = state.flange_m + quat_to_matrix(state.flange_quat)[..., 2] * TCP_M
    frames = Frames((core.task.cell.left, core.task.cell.right))
    assert np.allclose(frames.position_to_cell(fields["flange_base_m"]), state.flange_m, atol=1e-6)
    assert np.abs(fields["goal_step_m"][rows, 1 - giver]).max() < 2e-3
    assert np.abs(fields["goal_turn"][rows, 1 - giver]).max() < 0.02
    goal = (tool + fields["goal_step_m"])[rows, giver]
    away = goal - state.object_m
    assert np.linalg.norm(away[:, :2], axis=1).max() < 0.07  # half of the block
    assert (away[:, 2] > 0.02).all()
    assert (away[:, 2] < BACK_M + 0.05).all()
    assert (fields["goal_opening"] == 1.0).all()


@pytest.mark.parametrize("giver", [0, 1])
@pytest.mark.parametrize(("turned_rad", "found_m"), [(0.0, 0.0), (0.6, 0.1 * 2.0 * np.sin(0.3))])
def test_a_rotated_block_is_not_presented(giver, turned_rad, found_m):
    core, _ = begun(giver=["left", "right"][giver])
    core.step(np.zeros((1, 14), dtype=np.float32))
    turn = np.array([np.cos(turned_rad / 2), 0.0, 0.0, np.sin(turned_rad / 2)])
    core.cell._physics._handling._object[0] = [*MEETING_M, *quat_multiply(turn, presented_quat(giver))]
    core.step(np.zeros((1, 14), dtype=np.float32))
    assert core.task._stages.facts[0, 11] == pytest.approx(found_m, abs=0.015)  # it falls for a moment
