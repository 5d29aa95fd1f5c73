"""Specifications of trainings."""

from __future__ import annotations

import dataclasses
import math

import pytest

from dual_ur10 import ENV_IDS
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training.settings import (
    CHECK_SEED,
    IMITATION,
    ActSettings,
    Imitation,
    Reinforcement,
    defaults,
    first_seed_of,
    task_settings,
)
from dual_ur10.sim2real.cell_file.reference import starting_text
from tests.policies.training.small import small

GENERAL_STEPS = {"ppo": 1_000_000, "sac": 300_000, "bc": 96_000, "dagger": 288_000}


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("algorithm", ["ppo", "sac", "bc", "dagger", "act"])
def test_every_task_has_settings_for_every_algorithm(env_id, algorithm):
    asked = defaults(env_id, algorithm)
    assert asked.env_id == env_id
    own = task_settings(env_id)
    assert asked.steps == {**GENERAL_STEPS, **own.steps}["bc" if algorithm == "act" else algorithm]
    shown = {"randomization": own.randomization, "action_latency_ticks": 5, **own.keywords}
    if algorithm == "act" and own.act.demonstrated:
        assert asked.demonstrated == {**shown, "action_mode": own.act.demonstrated}
        shown.pop("action_mode", None)
    assert asked.keywords == (shown if algorithm in IMITATION else own.from_scratch)
    assert asked.agents == ("joint" if algorithm in IMITATION else own.agents)
    kinds = {"ppo": Reinforcement, "sac": Reinforcement, "act": ActSettings}
    assert type(asked.settings) is kinds.get(algorithm, Imitation)
    if algorithm in IMITATION:
        usual = (*own.imitation.unseen, *own.joint_unseen)
        assert asked.settings.unseen == ((own.act.unseen or usual) if algorithm == "act" else usual)
    envs = min(own.envs, own.act.demonstrations) if algorithm == "act" else own.envs
    assert (asked.envs, asked.checks) == ((envs, own.checks) if algorithm in IMITATION else (64, 32))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_ppo_can_continue_what_imitation_made(env_id):
    made, asked = defaults(env_id, "dagger"), defaults(env_id, "ppo", init="policy")
    assert asked.keywords == made.keywords
    assert asked.agents == made.agents == "joint"
    assert asked.settings.hidden == made.settings.hidden


@pytest.mark.parametrize(("task", "keywords"), [("Handover", {}), ("SyncCarry", {}), ("SyncCarry", {"grasp": "rigid"})])
def test_ppo_from_scratch_sees_the_goals_alone(task, keywords):
    asked = defaults(task, "ppo", keywords=keywords)
    view = view_of(asked.env_id, asked.keywords)
    layout = view.layout
    seen = set(range(layout.size)) - set(view.indices(asked.settings.unseen, joint=False))
    goals = [field.name for field in GOAL_FIELDS if field.name in layout.names]
    assert len(goals) == len(GOAL_FIELDS) - 3 * ("grasp" in keywords)
    assert seen == set(layout.indices(goals))


@pytest.mark.parametrize("task", ["SineTracking", "SyncCarry", "Handover"])
def test_one_network_for_both_arms_imitates_without_goals(task):
    joint, shared = (defaults(task, "bc", agents) for agents in (None, "shared"))
    assert joint.agents == "joint"
    assert set(joint.settings.unseen) - set(shared.settings.unseen) == set(
        {"SineTracking": ("other_flange_base_m", "other_flange_base_quat")}.get(
            task, [each.name for each in GOAL_FIELDS]
        )
    )


def test_arguments_override_the_defaults():
    asked = defaults(
        "SyncCarry",
        "bc",
        "shared",
        envs=3,
        steps=4,
        seed=5,
        randomization="wide",
        keywords={"action_latency_ticks": 0, "grasp": "rigid"},
        changes={"hidden": (7,)},
    )
    assert (asked.agents, asked.envs, asked.steps, asked.seed) == ("shared", 3, 4, 5)
    assert asked.keywords == {"action_latency_ticks": 0, "grasp": "rigid", "randomization": "wide"}
    assert asked.settings == dataclasses.replace(task_settings("DualUR10/SyncCarry-v0").imitation, hidden=(7,))


@pytest.mark.parametrize(
    "wrong",
    [
        {"algorithm": "ppo2"},
        {"agents": "both"},
        {"changes": {"rounds": 1}},
        {"keywords": {"amplitud_m": 0.1}},
        {"changes": {"activation": "gelu"}},
        {"env_id": "Lift"},
    ],
)
def test_unknown_names_are_refused(wrong):
    with pytest.raises(UnknownNameError):
        defaults(**{"env_id": "SineTracking", **wrong})


@pytest.mark.parametrize(
    "wrong",
    [
        {"envs": 0},
        {"envs": True},
        {"steps": 0},
        {"steps": 1.5},
        {"seed": -1},
        {"seed": 2_000_000},
        {"changes": {"hidden": ()}},
        {"changes": {"hidden": (0,)}},
        {"changes": {"hidden": (5000,)}},
        {"changes": {"learning_rate": 0.0}},
        {"changes": {"learning_rate": math.nan}},
        {"changes": {"noise": -0.1}},
        {"changes": {"batch_size": 0}},
        {"changes": {"batch_size": 10.5}},
        {"changes": {"fit_steps": "many"}},
        {"changes": {"learning_rate": "fast"}},
        {"changes": {"hidden": 64}},
        {"changes": {"unseen": 3}},
        {"changes": {"unseen": (0.5,)}},
        {"changes": {"unseen": "q_rad"}},
        {"changes": {"patience": -1.0}},
        {"changes": {"scatter_rad": -0.01}},
        {"randomization": "mild", "keywords": {"randomization": "none"}},
        {"changes": {"expert_share": 1.5}},
        {"changes": {"learning_rate": 2.0}},
        {"changes": {"batch_size": 1}},
        {"changes": {"batch_size": True}},
        {"keywords": {"observation": "pixels"}},
    ],
)
def test_impossible_values_are_refused(wrong):
    with pytest.raises(SettingsError):
        defaults("SineTracking", "dagger", **wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"dataset": "a/b-v0"},
        {"changes": {"gamma": 2.0}},
        {"changes": {"gae_lambda": 1.1}},
        {"changes": {"critic_first": 1.5}},
        {"changes": {"target_kl": 0.0}},
        {"changes": {"gamma": 1.0, "differences": True}},
        {"envs": 1, "changes": {"steps_per_update": 1}},
    ],
)
def test_impossible_settings_of_ppo_are_refused(wrong):
    with pytest.raises(SettingsError):
        defaults("SineTracking", "ppo", **wrong)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "bc", "dagger"])
def test_nothing_is_trained_on_two_controllers(tmp_path, algorithm):
    path = tmp_path / "lab.toml"
    path.write_text(starting_text("emulated", None, None, "cb3", None, str(path)))
    with pytest.raises(SettingsError, match="is not simulated, and training is in simulation: train without"):
        defaults("SineTracking", algorithm, envs=1, randomization="none", keywords={"cell": str(path)})


def test_training_and_check_seeds_are_disjoint():
    shown = range(10_000)  # figures that are published begin at 0
    checks = range(CHECK_SEED, CHECK_SEED + 10_000)
    first, last = first_seed_of(0), first_seed_of(1_999_999) + 999_999
    assert shown.stop <= checks.start < checks.stop <= first < last < 2**63
    assert first_seed_of(1) - first_seed_of(0) == 1_000_000


def test_the_small_ones_of_these_tests_are_small():
    assert small().steps == 200
