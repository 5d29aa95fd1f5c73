import sys

import numpy as np
import pytest

from dual_ur10.errors import PolicyError, SettingsError, UnknownNameError
from dual_ur10.policies import evaluate, load
from dual_ur10.policies.registry import check_name, is_class

SINE = "DualUR10/SineTracking-v0"
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
        ("my_policies:Scaled", SettingsError, "whose arguments are optional, or, for an environment, among timing"),
        ("my_policies:NoPolicy", PolicyError, "it must have `reset"),
        ("psychic", UnknownNameError, "module:Class"),
    ],
)
@pytest.mark.usefixtures("own")
def test_what_is_no_policy_is_named(name, kind, text):
    with pytest.raises(kind, match=text):
        load(name, SINE)


def test_names_and_paths_are_no_classes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not any(map(is_class, ("scripted", "a/b:C", "a:b:C", "a:", ":C", "1a:C", "folder")))
    (tmp_path / "a:C").mkdir()
    assert not is_class("a:C")  # a path that exists
    check_name("zero")
    with pytest.raises(UnknownNameError):
        check_name("a:b:C")
