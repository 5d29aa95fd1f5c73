"""Gripper servos: latency, speed, yielding at obstacles, and refusals."""

import numpy as np
import pytest

from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.sim.handling import LATENCY_S, GripperServos
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.adapter import Command
from tests.envs.sim.test_mujoco_cell import home
from ur_core.tools.generic_140 import GENERIC_140
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

TICKS = 5


def cell(n=1, **equipment):
    config = CellConfig(equipment=Equipment(grippers=True, **equipment))
    made = MujocoCell(config, TICKS, n=n)
    made.reset(Start(home(n), np.full((n, 2), TOOL.stroke_m)))
    return made


def command(left, right, n=1, **more):
    opening = np.tile([left, right], (n, TICKS, 1))
    return Command(np.repeat(home(n)[:, None], TICKS, axis=1), opening, **more)


def test_the_fingers_move_at_their_speed_after_the_latency():
    made = cell()
    opening = np.array([made.advance(command(0.0, TOOL.stroke_m)).state.gripper_m[0].copy() for _ in range(30)])
    time = 0.04 * np.arange(1, 31)
    assert np.abs(opening[:, 1] - TOOL.stroke_m).max() < 1e-5
    assert np.abs(opening[time <= LATENCY_S - 0.008, 0] - TOOL.stroke_m).max() < 1e-5
    moving = (opening[:, 0] < 0.07) & (opening[:, 0] > 0.02)
    assert np.allclose(np.diff(opening[moving, 0]) / 0.04, -TOOL.speed_m_s[1], rtol=0.02)
    assert opening[-1, 0] < 1e-4
    arrival = time[np.argmax(opening[:, 0] < 0.001)]
    assert arrival == pytest.approx(LATENCY_S + TOOL.stroke_m / TOOL.speed_m_s[1], abs=0.06)


def test_the_reference_waits_for_blocked_fingers():
    tools, slack_m = (TOOL, GENERIC_140), np.array([0.005, 0.003])
    servos = GripperServos(1, TICKS, 0.008, 4, slack_m, tools)
    held = np.full((1, 2), 0.04)
    for _ in range(60):
        reference = servos(np.zeros((1, TICKS, 2)), held)
    assert reference.shape == (1, TICKS * 4, 2)
    # Within a period it advances by at most its speed.
    ahead_m = slack_m + [tool.speed_m_s[1] * 0.04 for tool in tools]
    assert np.all(reference >= 0.04 - ahead_m - 1e-12)
    np.testing.assert_allclose(reference[0, -1], 0.04 - ahead_m, atol=1e-12)
    opened = np.broadcast_to([tool.stroke_m for tool in tools], (1, TICKS, 2))
    for _ in range(3):
        servos(opened, held)
    assert (servos(opened, held)[0, -1] > 0.04).all()  # they open at once
    with pytest.raises(ActionError, match=r"gripper left .* 0 to 0.085 m"):
        servos(np.full((1, TICKS, 2), 0.14), held)


def test_an_opening_beyond_the_stroke_is_refused():
    made = cell(n=2)
    for value in (-0.001, 0.09, np.nan):
        wrong = command(TOOL.stroke_m, TOOL.stroke_m, n=2)
        wrong.gripper_m[1, 3, 1] = value
        with pytest.raises(ActionError, match=r"right.*cell 1.*0.085"):
            made.advance(wrong)
    bare = MujocoCell(CellConfig(), TICKS)
    bare.reset(Start(home()))
    with pytest.raises(SettingsError, match="grippers"):
        bare.advance(command(0.0, 0.0))


def test_a_declared_payload_is_compensated():
    """The controllers compensate the declared payload: without it, the arms rise."""
    made, loaded = cell(), cell()
    for _ in range(40):
        plain = made.advance(command(TOOL.stroke_m, TOOL.stroke_m)).state
        lifted = loaded.advance(command(TOOL.stroke_m, TOOL.stroke_m, payload_kg=np.array([[2.0, 0.0]]))).state
    up = lifted.flange_m[0, :, 2] - plain.flange_m[0, :, 2]
    # 20 N on a stiff arm whose shoulder alone yields by lever² / stiffness.
    assert 2e-4 < up[0] < 3e-3
    assert abs(up[1]) < 1e-6
