"""Compliant motions: tools that yield to springs, with the delay of measurement and action."""

import numpy as np
import pytest

from dual_ur10.policies.scripted.admittance import Admittance
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_from_rotvec, rotate

AHEAD = np.array([0.0, 0.0, 1.0])
PATH = Poses(np.zeros((2, 3)), quat_from_rotvec(np.array([[0.0, 1.2, 0.3], [2.0, 0.0, -0.5]])))
BIAS_N = np.array([[1.0, -2.0, 3.0], [0.0, 1.0, -4.0]])


class Springs:
    """Arms whose tools meet springs 5 mm ahead of their paths, and whose forces have a bias and come late."""

    period_s = 0.04

    def __init__(self, stiffness_n_m):
        self.tools, self.stiffness_n_m, self.past_m = PATH, stiffness_n_m, [PATH.position_m] * 3

    def step(self, tools):
        self.tools, self.past_m = tools, [*self.past_m[1:], tools.position_m]
        yield

    def hold(self, time_s):
        yield from self.step(self.tools)

    def vector(self, name):
        axes = rotate(PATH.quat, AHEAD)
        depth_m = np.maximum(np.vecdot(self.past_m[0], axes) - 0.005, 0.0)
        return BIAS_N - self.stiffness_n_m * depth_m[:, None] * axes


def run(yielding, steps, *arguments):
    for _ in range(steps):
        list(yielding.step(PATH, *arguments))


@pytest.mark.parametrize("stiffness_n_m", [2_000.0, 10_000.0, 30_000.0])
def test_the_force_settles_at_the_wanted_one_without_overshoot(stiffness_n_m):
    yielding = Admittance(Springs(stiffness_n_m), 1e-4)
    list(yielding.tare())
    peak_n = 0.0
    for _ in range(600):
        run(yielding, 1, AHEAD, -45.0 * AHEAD)
        peak_n = max(peak_n, -yielding.force_n[:, 2].min())
    assert np.allclose(yielding.force_n, -45.0 * AHEAD, atol=0.5)
    assert peak_n < 60.0


def test_tools_yield_along_their_free_axes_beyond_the_dead_band_and_their_speed_is_limited():
    arms = Springs(10_000.0)
    yielding = Admittance(arms, 1.0, dead_n=5.0, most_m_s=0.01)
    list(yielding.tare())
    run(yielding, 10, np.zeros(3), 100.0)
    assert np.array_equal(yielding.moved_m, np.zeros((2, 3)))
    run(yielding, 10, np.ones(3), 4.9)
    assert np.array_equal(yielding.moved_m, np.zeros((2, 3)))
    run(yielding, 5, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), -100.0)
    assert np.allclose(yielding.moved_m, [[5 * 0.01 * arms.period_s, 0.0, 0.0], [0.0, 0.0, 0.0]])
