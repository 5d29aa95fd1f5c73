"""The least latency suffices for an immediate action, wherever a time scaling leaves the targets between periods."""

import numpy as np

from dual_ur10.sim2real.runtime.runner import least_latency_ticks
from dual_ur10.testing import VirtualCell
from ur_core.kinematics.robot_model import TICK_S

SLIDERS = (0.83, 1.0) * 5


def test_no_immediate_action_is_late_during_and_after_a_time_scaling():
    """One tick less, and further actions are late for as long as targets stay where they fell between two periods."""
    with VirtualCell(plant="nominal") as cell:
        keywords = {"policy_rate_hz": 125.0, "action_latency_ticks": least_latency_ticks(TICK_S["cb3"])}
        env = cell.make("DualUR10/SineTracking-v0", disable_env_checker=True, **keywords)
        env.reset(seed=0)
        core, phases = env.unwrapped.core, []
        for slider in SLIDERS:
            cell.ask("slider", arm="left", fraction=slider)
            for _ in range(24):
                env.step(np.zeros(env.action_space.shape, np.float32))
            assert core.late_actions == 0
            phases.append(core.cell.runner.cell.time_scaling.at(0.0) % 1.0)
        env.close()
    assert max(phases) > 0.9  # of a period: the latest
