"""Goals on two emulated controllers that end at random instants: state, result, targets on the wire, and rest."""

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.follower import make_follower
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.trajectory import GoalState, ResultCode, TrajectoryGoal
from dual_ur10.sim2real.trajectory.interpolation import Interpolation
from dual_ur10.testing import VirtualCell
from tests.sim2real.trajectory.following import part, wave
from tests.soak import SOAK
from ur_core.kinematics.ur10 import ARMS

SERVOJ = 11
TICK_S = 0.008


def seeds(count):
    return pytest.mark.parametrize("seed", range(334 if SOAK else count))


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


@pytest.fixture
def cell(rng):
    with VirtualCell(plant=str(rng.choice(["nominal", "mild"])), seed=int(rng.integers(1000))) as cell:
        yield cell


@pytest.fixture
def executor(cell):
    with make_follower(cell) as executor:
        executor.start(HOME_Q_RAD)
        yield executor


def draw(rng, points_per_s=None):
    """Return a motion of random size, duration and order."""
    order, duration_s = int(rng.integers(3)), rng.uniform(1.0, 2.0)
    amplitude = rng.uniform(0.05, 0.2) * duration_s * (1.0 if order else 0.25)  # lines have corners
    per_s = points_per_s or (rng.uniform(4.0, 8.0) if order else 25.0)
    return wave(duration_s, int(duration_s * per_s) + 1, amplitude, order)


def steps(executor, periods):
    for _ in range(periods):
        executor.step()


def check_wire(cell):
    """Check that each controller got a target per tick, none of which exceeds a limit of motion."""
    limits = MotionLimits()
    for server in cell.emulator.servers:
        periods, commands, targets = zip(*server.controller.received.motion, strict=True)
        assert set(commands) == {SERVOJ}
        assert set(np.diff(periods)) == {1}
        orders = ((1, limits.speed_rad_s), (2, limits.acceleration_rad_s2), (3, limits.jerk_rad_s3))
        for order, most in orders:
            found = np.abs(np.diff(targets, order, axis=0)) / TICK_S**order
            assert (found <= np.asarray(most) * (1 + 1e-6)).all(), order


def check_rest(cell, executor, periods=20, most_rad=1e-3):
    """Check that both arms stay where they are, that all targets kept the limits, and that nothing was latched."""
    rest = executor.measured_q_rad
    steps(executor, periods)
    assert np.abs(executor.measured_q_rad - rest).max() < most_rad
    check_wire(cell)
    assert not cell.fault


def check_on_path(feedback, trajectory):
    wanted = Interpolation(trajectory)(feedback.path_s).q_rad
    np.testing.assert_allclose(feedback.desired_q_rad, wanted, atol=3e-3 if trajectory.qd_rad_s is None else 5e-4)


@seeds(1)
def test_a_goal_is_cancelled(rng, cell, executor):
    trajectory = draw(rng)
    handle = executor.execute(trajectory)
    steps(executor, int(rng.integers(0, int(trajectory.duration_s / executor.law.period_s) + 20)))
    over = handle.result is not None
    handle.cancel()
    result = handle.wait()
    state = GoalState.SUCCEEDED if over else GoalState.PREEMPTED
    assert (result.state, result.code) == (state, ResultCode.SUCCESSFUL), result.text
    if handle.feedback is not None:
        check_on_path(handle.feedback, trajectory)
    check_rest(cell, executor)


@seeds(1)
def test_a_stream_runs_out_of_points(rng, cell, executor):
    trajectory, known = draw(rng, points_per_s=25.0), 20
    last = int(rng.integers(known, len(trajectory)))
    handle = executor.execute(TrajectoryGoal(part(trajectory, 0, known), stream=True))
    while known < last and handle.result is None:
        executor.step()
        if trajectory.time_s[known - 1] < executor.time_s + 0.8:
            count = min(int(rng.integers(1, 4)), last - known)
            handle.append(part(trajectory, known, known + count))
            known += count
    result = handle.wait()
    expected = (GoalState.ABORTED, ResultCode.GOAL_TOLERANCE_VIOLATED, "underrun")
    assert (result.state, result.code, result.reason) == expected, result.text
    assert handle.feedback.path_s < trajectory.time_s[known - 1]
    check_on_path(handle.feedback, trajectory)
    check_rest(cell, executor)


@seeds(1)
def test_a_pushed_joint_ends_the_goal_within_two_cycles(rng, cell, executor):
    """A torque on one joint, which stays, lets it leave its path at a random instant."""
    world, tolerance_rad, seen = cell.emulator.world, 3e-3, []
    torque_n_m, advance = world._physics._batch.bind("qfrc_applied"), world.advance

    def noted(*arguments):
        advance(*arguments)
        seen.append(np.stack([world.read(arm).q_rad for arm in range(len(ARMS))]))

    world.advance = noted
    trajectory = wave(2.0, 21, rng.uniform(0.2, 0.5))
    handle = executor.execute(TrajectoryGoal(trajectory, path_tolerance_rad=tolerance_rad))
    steps(executor, 2 + int(rng.integers(5, 90)))  # 0.1 s are written ahead
    assert handle.state == GoalState.ACTIVE
    arm, joint = int(rng.integers(2)), int(rng.integers(1, 3))
    torque_n_m[0, world._dofs[arm][joint]] = rng.choice([-1.0, 1.0]) * rng.uniform(90.0, 110.0)
    while handle.result is None:
        executor.step()
    decided = len(seen) - 1
    result = handle.result
    assert (result.state, result.code) == (GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED), result.text
    assert result.reason == "path tolerance"
    # The tick that the last feedback shows, and the first one at which the joint is too far from its path.
    (shown,) = (k for k, q_rad in enumerate(seen) if np.array_equal(q_rad, handle.feedback.actual_q_rad))
    times = handle.feedback.path_s + TICK_S * (np.arange(len(seen)) - shown)
    moves = (times > 0.05) & (times < trajectory.duration_s)
    wanted = Interpolation(trajectory)(np.clip(times, 0.0, trajectory.duration_s)).q_rad
    away = np.abs(np.array(seen) - wanted).max(axis=(1, 2))
    first = int(np.flatnonzero(moves & (away > tolerance_rad))[0])
    assert decided - first <= 2, (decided, first, shown)
    while executor.moves:
        executor.step()
    check_rest(cell, executor, 125, 0.01)
