"""Task of an installed package of others on two emulated controllers in real time, one whole episode."""

import sys

import gymnasium as gym
import pettingzoo
import pytest

from dual_ur10 import ids
from dual_ur10.policies import load
from dual_ur10.testing import CellForTests
from tests.two_arm_tasks import install

pytestmark = pytest.mark.streams


@pytest.fixture(scope="module")
def _installed(tmp_path_factory):
    """Install the package into a folder of its own, and forget its tasks after the tests."""
    target = str(tmp_path_factory.mktemp("installed"))
    install(target)
    registries = ids.TASKS, gym.registry, pettingzoo.parallel_registry, pettingzoo.aec_registry
    before = [set(each) for each in registries]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(target)  # which the processes of an emulated cell inherit
        patch.setattr(ids, "_loaded", set(ids._loaded))
        yield
    for each, names in zip(registries, before, strict=True):
        for name in set(each) - names:
            del each[name]
    for name in [each for each in sys.modules if each.split(".")[0] == "two_arm_tasks"]:
        del sys.modules[name]


@pytest.mark.usefixtures("_installed")
def test_an_episode_in_real_time(tmp_path):
    with CellForTests(tmp_path, task="CupOnTray", plant="nominal") as cell:
        env_id = ids.env_id_of("CupOnTray")
        env, policy = cell.make(env_id), load("scripted", env_id, cell=cell.path)
        (observation, _), over = env.reset(seed=0), False
        while not over:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
        assert info["is_success"], info["end_reason"]
        assert not cell.fault
