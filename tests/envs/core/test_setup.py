import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import CellConfig
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import UnknownNameError

KEYWORDS = {
    "policy_rate_hz": 12.5,
    "action_latency_ticks": 3,
    "object_range_m": 0.01,
    "cell": CellConfig(speed_rad_s=0.5),
}


def test_equal_keywords_give_equal_setups():
    assert EnvSetup.resolve("Handover", KEYWORDS) == EnvSetup.resolve("Handover", dict(KEYWORDS))
    assert EnvSetup.resolve("Handover", KEYWORDS) != EnvSetup.resolve("Handover", {})


def test_a_setup_holds_what_its_environment_has():
    setup = EnvSetup.resolve("Handover", KEYWORDS)
    env = gym.make("DualUR10/Handover-v0", **KEYWORDS).unwrapped
    assert env.core.setup == setup
    assert (setup.ticks, setup.latency_ticks) == (10, 3)
    assert setup.timing.period_s == pytest.approx(0.08)
    assert setup.timing.ahead_s == pytest.approx(0.08 + 3 * 0.008)
    assert setup.limits.speed_rad_s == (0.5,) * 6 == tuple(env.task.limits.speed_rad_s)
    assert setup.config.equipment.grippers
    low, high = setup.make_adapter().action_bounds
    assert np.array_equal(env.action_space.low, low.reshape(-1))
    assert np.array_equal(env.action_space.high, high.reshape(-1))


def test_a_wider_spread_applies_only_to_ranges_that_are_not_given():
    wide = {"randomization": {"object_spread": 2.0}}
    default = EnvSetup.resolve("Handover", {}).settings
    settings = EnvSetup.resolve("Handover", {**wide, "object_range_m": 0.01}).settings
    assert settings == dataclasses.replace(default, object_range_m=0.01, object_turn_rad=2.0 * default.object_turn_rad)


def test_unknown_keywords_are_refused_unless_they_are_ignored():
    with pytest.raises(UnknownNameError, match="keyword of Handover 'render_mode'"):
        EnvSetup.resolve("Handover", {"render_mode": "human"})
    ignored = EnvSetup.resolve("Handover", {"render_mode": "human"}, ignore_unknown=True)
    assert ignored == EnvSetup.resolve("Handover", {})
