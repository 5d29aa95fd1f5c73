"""Fixtures of the suite."""

import functools

import gymnasium
import pettingzoo
import pytest

from dual_ur10 import ids
from tests.alone import built_of


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


@pytest.fixture(scope="session")
def wheel_of(tmp_path_factory):
    """Return a function that returns the wheel of the distribution in a folder, which it builds once."""
    return functools.cache(lambda root: built_of(root, "wheel", tmp_path_factory.mktemp("wheel")))
