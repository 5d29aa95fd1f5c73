"""Ids, tasks of one's own, and versions of a task beside each other."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import subprocess
import sys
from dataclasses import replace
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

import dual_ur10
from dual_ur10 import ids, policies
from dual_ur10.envs import dm_env, parallel_env
from dual_ur10.envs.core.setup import load_task
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError
from dual_ur10.follower import home_of, make_follower
from dual_ur10.ids import TASKS, env_id_of
from dual_ur10.policies import evaluate
from dual_ur10.policies.baselines import ZeroPolicy
from dual_ur10.policies.evaluation.check import check_policy
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.signature import view_of_env
from dual_ur10.policies.policy import as_policy
from dual_ur10.policies.scripted.sine_tracking import SineTrackingPolicy
from dual_ur10.policies.training.settings import Imitation, Reinforcement, TaskSettings, defaults, task_settings
from dual_ur10.registration import register as register_task
from dual_ur10.sim2real.analysis.reconstruction import keywords_of
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.trajectory import JointTrajectory
from tests.policies.learned.checkpoints import parts
from ur_core import objects

# Gymnasium warns of each version that is not the newest.
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date.*")

V0, V1 = "MyLab/Reach-v0", "MyLab/Reach-v1"


class Reach(SineTracking):
    """Task of a laboratory."""


class LaterReach(SineTracking):
    """Its next version, with another reward."""

    weights: ClassVar[Any] = {name: 2.0 * weight for name, weight in SineTracking.weights.items()}


@pytest.fixture
def register(registries):
    """Return `register`; what it registers is forgotten after the test."""
    return register_task


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
    assert defaults("DualUR10/Handover-v1").settings == Imitation()


def test_a_task_that_brings_nothing_has_its_base_class_s_script_and_general_settings(both):
    assert policies.registry.names_for(V0) == ["scripted"]
    assert type(policies.load("scripted", V0)) is SineTrackingPolicy
    assert evaluate(V0, "scripted", episodes=1, env_kwargs={"duration_s": 0.4}).env_id == V0
    for name in ids.LEARNED_NAMES:
        with pytest.raises(UnknownNameError, match=f"unknown policy of {V0} '{name}': use one of 'scripted', or rand"):
            policies.load(name, V0)
    asked = defaults(V0, "ppo")
    assert (asked.settings, asked.steps, asked.agents) == (Reinforcement(), 1_000_000, "joint")


class Tracking(SineTrackingPolicy):
    """Scripted policy of the laboratory."""


def test_a_decorator_registers_a_class_with_what_belongs_to_it(register):
    mine = TaskSettings(steps={"bc": 77}, imitation=Imitation(hidden=(9,)))
    assert register(V0, scripted={"joint_position": "Tracking"}, training=mine)(Reach) is Reach
    assert load_task("Reach") is Reach
    assert type(policies.load("scripted", V0, action_mode="joint_position")) is Tracking
    with pytest.raises(SettingsError, match="is for joint_position, not for 'tcp_delta'"):
        policies.load("scripted", V0, action_mode="tcp_delta")
    asked = defaults(V0, "bc")
    assert (asked.steps, asked.settings.hidden) == (77, (9,))
    assert evaluate(V0, "scripted", episodes=1, env_kwargs={"action_mode": "joint_position"}).success_rate == 1.0
    register(V1, scripted=Tracking, learned={"learned": "dual_ur10.policies.learned:learned_policies/sine_tracking"})(
        LaterReach
    )
    assert policies.registry.names_for(V1) == ["scripted", "learned"]
    with pytest.raises(CheckpointError, match="is of DualUR10/SineTracking-v0"):
        policies.load("learned", V1)


@pytest.mark.parametrize(
    ("keywords", "text"),
    [
        ({"scripted": "not a class"}, "must be a class"),
        ({"scripted": {"": 3}}, "must be a class"),
        ({"training": "a b"}, "must be a class"),
        ({"learned": {"learned": "no folder"}}, "must be package:folder"),
        ({"learned": {"best": "x:y"}}, "unknown learned policy of MyLab/Reach-v0 'best'"),
    ],
)
def test_bad_registrations_are_refused(register, keywords, text):
    with pytest.raises((SettingsError, UnknownNameError), match=text):
        register(V0, **keywords)(Reach)
    assert V0 not in TASKS


def test_a_class_within_a_function_cannot_be_registered(register):
    class Local(SineTracking):
        pass

    with pytest.raises(SettingsError, match="defined within a class or function"):
        register(V0)(Local)


def test_the_namespace_of_this_package_is_its_own(register):
    with pytest.raises(SettingsError, match="namespace DualUR10 is that of this package"):
        register("DualUR10/Reach-v0")(Reach)


def test_what_is_registered_is_checked_when_it_is_needed(register):
    register(V0, "no_such_module_here:Reach", training="no_such_module_here:PPO")
    register(V1, f"{__name__}:Tracking", training=f"{__name__}:V0")
    with pytest.raises(SettingsError, match=r"the task of MyLab/Reach-v0.* cannot be imported: ModuleNotFoundError"):
        gym.make(V0)
    with pytest.raises(SettingsError, match=r"is no subclass of dual_ur10.envs.tasks.task.Task"):
        gym.make(V1)
    with pytest.raises(SettingsError, match="must be a TaskSettings"):
        task_settings(V1)


PACKAGE = """
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.policies.policy import as_policy
from dual_ur10.policies.scripted.sine_tracking import SineTrackingPolicy
from dual_ur10.registration import register

