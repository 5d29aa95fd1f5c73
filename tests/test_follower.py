"""Executors on simulated cells: nominal and perturbed plants, slow cells, and the other family."""

import numpy as np
import pytest

from dual_ur10 import TYPICAL_PERTURBATION, CellConfig, ServojProfile
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.envs.sim.echo_cell import EchoCell
from dual_ur10.errors import CollisionAtStartError, UnknownNameError
from dual_ur10.follower import make_follower
from dual_ur10.sim2real.trajectory import JointTrajectory, ResultCode, TrajectoryGoal
from tests.sim2real.trajectory.following import wave


@pytest.mark.parametrize(
    ("config", "error_rad"),
    [
        (CellConfig(), 2e-5),
        (CellConfig(servoj=ServojProfile(family="e-series")), 2e-5),
        (CellConfig(speed_factor=0.5), 1e-4),
        (CellConfig(perturbation=TYPICAL_PERTURBATION), 4e-3),
    ],
    ids=["nominal", "e-series", "slow", "perturbed"],
)
def test_simulated_arms_follow_a_goal(config, error_rad):
    with make_follower(config) as executor:
        result = executor.execute(wave(1.0, 5, start=executor.desired_q_rad)).wait()
        assert result.succeeded, result.text
        assert 0.0 < result.largest_error_rad.max() < error_rad


def test_a_dry_run_is_where_it_is_commanded_to_be():
    with make_follower("echo") as executor:
        assert isinstance(executor.cell, EchoCell)
        result = executor.execute(wave(1.0, 5)).wait()
        assert result.succeeded
        assert result.largest_error_rad.max() < 2e-5


def test_an_arm_that_is_held_back_violates_the_path_tolerance():
    blocked = CellConfig().with_perturbation(friction_nm=[[[100.0] * 6, [0.0] * 6]])
    with make_follower(blocked) as executor:
        handle = executor.execute(TrajectoryGoal(wave(1.0, 5), path_tolerance_rad=0.002))
        result = handle.wait()
        assert result.code == ResultCode.PATH_TOLERANCE_VIOLATED
        assert result.text.startswith("left/")
        rest = executor.measured_q_rad
        for _ in range(125):
            executor.step()
        assert np.abs(executor.measured_q_rad - rest).max() < 0.01


def test_limits_of_the_cell_count():
    with make_follower(CellConfig(speed_rad_s=0.2)) as executor:
        result = executor.execute(wave(1.0, 5)).wait()
        assert result.code == ResultCode.INVALID_GOAL
        assert "joint speed" in result.text


def test_a_start_with_bodies_too_close_is_refused_and_the_arms_stay():
    with make_follower() as executor:
        down = HOME_Q_RAD.copy()
        down[0, 1] += 0.6
        with pytest.raises(CollisionAtStartError, match="table"):
            executor.start(down)
        assert executor.execute(JointTrajectory(("left",), [1.0], HOME_Q_RAD[None, :1] + 0.05)).wait().succeeded


def test_unknown_names_are_refused():
    with pytest.raises(UnknownNameError, match="arm"):
        make_follower(arm="middle")
    with pytest.raises(UnknownNameError, match="cell"):
        make_follower("gazebo")
