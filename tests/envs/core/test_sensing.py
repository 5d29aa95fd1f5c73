import numpy as np
import pytest

from dual_ur10 import ArmMount, CellConfig
from dual_ur10.assets.props import BAR
from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.core.randomization import Randomization
from dual_ur10.envs.core.sensing import Sensing
from dual_ur10.sim2real.cell.cell import CellState
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply, quat_to_rotvec

N = 4
CELL = CellConfig(left=ArmMount((-0.75, 0.6, 0.0), 0.3), equipment=Equipment(grippers=True, props=(BAR,)))
QUIET = CellConfig(
    left=ArmMount((-0.75, 0.6, 0.0), 0.3), equipment=Equipment(grippers=True, props=(BAR,)), wrench_noise=(0.0, 0.0)
)


def state(seed=0):
    rng = np.random.default_rng(seed)
    frames = Frames((CELL.left, CELL.right))
    base_m, base_quat = rng.normal(size=(N, 2, 3)), quat_from_rotvec(rng.normal(size=(N, 2, 3)))
    return CellState(
        np.full(N, 0.04 * seed),
        rng.normal(size=(N, 2, 6)),
        rng.normal(size=(N, 2, 6)),
        base_m,
        base_quat,
        frames.position_to_cell(base_m) + 0.01,  # the bases stand 1 cm from where they are believed to
        np.zeros(N, dtype=bool),
        frames.quat_to_cell(base_quat),
        rng.uniform(0, 0.085, (N, 2)),
        rng.normal(size=(N, 2, 6)),
        {"bar": Poses(rng.normal(size=(N, 3)), quat_from_rotvec(rng.normal(size=(N, 3))))},
    )


def sensing(cell=QUIET, sampled=None, **values):
    made = Sensing(cell, Randomization(**values), 0.04, N)
    first = state(0)
    blank = {
        "object_offset_m": np.zeros((N, 1, 3)),
        "object_offset_rad": np.zeros((N, 1, 3)),
        "observation_delay_s": np.zeros(N),
    }
    made.reset(first, np.arange(N), list(range(N)), {**blank, **(sampled or {})})
    return made, first


def test_without_noise_the_true_state_is_returned():
    made, first = sensing()
    assert made.is_exact
    assert made(first) is first


def test_wrench_noise_is_that_of_the_cell():
    made, first = sensing(CELL)
    found = np.array([made(first).wrench - first.wrench for _ in range(400)])
    assert found[..., :3].std() == pytest.approx(2.0, rel=0.05)
    assert found[..., 3:].std() == pytest.approx(0.2, rel=0.05)
    assert np.array_equal(made(first).q_rad, first.q_rad)
    assert np.array_equal(made(first).q_rad, first.q_rad)
    bare = Sensing(CellConfig(), Randomization(), 0.04, N)
    assert bare.is_exact  # no grippers, no wrench


def test_joint_noise():
    made, first = sensing(joint_noise_rad=1e-3, joint_speed_noise_rad_s=1e-2)
    found = np.array([made(first).q_rad - first.q_rad for _ in range(300)])
    assert found.std() == pytest.approx(1e-3, rel=0.05)
    assert np.std([made(first).qd_rad_s - first.qd_rad_s for _ in range(300)]) == pytest.approx(1e-2, rel=0.05)


def test_the_objects_offset_is_constant_in_an_episode():
    offset, turn = np.random.default_rng(1).normal(size=(2, N, 3)) * 0.01
    sampled = {"object_offset_m": offset[:, None], "object_offset_rad": turn[:, None]}
    made, first = sensing(sampled=sampled, object_noise_m=0.01)
    for seed in (0, 1):
        true = state(seed)
        seen = made(true)
        assert np.allclose(seen.objects["bar"].position_m - true.objects["bar"].position_m, offset)
        apart = quat_multiply(seen.objects["bar"].quat, true.objects["bar"].quat * [1, -1, -1, -1])
        assert np.allclose(quat_to_rotvec(apart), turn, atol=1e-12)
    assert np.array_equal(first.objects["bar"].position_m, state(0).objects["bar"].position_m)  # the truth is untouched


def test_a_moved_base_is_not_measured():
    made, first = sensing(base_shift_m=0.01)
    seen = made(first)
    assert np.allclose(first.flange_m - seen.flange_m, 0.01)
    assert np.allclose(seen.flange_quat, first.flange_quat)
    assert seen.flange_base_m is first.flange_base_m


def test_delay_mixes_two_successive_states():
    delay = np.array([0.0, 0.01, 0.02, 0.05])  # the last one is more than the period
    made, first = sensing(sampled={"observation_delay_s": delay}, observation_delay_s=0.04)
    assert np.allclose(made.begun(first).q_rad, first.q_rad)
    second, third = state(1), state(2)
    for before, now in ((first, second), (second, third)):
        seen = made(now)
        share = np.array([0.0, 0.25, 0.5, 1.0])[:, None, None]
        assert np.allclose(seen.q_rad, now.q_rad + share * (before.q_rad - now.q_rad))
        assert np.allclose(np.linalg.norm(seen.flange_base_quat, axis=-1), 1.0)
        assert np.array_equal(seen.objects["bar"].position_m[0], now.objects["bar"].position_m[0])
        assert np.allclose(seen.objects["bar"].position_m[3], before.objects["bar"].position_m[3])
        assert np.array_equal(seen.time_s, now.time_s)  # the clock is the computer's own


def test_a_reset_row_does_not_change_the_noise_of_others():
    one, first = sensing(CELL, joint_noise_rad=1e-3)
    other, _ = sensing(CELL, joint_noise_rad=1e-3)
    one(first), other(first)
    other.reset(first, np.array([2]), [99], {})
    other.begun(first)
    a, b = one(first), other(first)
    rows = [0, 1, 3]
    assert np.array_equal(a.q_rad[rows], b.q_rad[rows])
    assert not np.array_equal(a.q_rad[2], b.q_rad[2])
