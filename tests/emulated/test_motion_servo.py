"""servoj: the same law as in simulation."""

import numpy as np
import pytest

from dual_ur10.envs.sim.servo_reference import ServojReference
from tests.ur_emulator.motion_runs import Q0, motion
from ur_core.servoj import ServojProfile


@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_servoj_matches_the_simulation(family):
    profile = ServojProfile(family, 0.05, 800.0)
    substeps = 4 if family == "cb3" else 1
    simulated = ServojReference(profile, 1, substeps, 1)
    simulated.reset(np.array([[Q0, Q0]]), np.array([0]))
    arm = motion(tick_s=profile.tick_s, substeps=substeps)
    for target in Q0 + np.cumsum(np.random.default_rng(3).uniform(-1, 1, (200, 6)) * 0.004, axis=0):
        followed = simulated(np.array([[[target, target]]]))
        rows = np.stack([followed.q_rad, followed.qd_rad_s, followed.qdd_rad_s2], axis=2)[0, :, :, :6]
        arm.servo_joints(target, profile.tick_s, profile.lookahead_s, profile.gain)
        plan = arm.plan()
        # Differences divide rounding by the time step, once and twice.
        for column, tolerance in enumerate((1e-12, 1e-11, 1e-8)):
            assert np.abs(plan[:, column] - rows[:, column]).max() < tolerance
    assert np.abs(arm.qd).max() > 0.01
