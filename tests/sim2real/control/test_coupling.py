"""Coupling error of two arms that hold one object."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from dual_ur10.envs.core.core import Core
from dual_ur10.policies.evaluation.results import EpisodeResult, Evaluation
from dual_ur10.sim2real.control.coupling import APART_M, APART_RAD, Coupling
from ur_core.kinematics.forward import flange_pose
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.rotations import quat_from_matrix

MOUNTS = SceneSettings().mounts


def relative(q):
    """Return the right flange in the frame of the left one by matrices, (4, 4)."""
    frames, poses = Frames(MOUNTS), []
    for arm, mount in enumerate(MOUNTS):
        position, rotation = flange_pose(q[arm], mount.dh)
        both_m, both = np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
        both_m[arm], both[arm] = position, quat_from_matrix(rotation)
        pose = np.eye(4)
        pose[:3, :3] = matrix(frames.quat_to_cell(both)[arm])
        pose[:3, 3] = frames.position_to_cell(both_m)[arm]
        poses.append(pose)
    return np.linalg.inv(poses[0]) @ poses[1]


def matrix(quat):
    w, x, y, z = quat
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.floats(0.0, 0.3))
def test_it_is_the_distance_of_two_relative_poses_and_only_of_coupled_rows(seed, most_rad):
    rng = np.random.default_rng(seed)
    wanted = HOME_Q_RAD + rng.uniform(-1.0, 1.0, (3, 2, 6))
    found = wanted + rng.uniform(-most_rad, most_rad, (3, 2, 6))
    coupled = np.array([True, False, True])
    values = Coupling(MOUNTS).values(found, wanted, coupled)
    for row in range(3):
        error = np.linalg.inv(relative(wanted[row])) @ relative(found[row])
        angle = np.arctan2(
            np.linalg.norm([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]),
            np.trace(error[:3, :3]) - 1.0,
        )
        expected = (np.linalg.norm(error[:3, 3]), angle) if coupled[row] else (0.0, 0.0)
        np.testing.assert_allclose([each[row] for each in values.values()], expected, rtol=0, atol=1e-7)


def test_a_simulation_reports_it_while_both_arms_hold_one_object():
    core = Core("SyncCarry", {})
    core.keeps_start = True
    core.reset([np.random.default_rng(0)])
    core.cell.record()
    assert {"coupling_error_m", "coupling_error_rad"} <= core.initial_info().keys()
    core.reset([np.random.default_rng(0)])
    advance, traces = core.cell.advance, []
    core.cell.advance = lambda command: traces.append(advance(command)) or traces[-1]
    info = [core.step(np.full((1, 14), 0.3)).info for _ in range(3)][-1]
    trace = traces[-1].trace  # what a controller wants, and where its arm is, in the last tick
    error = np.linalg.inv(relative(trace.reference_rad[-1])) @ relative(trace.q_rad[-1])
    assert info["coupling_error_m"][0] == pytest.approx(np.linalg.norm(error[:3, 3]), abs=1e-9)
    assert info["coupling_error_m"][0] > 1e-6
    core.close()
    core = Core("BoxLift", {}, n=2)
    core.reset([np.random.default_rng(0)] * 2)
    assert not core.step(np.full((2, 14), 0.3)).info["coupling_error_m"].any()  # they hold nothing yet
    core.close()


@pytest.mark.parametrize(("apart_m", "apart_rad", "over"), [(0.99, 0.99, 0), (1.01, 0.0, 1), (0.0, 1.01, 1)])
def test_an_evaluation_counts_episodes_that_controllers_would_stop(apart_m, apart_rad, over):
    peak = {"coupling_error_m": apart_m * APART_M, "coupling_error_rad": apart_rad * APART_RAD}
    episode = EpisodeResult(seed=0, success=True, total_reward=1.0, steps=1, time_s=0.04, peak=peak)
    summary = Evaluation("Own-v0", "own", {}, 0, (), (episode,), {}).summary()
    assert summary["apart"] == over
    assert ("coupling error above 10 mm or 3°: controllers stop" in str(summary)) == bool(over)
