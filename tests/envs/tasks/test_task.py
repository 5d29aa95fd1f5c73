import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from dual_ur10 import errors
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.tasks.sine_tracking.settings import (
    AMPLITUDE_RANGE_M,
    FAR_CENTER_RANGE_M,
    FREQUENCY_RANGE_HZ,
    TOOL_DOWN_QUAT,
    SineSettings,
    sample_path,
)
from dual_ur10.envs.tasks.task import gaussian
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics import flange_pose
from ur_core.kinematics.frames import ArmMount, Frames, to_base
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.kinematics.ur10 import NOMINAL_DH


@pytest.mark.parametrize("margin", [0.005, 0.02])
def test_gaussian_is_dm_controls_tolerance(margin):
    rewards = pytest.importorskip("dm_control.utils.rewards")  # it has no wheels for Python 3.13
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
    zero = settings.displacement_m(np.zeros((3, 1)), task._phase[:, :1])
    for _ in range(70):  # beyond the soft start
        core.step(np.zeros((3, 12)))
        time, measured = core._state.time_s[:, None], task.measure(core._state)
        moved = (settings.displacement_m(time, task._phase[:, :1]) - zero)[:, :, None] * settings.direction
        assert np.abs(measured.reference_m - begin - moved).max() < 1e-14
        now, then = (settings.displacement_m(each, task._phase[:, :1]) for each in (time, time + task.timing.ahead_s))
        away = np.linalg.norm(measured.ahead_base_m - measured.reference_base_m, axis=2)
        assert np.abs(away - np.abs(then - now)).max() < 1e-14


def test_each_arm_observes_the_other_flange_in_its_own_base():
    cell = CellConfig()
    cell = dataclasses.replace(cell, left=dataclasses.replace(cell.left, yaw_rad=0.1))
    core = Core("SineTracking", {"cell": cell}, n=3)
    core.reset([np.random.default_rng(seed) for seed in range(3)])
    step, frames = core.step(np.full((3, 12), 0.1)), Frames((cell.left, cell.right))
    arms = core.task.layout.split(step.observation)
    position = frames.position_to_base(frames.position_to_cell(arms["flange_base_m"])[:, ::-1])
    quat = frames.quat_to_base(frames.quat_to_cell(arms["flange_base_quat"])[:, ::-1])
    assert np.allclose(arms["other_flange_base_m"], position, rtol=0, atol=1e-14)
    assert np.allclose(arms["other_flange_base_quat"], quat, rtol=0, atol=1e-14)
    assert np.abs(position[:, 0] - position[:, 1]).max() > 0.1
    own = step.agents.observations
    assert np.array_equal(own.reshape(3, -1), step.observation)
    assert not np.shares_memory(own, step.agents.observations)


def test_success_is_the_accuracy_of_both_arms_in_the_whole_episode():
    task = EnvSetup.resolve("SineTracking", {"duration_s": 0.12}).make_task(4)
    off_m = np.array([[0.004, 0.0], [0.0, 0.004], [0.002, 0.002], [0.0, 0.0]])
    zeros = np.zeros((4, 2, 3))

    def evaluate(factor=1.0):
        errors = SimpleNamespace(off_m=factor * off_m, chord=np.zeros((4, 2)), apart_m=np.zeros(4))
        return task.evaluate(SimpleNamespace(flange_m=zeros), SimpleNamespace(errors=errors, reference_m=zeros))

    assert not any(evaluate().over.any() for _ in range(2))
    outcome = evaluate()
    assert outcome.over.all()
    assert outcome.success.tolist() == [False, False, True, True]
    assert outcome.info["flange_rms_m"] == pytest.approx(off_m)
    task.start(np.array([0, 2]), [np.random.default_rng(0)] * 2)
    assert [evaluate(0.5).over.tolist() for _ in range(2)] == [[False, True, False, True]] * 2
    assert evaluate(0.5).success.tolist() == [True, False, True, True]


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


def test_a_random_path_is_one_that_the_arms_can_follow():
    core = Core("SineTracking", {"random_path": True}, n=24)
    _, info = core.reset([np.random.default_rng(seed) for seed in range(24)])
    drawn = info["randomization"]
    assert np.allclose(np.linalg.norm(drawn["axis"], axis=1), 1.0)
    assert np.ptp(drawn["axis"], axis=0).min() > 1.0
    for name, (low, high) in (("amplitude_m", AMPLITUDE_RANGE_M), ("frequency_hz", FREQUENCY_RANGE_HZ)):
        assert ((drawn[name] >= low) & (drawn[name] <= high)).all()
        assert np.ptp(drawn[name]) > 0.5 * (high - low)
    moved_m = drawn["center_m"] - np.asarray(SineSettings().center_m)
    assert np.abs(moved_m).max() <= FAR_CENTER_RANGE_M
    apart_m = moved_m[:, 0] - moved_m[:, 1]  # not one shift for both
    assert np.ptp(apart_m, axis=0).min() > FAR_CENTER_RANGE_M
    again = Core("SineTracking", {"random_path": True}, n=1)
    _, alone = again.reset([np.random.default_rng(7)])
    assert (alone["randomization"]["axis"][0] == drawn["axis"][7]).all()
    # Too fast at every centre: it is refused instead of drawn for ever.
    with pytest.raises(errors.WorkspaceError, match="choose"):
        sample_path(
            SineSettings(center_m=((0.0, 2.0, 0.4), (0.0, -2.0, 0.4))), np.random.default_rng(0), core.task._check
        )


def test_the_observed_step_leads_the_commanded_flanges_to_their_references():
    core = Core("SineTracking", {"action_latency_ticks": 3}, n=2)
    observation, _ = core.reset([np.random.default_rng(seed) for seed in range(2)])
    rng = np.random.default_rng(0)
    for _ in range(20):
        observation = core.step(rng.uniform(-1.0, 1.0, (2, 12))).observation
    fields = core.task.layout.split(observation)
    at, turned = flange_pose(fields["commanded_q_rad"], NOMINAL_DH)
    assert np.abs(at + fields["step_m"] - fields["ahead_base_m"]).max() < 1e-12
    angle = np.linalg.norm(fields["step_rad"], axis=-1)
    assert angle.min() > 0.01
    # Twice the vector part of a quaternion: its length is twice the sine of half the angle.
    exact = 2.0 * np.arcsin(angle / 2.0) / angle
    step = quat_to_matrix(quat_from_rotvec(fields["step_rad"] * exact[..., None]))
    assert np.abs(step @ turned - quat_to_matrix(TOOL_DOWN_QUAT)).max() < 1e-12
