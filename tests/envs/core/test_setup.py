import dataclasses
import functools
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from dual_ur10 import CellConfig
from dual_ur10.envs.core.options import OPTION_NAMES
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import SettingsError, UnknownKeywordError, UnknownNameError
from dual_ur10.sim2real.config.perturbation import Perturbation

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


def test_contacts_are_left_out_only_for_nominal_arms_alone():
    def contacts(task="SineTracking", **keywords):
        return EnvSetup.resolve(task, keywords).contacts

    assert not contacts()
    assert not contacts(randomization={"joint_noise_rad": 1e-4})
    assert not contacts(cell=CellConfig(minimum_clearance_m=0.005))
    assert contacts(randomization="mild")
    assert contacts(cell=CellConfig(perturbation=Perturbation(base_shift_m=0.01)))
    assert contacts("SyncCarry")
    assert contacts("Handover")


@pytest.mark.parametrize("together", [False, True])
def test_nominal_arms_move_alike_without_contacts(monkeypatch, together):
    """Random actions, also the same for ten steps, which drive many episodes into the gate's smallest distance."""

    def trace():
        envs = gym.make_vec("DualUR10/SineTracking-v0", num_envs=16, autoreset_mode="SameStep", on_refusal="terminate")
        envs.reset(seed=5)
        rng, ended, found = np.random.default_rng(1), 0, []
        for step in range(150):
            if not together or step % 10 == 0:
                action = rng.choice([-1, 1], (16, 12)).astype(np.float32)
            observation, _, terminated, *_ = envs.step(action)
            found.append(observation)
            ended += terminated.sum()
        flags = envs.core.cell._physics.model.opt.disableflags
        return np.array(found), ended, bool(flags & mujoco.mjtDisableBit.mjDSBL_CONTACT)

    without, ended, disabled = trace()
    monkeypatch.setattr(EnvSetup, "contacts", True)
    with_contacts, _, still_disabled = trace()
    assert disabled
    assert not still_disabled
    assert ended > 10
    assert np.array_equal(without, with_contacts)


def test_a_wider_spread_applies_only_to_ranges_that_are_not_given():
    wide = {"randomization": {"object_spread": 2.0}}
    default = EnvSetup.resolve("Handover", {}).settings
    settings = EnvSetup.resolve("Handover", {**wide, "object_range_m": 0.01}).settings
    assert settings == dataclasses.replace(default, object_range_m=0.01, object_turn_rad=2.0 * default.object_turn_rad)


def test_unknown_keywords_are_refused_unless_they_are_ignored():
    with pytest.raises(UnknownNameError, match="DualUR10/Handover-v0 got an unexpected keyword argument 'render_mode'"):
        EnvSetup.resolve("Handover", {"render_mode": "human"})
    ignored = EnvSetup.resolve("Handover", {"render_mode": "human"}, ignore_unknown=True)
    assert ignored == EnvSetup.resolve("Handover", {})


@pytest.mark.parametrize("make", [gym.make, functools.partial(gym.make_vec, vectorization_mode="vector_entry_point")])
def test_an_unknown_keyword_is_found_out_as_of_any_function(make):
    with pytest.raises(TypeError, match="unexpected keyword argument 'amplitud'") as caught:
        make("DualUR10/SineTracking-v0", amplitud=1)
    for error in (caught.value, pickle.loads(pickle.dumps(caught.value))):
        assert isinstance(error, UnknownKeywordError)
        assert (error.found, error.allowed[:2]) == ("amplitud", ("axis", "amplitude_m"))
        assert str(error).endswith(repr(OPTION_NAMES[-1]))  # without what Gymnasium appends


def test_the_concise_view_is_of_single_precision():
    assert EnvSetup.resolve("Handover", {"observation": "goals"}).options.dtype == np.float32
    EnvSetup.resolve("Handover", {"observation": "goals", "observation_dtype": "float32"})
    with pytest.raises(SettingsError, match="observation_dtype 'float64': leave observation_dtype out"):
        EnvSetup.resolve("Handover", {"observation": "goals", "observation_dtype": "float64"})
