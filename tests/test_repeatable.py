"""What is drawn in tests is the same in every run, but not in a soak."""

import importlib

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import SOAK


def _drawn():
    drawn = []

    @settings(settings.get_profile("repeated"), max_examples=200)
    @given(st.floats(), st.integers())
    def draw(x, n):
        drawn.append((x, n))

    draw()
    return repr(drawn)


def test_properties_see_the_same_examples_whatever_was_imported(tmp_path, monkeypatch):
    before = _drawn()
    text = f"A = {[1234.5 + k for k in range(100)]}\nB = {[*range(5000, 5100)]}\n"
    (tmp_path / "module_with_constants.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("module_with_constants")
    assert _drawn() == before
    assert not settings.get_profile("fresh").derandomize


@pytest.mark.skipif(SOAK, reason="a soak draws anew")
@pytest.mark.parametrize("seen", [[]] * 2, ids=["first", "again"])
def test_what_has_no_seed_is_the_same_in_each_test(seen):
    space = gymnasium.spaces.Box(0.0, 1.0)
    seen.append((np.random.default_rng().random(), np.random.default_rng().random(), space.sample().item()))
    assert seen == seen[:1] * len(seen)
    assert len(set(seen[0])) == 3
