import dataclasses
import functools
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from dual_ur10 import CellConfig, policies
from dual_ur10.envs.core.options import OPTION_NAMES
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import SettingsError, UnknownKeywordError, UnknownNameError
from dual_ur10.sim2real.cell.perturbation import Perturbation

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


@pytest.mark.parametrize("cell", ["mujoco", "echo"])
@pytest.mark.parametrize(
    ("mode", "scale", "factors"),
    [
        ("joint_delta", 0.25, (0.25, 0.25)),
        ("joint_delta", {"joints": 0.5}, (0.5, 0.5)),
        ("tcp_delta", 0.5, (0.5, 0.5)),
        ("tcp_delta", {"rotation": 0.25}, (1.0, 0.25)),
    ],
)
def test_scaled_actions_are_smaller_actions(cell, mode, scale, factors):
    given = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2, 6))
    paths = []
    for action_scale, actions in ((scale, given), (1.0, given * np.repeat(factors, 3))):
        env = gym.make("DualUR10/SineTracking-v0", cell=cell, action_mode=mode, action_scale=action_scale)
        env.reset(seed=0)
        paths.append([env.step(action.reshape(12))[0] for action in actions])
        env.close()
    np.testing.assert_array_equal(*paths)


def test_widths_of_grippers_are_not_scaled():
    env = gym.make("DualUR10/Handover-v0", action_scale=0.5).unwrapped
    env.reset(seed=0)
    command, _ = env.core.pipeline(np.ones(14))
    np.testing.assert_array_equal(command.gripper_m[0, -1], env.core.pipeline.adapter.stroke_m)


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"action_scale": 0.0}, SettingsError, "joints is 0.0: it must be a number above 0 and at most 1"),
        ({"action_scale": -0.5}, SettingsError, "above 0"),
        ({"action_scale": 1.001}, SettingsError, "at most 1"),
        ({"action_scale": float("nan")}, SettingsError, "above 0"),
        ({"action_scale": True}, SettingsError, "must be a number"),
        ({"action_scale": "small"}, SettingsError, "must be a number"),
        ({"action_scale": {"joints": 2.0}}, SettingsError, "at most 1"),
        ({"action_scale": {"rotation": 0.5}}, UnknownNameError, "'joints'"),
        ({"action_scale": {"gripper": 0.5}, "action_mode": "tcp_delta"}, UnknownNameError, "'translation', 'rotation'"),
        ({"action_scale": 0.5, "action_mode": "joint_position"}, SettingsError, "positions, not steps"),
        ({"at_limits": "stop"}, UnknownNameError, "'lead', 'refuse'"),
    ],
)
def test_an_illegal_scale_or_reaction_is_refused(keywords, error, message):
    with pytest.raises(error, match=message):
        EnvSetup.resolve("SineTracking", keywords)


def test_positions_may_have_the_scale_of_all():
    assert EnvSetup.resolve("SineTracking", {"action_scale": 1, "action_mode": "joint_position"})


def test_a_script_tracks_with_scaled_actions():
    commanded = []
    for scale in (1.0, 0.7):
        env = gym.make("DualUR10/SineTracking-v0", action_scale=scale).unwrapped
        script = policies.load("scripted", "DualUR10/SineTracking-v0", action_scale=scale)
        observation, _ = env.reset(seed=0)
        for _ in range(40):
            action = script(observation)
            assert np.abs(action).max() <= 1.0
            observation, *_ = env.step(action)
        commanded.append(env.core.pipeline.adapter.commanded_q_rad)
    np.testing.assert_allclose(*commanded, atol=1e-4)


def test_a_goal_follower_knows_the_scale_of_its_actions():
    keywords = {"action_mode": "tcp_delta"}
    env = gym.make("DualUR10/Handover-v0", **keywords)
    whole, scaled = (
        policies.load("scripted", "DualUR10/Handover-v0", **keywords, action_scale=scale) for scale in (1.0, 0.5)
    )
    observation, _ = env.reset(seed=0)
    for _ in range(15):
        action, larger = (policy(observation).reshape(2, -1)[:, :6] for policy in (whole, scaled))
        np.testing.assert_allclose(larger, np.clip(2.0 * action, -1.0, 1.0), atol=1e-6)
        observation, *_ = env.step(whole(observation))
    assert 0.01 < np.abs(action).min(where=np.abs(action) > 0.01, initial=1.0) < 0.5


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
        keywords = {"at_limits": "refuse", "on_refusal": "terminate"}
        envs = gym.make_vec("DualUR10/SineTracking-v0", num_envs=16, autoreset_mode="SameStep", **keywords)
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
