import dataclasses
import pickle

import numpy as np
import pytest
from dm_control.utils import rewards

from dual_ur10 import errors
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.tasks.sine_tracking.settings import SineSettings
from dual_ur10.envs.tasks.task import gaussian
from dual_ur10.kinematics.frames import ArmMount, Frames, to_base
from dual_ur10.sim2real.config.cell import CellConfig


@pytest.mark.parametrize("margin", [0.005, 0.02])
def test_gaussian_is_dm_controls_tolerance(margin):
    distance = np.linspace(0, 0.1, 50)
    expected = rewards.tolerance(distance, bounds=(0, 0), margin=margin, sigmoid="gaussian", value_at_margin=0.1)
    assert np.allclose(gaussian(distance, margin), expected, atol=1e-12)


def test_the_sine_begins_at_rest_without_acceleration():
    settings = SineSettings(soft_start_s=2.0)
    time = np.linspace(0, 4, 4001)
    for phase in (0.0, 1.0, np.pi / 2):
        x = settings.displacement_m(time, np.array(phase))
        speed = np.gradient(x, time)
        acceleration = np.gradient(speed, time)
        assert abs(x[0]) < 1e-12
        assert abs(speed[1]) < 1e-6
        assert abs(acceleration[2]) < 1e-2
        assert np.abs(speed).max() <= settings.peak_speed_m_s * 1.001
        assert np.abs(np.diff(speed)).max() < 2e-3  # no step at the end of the soft start
        late = time >= 2.0
        assert np.allclose(x[late], 0.1 * np.sin(np.pi * time[late] + phase), atol=1e-12)


def test_the_references_lie_on_the_sine():
    core = Core("SineTracking", {"axis": (1.0, 2.0, -0.5), "arms": "both"}, n=3)
    core.reset([np.random.default_rng(seed) for seed in range(3)])
    task, settings = core.task, core.task.settings
    begin = task.measure(core._state).reference_m
    zero = settings.displacement_m(np.zeros((3, 1)), task._phase)
    for _ in range(70):  # beyond the soft start
        core.step(np.zeros((3, 12)))
        time, measured = core._state.time_s[:, None], task.measure(core._state)
        moved = (settings.displacement_m(time, task._phase) - zero)[:, :, None] * settings.direction
        assert np.abs(measured.reference_m - begin - moved).max() < 1e-14
        ahead = settings.displacement_m(time + task.timing.ahead_s, task._phase) - settings.displacement_m(
            time, task._phase
        )
        away = np.linalg.norm(measured.ahead_base_m - measured.reference_base_m, axis=2)
        assert np.abs(away - np.abs(ahead)).max() < 1e-14


def test_agents_of_the_sine_observe_the_other_flange_in_their_own_base():
    cell = CellConfig()
    cell = dataclasses.replace(cell, left=dataclasses.replace(cell.left, yaw_rad=0.1))
    core = Core("SineTracking", {"cell": cell}, n=3)
    core.reset([np.random.default_rng(seed) for seed in range(3)])
    both, task, frames = core.step(np.full((3, 12), 0.1)).observation, core.task, Frames((cell.left, cell.right))
    own = task.observe_agents(both)
    assert np.array_equal(own[..., : task.layout.size], both.reshape(3, 2, -1))
    arms = task.layout.split(both)
    position = frames.position_to_base(frames.position_to_cell(arms["flange_base_m"])[:, ::-1])
    quat = frames.quat_to_base(frames.quat_to_cell(arms["flange_base_quat"])[:, ::-1])
    assert np.allclose(own[..., task.layout.size :], np.concatenate([position, quat], axis=2), rtol=0, atol=1e-14)
    assert np.abs(own[:, 0] - own[:, 1]).max() > 0.1
    copy = pickle.loads(pickle.dumps(task))
    for rows in (slice(0, 1), slice(1, 3)):  # for any number of rows, and the same
        assert np.array_equal(task.observe_agents(both[rows]), own[rows])
        assert np.array_equal(copy.observe_agents(both[rows]), own[rows])
    assert not np.shares_memory(task.observe_agents(both), task.observe_agents(both))


def test_displacements_do_not_depend_on_other_rows():
    settings = SineSettings()
    alone = settings.displacement_m(np.array([[5.0, 5.04]]), np.array([[0.3]]))
    beside = settings.displacement_m(np.array([[5.0, 5.04], [0.1, 0.14]]), np.array([[0.3], [1.0]]))
    assert np.array_equal(alone[0], beside[0])


def test_to_base_transforms_cell_points_to_urs_base():
    position, rotation = to_base((ArmMount((1.0, 2.0, 3.0), np.pi / 2), ArmMount((0.0, -1.0, 0.0))))
    # Half a turn from base_link: what lies ahead of the arm has negative x.
    assert np.allclose(rotation[1] @ (np.array([0.5, -1.0, 0.2]) - position[1]), [-0.5, 0.0, 0.2])
    assert np.allclose(rotation[0] @ (np.array([1.0, 2.5, 3.0]) - position[0]), [-0.5, 0.0, 0.0])


def test_settings_by_keyword():
    assert EnvSetup.resolve("SineTracking", {"amplitude_m": 0.2}).settings == SineSettings(amplitude_m=0.2)
    with pytest.raises(errors.UnknownNameError, match="amplitude_m"):
        EnvSetup.resolve("SineTracking", {"amplitude": 0.2})
    with pytest.raises(errors.UnknownNameError, match="SineTracking"):
        EnvSetup.resolve("Sine", {})
    assert np.allclose(SineSettings(axis=(0, 3, 4)).direction, [0, 0.6, 0.8])
    assert SineSettings(arms="right").tracking.tolist() == [0.0, 1.0]
