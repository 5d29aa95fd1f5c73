"""Fixtures of the suite."""

import gymnasium
import pettingzoo
import pytest

from dual_ur10 import ids


@pytest.fixture
def registries():
    """What a test registers is forgotten after it."""
    found = [ids.TASKS, ids.FAILED_ENTRY_POINTS, gymnasium.registry]
    found += [pettingzoo.parallel_registry, pettingzoo.aec_registry]
    before = [set(each) for each in found]
    yield
    for registry, names in zip(found, before, strict=True):
        for name in set(registry) - names:
            del registry[name]
