"""Ids, tasks of one's own, and versions of a task beside each other."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import pettingzoo
import pytest

from dual_ur10 import policies
from dual_ur10.envs import dm_env, parallel_env
from dual_ur10.envs.core.setup import load_task
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError
from dual_ur10.ids import ENTRY_POINTS, env_id_of
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.signature import view_of_env
from dual_ur10.policies.training.settings import defaults
from dual_ur10.registration import register_task
from dual_ur10.sim2real.analysis.reconstruction import keywords_of
from dual_ur10.sim2real.recording.reader import read_run
from tests.policies.learned.checkpoints import parts

# Gymnasium warns of each version that is not the newest.
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date.*")

V0, V1 = "MyLab/Reach-v0", "MyLab/Reach-v1"


class Reach(SineTracking):
    """Task of a laboratory."""


class LaterReach(SineTracking):
    """Its next version, with another reward."""

    weights: ClassVar[Any] = {name: 2.0 * weight for name, weight in SineTracking.weights.items()}


@pytest.fixture
def register():
    """Return `register_task`; what it registers is forgotten after the test."""
    registries: list[dict[str, Any]] = [
        *(ENTRY_POINTS, gym.registry),
        *(pettingzoo.parallel_registry, pettingzoo.aec_registry),
    ]
    before = [set(each) for each in registries]
    yield register_task
    for registry, names in zip(registries, before, strict=True):
        for name in set(registry) - names:
            del registry[name]


@pytest.fixture
def both(register):
    """Register two versions of a task."""
    register(V0, f"{__name__}:Reach")
    register(V1, f"{__name__}:LaterReach")


@pytest.mark.parametrize(("env_id", "task"), [(V0, Reach), (V1, LaterReach)])
def test_a_version_has_its_own_class_in_every_interface(both, env_id, task):
    envs = [gym.make(env_id), gym.make_vec(env_id, num_envs=2), dm_env(env_id), parallel_env(env_id)]
    assert gym.spec(env_id).kwargs == {"task": env_id}
    for env in envs:
        inner = getattr(env, "unwrapped", env)
        core = getattr(inner, "core", None) or getattr(inner, "env", None) or inner._env
        core = getattr(core, "core", core)
        assert (type(core.task), core.setup.env_id) == (task, env_id)
        env.close()


@pytest.mark.parametrize("env_id", [V0, V1])
def test_records_and_checkpoints_are_of_their_version(both, env_id, tmp_path):
    env = gym.make(env_id, duration_s=0.4, record=str(tmp_path))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert view_of_env(env).signature.env_id == env_id
    env.close()
    (folder,) = [each for each in tmp_path.iterdir() if each.is_dir()]
    header = read_run(folder).header
    assert header.env_id == env_id
    with gym.make(header.env_id, **keywords_of(header)) as again:
        assert again.unwrapped.core.setup.env_id == env_id
    checkpoint.save(tmp_path / "x", *parts(env_id))
    assert checkpoint.read_manifest(tmp_path / "x").signature.env_id == env_id
    assert checkpoint.load(tmp_path / "x", env_id).manifest.signature.env_id == env_id
    other = V1 if env_id == V0 else V0
    with pytest.raises(CheckpointError, match=f"is of {env_id}, the environment is {other}"):
        checkpoint.load(tmp_path / "x", other)
    with pytest.raises(CheckpointError, match=f"was made for env_id '{env_id}', the environment has '{other}'"):
        checkpoint.load(tmp_path / "x", gym.make(other))


def test_a_version_of_our_own_task_has_no_policies_of_the_one_before(register):
    register("DualUR10/Handover-v1", "dual_ur10.envs.tasks.handover.task:Handover")
    assert isinstance(policies.load("scripted", "DualUR10/Handover-v0"), policies.Policy)
    for name in ("scripted", "learned"):
        with pytest.raises(UnknownNameError, match=f"unknown policy of DualUR10/Handover-v1 '{name}'"):
            policies.load(name, "DualUR10/Handover-v1")
    with pytest.raises(SettingsError, match="no settings of a training for DualUR10/Handover-v1"):
        defaults("DualUR10/Handover-v1")


def test_an_own_task_has_no_scripted_policy_and_no_settings(both):
    for name in policies.NAMES:
        with pytest.raises(UnknownNameError, match=f"unknown policy of {V0} '{name}': use the path of a checkpoint"):
            policies.load(name, V0)
    with pytest.raises(SettingsError, match=f"no settings of a training for {V0}.* DualUR10/SineTracking-v0"):
        defaults(V0, "ppo")


def test_a_name_without_a_version_is_the_newest(register):
    for version in (2, 10, 9):
        register(f"MyLab/Reach-v{version}", f"{__name__}:Reach")
    assert {env_id_of(name) for name in ("Reach", "MyLab/Reach", "Reach-v10")} == {"MyLab/Reach-v10"}
    assert env_id_of("Reach-v9") == "MyLab/Reach-v9"
    assert load_task("Reach-v2") is Reach
    with pytest.raises(UnknownNameError, match="unknown environment 'Reach-v3'"):
        env_id_of("Reach-v3")


def test_a_name_that_several_namespaces_have_needs_one(both, register):
    register("Other/Reach-v0", f"{__name__}:Reach")
    with pytest.raises(UnknownNameError, match="unknown environment 'Reach'") as caught:
        env_id_of("Reach")
    assert caught.value.allowed == (V0, V1, "Other/Reach-v0")
    assert env_id_of("Other/Reach") == "Other/Reach-v0"


def test_a_name_alone_stays_that_of_this_package(register):
    register("MyLab/Handover-v7", f"{__name__}:Reach")
    assert env_id_of("Handover") == "DualUR10/Handover-v0"
    assert env_id_of("MyLab/Handover") == env_id_of("Handover-v7") == "MyLab/Handover-v7"


def test_an_id_keeps_its_class(both, register):
    register(V0, f"{__name__}:Reach")  # again, as by a second import
    with pytest.raises(SettingsError, match="register a new version"):
        register(V0, f"{__name__}:LaterReach")
    assert load_task(V0) is Reach


@pytest.mark.parametrize("env_id", ["Reach", "Reach-v0", "MyLab/Reach", "MyLab/Reach-v01", "a/b/c-v0", "MyLab/Reach-v"])
def test_an_id_has_a_namespace_and_a_version(register, env_id):
    with pytest.raises(SettingsError, match="Namespace/Name-vN"):
        register(env_id, f"{__name__}:Reach")


def test_an_unknown_name_comes_with_the_nearest_one(both):
    with pytest.raises(UnknownNameError, match=r"'SineTrackin' \(did you mean 'DualUR10/SineTracking-v0'\?\): use one"):
        env_id_of("SineTrackin")
    with pytest.raises(UnknownNameError, match=r"'Rech-v1' \(did you mean 'MyLab/Reach-v1'\?\)"):
        env_id_of("Rech-v1")
    with pytest.raises(UnknownNameError, match="unknown environment 'Juggling': use one of"):
        env_id_of("Juggling")