@register("Plugin/Wave-v0", scripted=SineTrackingPolicy)
class Wave(SineTracking):
    pass
"""


@pytest.fixture
def installed(register, tmp_path, monkeypatch):
    """Install a task, another with the same id, and modules that cannot be imported; return their folder."""
    (tmp_path / "wave_task.py").write_text(PACKAGE)
    (tmp_path / "wave_again.py").write_text(PACKAGE)
    (tmp_path / "waves-1.dist-info").mkdir()
    (tmp_path / "waves-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: waves\nVersion: 1\n")
    (tmp_path / "waves-1.dist-info" / "entry_points.txt").write_text(
        "[dual_ur10.tasks]\nbroken = no_such_module_here\nends = ends_it\nwrong = wrong_syntax\n"
        "wave = wave_task\nwave_again = wave_again\n"
    )
    (tmp_path / "ends_it.py").write_text("import sys\nsys.exit(3)\n")
    (tmp_path / "wrong_syntax.py").write_text("(\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(ids, "_loaded", set())
    yield tmp_path
    for name in ("wave_task", "wave_again"):
        sys.modules.pop(name, None)


def test_tasks_of_installed_packages_are_found_by_an_unknown_name(installed):
    assert env_id_of("Wave") == "Plugin/Wave-v0"
    assert policies.load("scripted", "Plugin/Wave-v0").timing.period_s == 0.04
    failed = ids.FAILED_ENTRY_POINTS
    assert sorted(each.split()[0] for each in failed) == ["broken", "ends", "wave_again", "wrong"]
    assert failed["ends = ends_it"] == "SystemExit: 3"
    assert failed["wrong = wrong_syntax"].startswith("SyntaxError: '(' was never closed")
    assert "registered by another package" in failed["wave_again = wave_again"]
    with pytest.raises(UnknownNameError, match="the tasks of broken = no_such_module_here are missing, ModuleNotFound"):
        env_id_of("Wav1")


def _joint_vec_env(name):
    pytest.importorskip("stable_baselines3")
    from dual_ur10.envs.api.sb3_bridge import JointVecEnv

    return JointVecEnv(name, 1)


@pytest.mark.parametrize(
    "name", ["Plugin/Wave-v0", "Plugin/Wave", "Wave-v0", "Wave", "wave_task:Plugin/Wave-v0", "wave_task:Wave"]
)
@pytest.mark.parametrize(
    "entry",
    [
        lambda name: policies.load("scripted", name),
        lambda name: policies.make("scripted", name)[0].close(),
        lambda name: evaluate(name, "zero", episodes=1, env_kwargs={"duration_s": 0.12}),
        lambda name: parallel_env(name).close(),
        lambda name: _joint_vec_env(name).close(),
        lambda name: check_policy(ZeroPolicy(Box(-1, 1, (12,), np.float32)), name, steps=1),
        lambda name: defaults(name, "bc"),
    ],
    ids=["load", "make", "evaluate", "parallel_env", "JointVecEnv", "check_policy", "defaults"],
)
def test_every_entry_takes_every_name_of_an_installed_task(installed, name, entry):
    entry(name)


def test_ctrl_c_in_a_package_names_it_and_ends_the_program(installed, caplog):
    (installed / "ends_it.py").write_text("raise KeyboardInterrupt\n")
    with pytest.raises(KeyboardInterrupt):
        env_id_of("Wave")
    assert "interrupted in the entry point ends = ends_it" in caplog.text


def test_the_command_line_knows_tasks_of_installed_packages(installed):
    command = [sys.executable, "-m", "dual_ur10"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), *sys.path])}
    done = subprocess.run([*command, "list"], env=environment, capture_output=True, text=True, timeout=120)
    assert "Plugin/Wave-v0" in done.stdout
    assert "the entry point broken = no_such_module_here failed" in " ".join(done.stdout.split())
    assert done.returncode == 0
    assert "the entry point ends = ends_it failed: SystemExit: 3" in " ".join(done.stdout.split())


def test_a_name_may_begin_with_the_module_that_registers_it(installed):
    assert env_id_of("wave_task:Plugin/Wave-v0") == "Plugin/Wave-v0"
    assert gym.make("wave_task:Plugin/Wave-v0").unwrapped.core.setup.env_id == "Plugin/Wave-v0"
    with pytest.raises(SettingsError, match="module 'no_such_module_here', which is to register 'A/B-v0', cannot be"):
        env_id_of("no_such_module_here:A/B-v0")
    for name, error in (("ends_it", "SystemExit"), ("wrong_syntax", "SyntaxError"), ("..", "TypeError"), ("", "Val")):
        with pytest.raises(SettingsError, match=f"module '{name}'.* cannot be imported: {error}"):
            env_id_of(f"{name}:A/B-v0")
        with pytest.raises(SettingsError, match=f"the policy.* cannot be imported: {error}"):
            objects.load_object(f"{name}:Policy", "the policy")


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
    with pytest.raises(SettingsError, match=f"'Reach' is ambiguous: it may be '{V0}' or '{V1}' or 'Other/Reach-v0'"):
        env_id_of("Reach")
    assert env_id_of("Other/Reach") == "Other/Reach-v0"


def test_a_name_alone_stays_that_of_this_package(register):
    register("MyLab/Handover-v7", f"{__name__}:Reach")
    assert env_id_of("Handover") == "DualUR10/Handover-v0"
    assert env_id_of("MyLab/Handover") == env_id_of("Handover-v7") == "MyLab/Handover-v7"


def test_an_id_keeps_its_class(both, register):
    register(V0, f"{__name__}:Reach")  # again, as by a second import
    with pytest.raises(SettingsError, match="or a new version"):
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


PUBLIC = {
    "dual_ur10": {"envs", "errors", "follower", "policies", "tasks", "testing"},
    "dual_ur10.envs": set(),
    "ur_core.kinematics": set(),
    "dual_ur10.policies": set(),
    "dual_ur10.sim2real.trajectory": set(),
    "dual_ur10.tasks": set(),
    "dual_ur10.testing": {"emulated_cell", "pytest_configure", "virtual_cell"},
    "ur_emulator.testing": {"pytest_configure", "ur_controller"},
}
"""Public modules, and names of each beside `__all__`: modules, fixtures and hooks."""


@pytest.mark.parametrize("name", PUBLIC)
def test_dir_shows_what_is_public(name):
    module = importlib.import_module(name)
    needed = PUBLIC[name] if name.endswith(".testing") else set()  # pytest finds hooks and fixtures by it
    assert {*module.__all__, *needed} <= set(dir(module)) <= {*module.__all__, *PUBLIC[name]}
    for each in dir(module):
        getattr(module, each)


def test_dir_of_the_errors_shows_errors_alone():
    from dual_ur10 import errors

    public = [getattr(errors, name) for name in dir(errors)]
    assert len(public) > 40
    assert all(issubclass(each, errors.DualUR10Error) for each in public)


def test_objects_say_what_they_are():
    with gym.make("DualUR10/SineTracking-v0", amplitude_m=0.05) as env:
        made, core = env.unwrapped, env.unwrapped.core
        task = "SineTracking(amplitude_m=0.05)"
        about = f"DualUR10/SineTracking-v0, {task}, joint_delta at 25 Hz, mujoco cell"
        assert [repr(made), repr(made.task)] == [f"DualArmEnv({about})", task]
        assert repr(core.task.layout).startswith(
            f"ObservationLayout({core.task.layout.size} numbers of an arm: q_rad 6, "
        )
        zero = ZeroPolicy(env.action_space)
    scripted = policies.load("scripted", "DualUR10/SineTracking-v0", amplitude_m=0.05)
    assert repr(scripted) == "SineTrackingPolicy(amplitude_m=0.05, joint_delta at 25 Hz)"
    assert [repr(zero), repr(as_policy(len))] == ["ZeroPolicy((12,))", "FunctionPolicy(len)"]
    follower = policies.load("scripted", "DualUR10/Handover-v0", action_mode="tcp_delta")
    assert repr(follower) == "GoalFollower(Handover, tcp_delta at 25 Hz)"
    with contextlib.closing(parallel_env("Handover")) as pair:
        assert repr(pair) == "DualArmParallelEnv(DualUR10/Handover-v0, Handover(), joint_delta at 25 Hz, mujoco cell)"


def test_every_kind_of_environment_says_what_it_is():
    about = "DualUR10/SineTracking-v0, SineTracking(duration_s=1.0), joint_delta at 25 Hz, mujoco cell"
    with contextlib.closing(gym.make_vec("DualUR10/SineTracking-v0", num_envs=2, duration_s=1.0)) as vector:
        assert [repr(vector), repr(vector.core)] == [f"DualArmVectorEnv(2 × {about})", f"Core({about})"]
    with contextlib.closing(dm_env("SineTracking", duration_s=1.0)) as env:
        assert repr(env) == f"DualArmDmEnv({about})"
    pytest.importorskip("stable_baselines3")
    from dual_ur10.envs.api.sb3_bridge import TwoAgentVecEnv

    with contextlib.closing(TwoAgentVecEnv("SineTracking", 2, duration_s=1.0)) as rows:
        assert repr(rows) == f"TwoAgentVecEnv(2 × {about})"


def test_results_say_in_a_line_what_they_are():
    env, policy = policies.make("zero", "SineTracking", duration_s=1.0)
    with env:
        found = policies.rollout(env, policy, seed=3)
    assert re.fullmatch(r"Record\(25 steps, return -?[\d.]+, (no )?success\)", repr(found))
    assert repr(replace(found, ended_by="bar_lost", success=False)).endswith(", no success, ended by bar_lost)")
    found = evaluate("DualUR10/SineTracking-v0", "zero", episodes=2, seed=5, env_kwargs={"duration_s": 1.0})
    count = f"success {found.successes} of 2"
    assert repr(found) == f"Evaluation(DualUR10/SineTracking-v0, zero, {count}, seeds from 5)"


def test_settings_and_trajectories_show_what_was_chosen():
    assert repr(dual_ur10.CellConfig()) == "CellConfig()"
    assert repr(dual_ur10.CellConfig(speed_rad_s=0.5, meshes=True)) == "CellConfig(meshes=True, speed_rad_s=0.5)"
    points = JointTrajectory(("left",), np.array([0.0, 1.5]), np.zeros((2, 1, 6)))
    assert repr(points) == "JointTrajectory(left, 2 points, 1.5 s)"
    with make_follower("mujoco") as follower:
        follower.start(home_of("mujoco"))
        assert repr(follower) == "TrajectoryExecutor(MujocoCell, at rest)"
    assert repr(follower) == "TrajectoryExecutor(MujocoCell, closed)"
