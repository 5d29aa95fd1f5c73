"""Episodes that begin after a stage, and episodes that end after one."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.core.starts import MixedStarts
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.evaluation import script_states

HANDOVER, MODE = "DualUR10/Handover-v0", {"action_mode": "tcp_delta"}


@pytest.fixture(autouse=True)
def _one_episode(monkeypatch):
    monkeypatch.setattr(script_states, "EPISODES", 1)


def begun(n, **keywords):
    core = Core("Handover", {**MODE, **keywords}, n=n)
    observation, _ = core.reset([np.random.default_rng(seed) for seed in range(n)])
    return core, observation


def succeeded(core, observation, **keywords):
    """Return the number of steps in which goals are followed to success in all rows."""
    follower = policies.load("scripted", HANDOVER, **{**MODE, **keywords})
    success = np.zeros(core.n, dtype=bool)
    for count in range(core.task.horizon):
        step = core.step(follower(observation))
        observation = step.observation
        success |= step.info["is_success"]
        if success.all():
            return count + 1
    raise AssertionError(success)


def test_what_is_held_at_the_start_stays_where_it_is():
    core, _ = begun(6, starts={"lift": 0.5, "mutual_grasp": 0.5})
    begin_m, passed = core.state.objects["block"].position_m.copy(), core.task.passed.copy()
    assert {*passed} == {3, 5}
    for _ in range(10):
        step = core.step(np.tile([*[0.0] * 6, -1.0], (6, 2)))  # closed fingers
    moved_m = core.state.objects["block"].position_m - begin_m
    assert np.abs(moved_m).max() < 1e-3
    assert step.info["slip_m"].max() < 1e-3
    assert (step.info["stage"] == passed).all()


@pytest.mark.parametrize("stage", ["present", "release"])
def test_goals_lead_from_a_start_after_a_stage_to_success(stage):
    assert succeeded(*begun(2, starts={stage: 1.0})) < 250


def test_a_single_environment_begins_as_its_row_of_many():
    starts = {"lift": 0.4, "release": 0.3}
    many, together = begun(5, starts=starts)
    assert {0, 3, 6} == {*many.task.passed}
    action = np.full((5, 14), 0.125)
    after = many.step(action).observation
    for row in range(5):
        one = gym.make(HANDOVER, starts=starts, **MODE)
        observation, _ = one.reset(seed=row)
        assert np.array_equal(observation, together[row])
        assert np.array_equal(one.step(action[row].astype(np.float32))[0], after[row])


def test_starts_have_their_ratios():
    mixed = object.__new__(MixedStarts)
    mixed._most, mixed._of_stage = np.cumsum([0.2, 0.1]), [np.arange(5), np.array([5])]
    found = np.array([mixed._draw(np.random.default_rng(seed)) for seed in range(2000)])
    assert np.mean((found >= 0) & (found < 5)) == pytest.approx(0.2, abs=0.03)
    assert np.mean(found == 5) == pytest.approx(0.1, abs=0.02)
    assert {*found} == {*range(-1, 6)}


def test_normal_starts_beside_them_are_those_of_the_task():
    """A prop that a task leaves out lies where its scene has it, also where another row begins after a stage."""
    states = script_states.ScriptStates(
        np.array([7]),
        np.array([1]),
        np.ones((1, 2, 6)),
        np.ones((1, 2)),
        np.zeros((1, 2)),
        {"cup": np.full((1, 7), 2.0)},
        {},
        {"cup": np.full(7, 3.0)},
        {},
    )
    mixed = object.__new__(MixedStarts)
    mixed.states, mixed._draw = states, lambda rng: int(rng.integers(2)) - 1
    seen = []
    start = SimpleNamespace(q_rad=np.zeros((8, 2, 6)), gripper_m=np.full((8, 2), 0.5), objects={}, joints={})
    start._replace = lambda **values: SimpleNamespace(**values)
    task = SimpleNamespace(
        start=lambda rows, rngs: start, skip=lambda rows, passed: seen.extend(rows), declared_kg=np.zeros((8, 2))
    )
    found = mixed.begin(task, np.arange(8), [np.random.default_rng(seed) for seed in range(8)])
    held = np.isin(np.arange(8), seen)
    assert 0 < held.sum() < 8
    assert (found.objects["cup"][held] == 2.0).all()
    assert (found.objects["cup"][~held] == 3.0).all()
    assert (found.gripper_m[~held] == 0.5).all()
    assert (found.commanded_m[~held] == 0.5).all()
    assert (found.commanded_m[held] == 0.0).all()


def test_an_episode_ends_with_success_after_a_stage():
    """Steps of translation alone, at 12.5 Hz, are enough to lift a block that is not rotated."""
    keywords = {
        "action_mode": "tcp_translation",
        "until": "lift",
        "object_turn_rad": 0.0,
        "policy_rate_hz": 12.5,
    }
    core, observation = begun(2, **keywords)
    assert core.action_space.shape == (8,)
    assert succeeded(core, observation, **keywords) < 50
    assert (core.task.passed == 3).all()


@pytest.mark.parametrize(
    ("task", "keywords", "error", "message"),
    [
        ("Handover", {"starts": {"lfit": 0.2}}, UnknownNameError, "did you mean 'lift'"),
        ("Handover", {"starts": {"place": 0.2}}, UnknownNameError, "in starts"),  # it would be over
        ("Handover", {"starts": {"lift": 0.2}, "until": "lift"}, UnknownNameError, "'reach', 'grasp'"),
        ("Handover", {"starts": {"lift": 1.2}}, SettingsError, "at most 1"),
        ("Handover", {"starts": {"lift": 0.6, "present": 0.6}}, SettingsError, "add up to 1.2"),
        ("Handover", {"starts": {"lift": True}}, SettingsError, "must be a number"),
        ("Handover", {"starts": "lift"}, SettingsError, "must be a mapping"),
        ("Handover", {"starts": {}}, SettingsError, "must be a mapping"),
        ("Handover", {"starts": {"lift": 0.2}, "cell": "echo"}, SettingsError, "leave them out with this cell"),
        ("Handover", {"until": "lfit"}, UnknownNameError, "in until"),
        ("SyncCarry", {"starts": {"grasp": 0.2}}, SettingsError, "has none"),
        ("SineTracking", {"until": "lift"}, SettingsError, "has none"),
        (
            "Handover",
            {"action_mode": "tcp_translation", "action_scale": {"rotation": 0.5}},
            UnknownNameError,
            "'transl",
        ),
        ("Handover", {"progress_weight": -1.0}, SettingsError, "0 or more"),
        ("Handover", {"progress_weight": 1.0, "reward": "sparse"}, SettingsError, "no effect"),
        ("SyncCarry", {"path_speed": 1}, SettingsError, "True or False"),
    ],
)
def test_what_a_task_has_not_is_refused_before_anything_is_made(task, keywords, error, message):
    with pytest.raises(error, match=message):
        EnvSetup.resolve(task, keywords)


def test_a_stage_that_the_script_does_not_reach_is_refused(monkeypatch):
    monkeypatch.setattr(script_states, "_gathered", lambda core, policy, stages: ([], {}))
    with pytest.raises(SettingsError, match="leave 'lift' out of starts"):
        Core("Handover", {"starts": {"lift": 0.5}})
