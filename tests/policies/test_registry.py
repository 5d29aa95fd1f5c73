import sys

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import CheckpointError, DualUR10Error, PolicyError, SettingsError, UnknownNameError
from dual_ur10.policies import evaluate, load, make, rollout
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.registry import check_name, is_class, keywords_for
from dual_ur10.sim2real.cell.cell_config import CellConfig
from tests.policies.learned.checkpoints import SINE, parts

OWN = """
import numpy as np


class Still:
    def reset(self):
        pass

    def __call__(self, observation):
        return np.zeros((*observation.shape[:-1], 12))


class Scaled(Still):
    def __init__(self, factor):
        self.factor = factor


class Knowing(Still):
    def __init__(self, settings=None, timing=None):
        self.settings, self.timing = settings, timing


class NoPolicy:
    pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return the name of a module of the user's own."""
    (tmp_path / "my_policies.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    yield "my_policies"
    sys.modules.pop("my_policies", None)


def test_a_class_of_ones_own_acts_as_a_policy(own):
    assert np.array_equal(load(f"{own}:Still", SINE)(np.zeros(94)), np.zeros(12))
    found = evaluate(SINE, f"{own}:Still", episodes=1, env_kwargs={"duration_s": 1.0})
    assert found.mean_return == evaluate(SINE, "zero", episodes=1, env_kwargs={"duration_s": 1.0}).mean_return


def test_a_class_of_ones_own_gets_the_arguments_that_it_takes(own):
    made = load(f"{own}:Knowing", SINE, amplitude_m=0.05, policy_rate_hz=12.5)
    assert (made.settings.amplitude_m, made.timing.period_s) == (0.05, 0.08)
    assert load(f"{own}:Knowing").settings is None
    with pytest.raises(SettingsError, match="amplitude_m"):
        load(f"{own}:Knowing", SINE, amplitude_m=-1.0)


@pytest.mark.parametrize(
    ("name", "kind", "text"),
    [
        ("no_such_module_here:Policy", SettingsError, "No module named 'no_such_module_here'"),
        ("my_policies:Absent", SettingsError, "has no attribute 'Absent'"),
        ("my_policies:Scaled", SettingsError, "or, for an environment, among task, timing"),
        ("my_policies:NoPolicy", PolicyError, "it must have `reset"),
        ("psychic", UnknownNameError, "module:Class"),
    ],
)
@pytest.mark.usefixtures("own")
def test_what_is_no_policy_is_named(name, kind, text):
    with pytest.raises(kind, match=text):
        load(name, SINE)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (
            lambda env: load("SineTracking", "scripted"),
            "'scripted' is no environment, and the policy 'SineTracking' is",
        ),
        (lambda env: make(SINE, "learned"), "'learned' is no environment"),
        (lambda env: make("Handover", np.zeros), "function zeros> is no environment, and the policy 'Handover'"),
        (lambda env: evaluate("random", "Handover-v0"), "'random' is no environment"),
        (lambda env: evaluate(np.zeros, SINE), "exchange the two arguments"),
        (lambda env: evaluate(env, "scripted"), 'the environment is <.*: pass its id, such as "Handover"'),
        (
            lambda env: rollout(np.zeros, env),
            "the policy is an environment, OrderEnforcing: are two arguments exchanged",
        ),
        (lambda env: rollout(SINE, np.zeros), "pass one that gym.make has made"),
        (lambda env: make("scripted", "Juggling"), "unknown environment 'Juggling': use one of"),
        (
            lambda env: make("scripted", "Free"),
            "unknown policy of DualUR10/Free-v0 'scripted': use random or zero in comm",
        ),
    ],
)
def test_exchanged_and_unknown_arguments_are_named(call, text):
    with gym.make(SINE) as env, pytest.raises(DualUR10Error, match=text):
        call(env)


def test_of_equally_near_names_the_first_is_meant():
    with pytest.raises(UnknownNameError, match=r"'ur11' \(did you mean 'ur10'\?\)"):
        make("zero", SINE, robot="ur11")


def test_names_and_paths_are_no_classes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not any(map(is_class, ("scripted", "a/b:C", "a:b:C", "a:", ":C", "1a:C", "folder")))
    (tmp_path / "a:C").mkdir()
    assert not is_class("a:C")  # a path that exists
    check_name("zero")
    with pytest.raises(UnknownNameError):
        check_name("a:b:C")


UNUSUAL = {
    "observation": "goals",
    "action_mode": "tcp_delta",
    "action_scale": 0.5,
    "action_latency_ticks": 5,
    "policy_rate_hz": 12.5,
    "compensate_lag": False,
    "robot": ("ur5e", "ur5e"),
}
"""Keywords that decide what a policy observes and what its actions mean, none of them the default."""


@pytest.fixture
def unusual(tmp_path):
    """Return the folder of a checkpoint that was made for an unusual environment."""
    checkpoint.save(tmp_path / "unusual", *parts(SINE, **UNUSUAL))
    return tmp_path / "unusual"


@pytest.mark.parametrize("name", ["scripted", "learned", "random", "zero", lambda _: np.zeros(12)])
def test_a_pair_of_environment_and_policy_fits(name):
    env, policy = make(name, "SineTracking", max_episode_steps=3)
    with env:
        assert rollout(env, policy, seed=0).steps == 3
        assert env.unwrapped.core.setup.latency_ticks == (5 if name == "learned" else 0)


def test_an_environment_has_all_that_its_checkpoint_was_made_for(unusual):
    for policy in (unusual, str(unusual), checkpoint.load(unusual)):
        assert keywords_for(policy, SINE, {}) == UNUSUAL
    env, policy = make(unusual, SINE, max_episode_steps=2, disable_env_checker=True)
    with env:
        assert rollout(env, policy, seed=0).steps == 2
        setup = env.unwrapped.core.setup
    assert [mount.robot for mount in (setup.config.left, setup.config.right)] == ["ur5e", "ur5e"]
    assert (setup.options.action_scale, setup.ticks, setup.latency_ticks) == (0.5, 40, 5)
    found = evaluate(SINE, str(unusual), episodes=1, env_kwargs={"max_episode_steps": 2})
    assert UNUSUAL.items() <= found.kwargs.items()


def test_keywords_that_are_stated_come_before_those_of_a_checkpoint(unusual):
    assert keywords_for(unusual, SINE, {"action_scale": 0.25})["action_scale"] == 0.25
    with pytest.raises(CheckpointError, match="action_latency_ticks"):
        make(unusual, SINE, action_latency_ticks=4)


def test_a_cell_keeps_its_arms_and_its_latency(unusual):
    assert not {"robot", "action_latency_ticks"} & keywords_for(unusual, SINE, {"cell": "lab.toml"}).keys()
    assert "robot" not in keywords_for(unusual, SINE, {"cell": CellConfig()})
