"""Evaluation: seeded episodes, their summary and files, and the command."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from scipy.stats import binomtest

import dual_ur10
from dual_ur10 import CellConfig, Perturbation, errors, policies
from dual_ur10.ids import TASKS, TaskEntry
from dual_ur10.policies.evaluation.evaluate import evaluate
from dual_ur10.policies.evaluation.results import EpisodeResult, Evaluation, wilson_interval
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.policies.policy import EpisodeAware
from dual_ur10.policies.registry import load, shipped_folder
from tests.soak import scaled
from ur_core import files

SINE = "DualUR10/SineTracking-v0"
STUB = "Test/Stub-v0"
WILD = CellConfig(perturbation=Perturbation(jitter_s=0.004, loss=0.05, latency_s=0.002, mass_scale=1.03))


# The interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662), (0, 0, 0.0, 1.0)],
)
def test_interval_has_the_known_values(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-4)


counts = st.integers(1, 10_000).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials)))


@given(counts, st.floats(0.5, 0.999))
def test_interval_is_that_of_scipy(count: tuple[int, int], confidence: float) -> None:
    expected = binomtest(*count).proportion_ci(confidence, method="wilson")
    assert wilson_interval(*count, confidence) == pytest.approx((expected.low, expected.high), abs=1e-12)


@given(counts, st.integers(2, 50))
def test_interval_holds_the_rate_and_shrinks(count: tuple[int, int], more: int) -> None:
    low, high = wilson_interval(*count)
    assert 0.0 <= low <= count[0] / count[1] <= high <= 1.0
    narrow = wilson_interval(more * count[0], more * count[1])
    assert narrow[1] - narrow[0] < high - low


@pytest.mark.parametrize("arguments", [(-1, 3), (4, 3), (1, 3, 0.0), (1, 3, 1.0), (1, 3, math.nan)])
def test_interval_of_nonsense_is_refused(arguments: Any) -> None:
    with pytest.raises(errors.SettingsError):
        wilson_interval(*arguments)


# A real environment


PUSHES = np.resize(np.array([1, 1, -1, 0.5], dtype=np.float32), 12)


class Push:
    """Move both arms until the gate refuses: after a time that depends on their start."""

    def reset(self) -> None:
        """There is nothing to forget."""

    def __call__(self, observation: Any) -> Any:
        return np.tile(PUSHES, (len(observation), 1))


@pytest.mark.parametrize(
    ("policy", "keywords"),
    [
        ("scripted", {"duration_s": 1.2, "cell": WILD}),
        ("scripted", {"duration_s": 0.4, "policy_rate_hz": 125, "action_latency_ticks": 3}),
        ("random", {"duration_s": 1.2}),
        (Push(), {"duration_s": 4.0, "at_limits": "refuse"}),
    ],
    ids=["scripted", "fast", "random", "push"],
)
def test_no_number_depends_on_parallel_episodes(policy: Any, keywords: dict[str, Any]) -> None:
    episodes = 7 + scaled(60)
    alone = evaluate(SINE, policy, episodes=episodes, seed=3, num_envs=1, env_kwargs=keywords)
    assert [each.seed for each in alone.episodes] == list(range(3, 3 + episodes))
    assert len({each.total_reward for each in alone.episodes}) == episodes
    for num_envs, threads in ((3, 1), (8, 2), (64, 2)):
        more = {**keywords, "threads": threads}
        assert evaluate(SINE, policy, episodes=episodes, seed=3, num_envs=num_envs, env_kwargs=more).episodes == (
            alone.episodes
        )
    if isinstance(policy, Push):
        assert len({each.steps for each in alone.episodes}) > 1  # or rows would always begin at the same time
        assert all(re.search("distance|joint", each.ended_by) for each in alone.cut_short)
        assert alone.cut_short


class Mixed(Push):
    """The scripted policy, except `Push` for each third seed, so that rows begin one by one."""

    def __init__(self, keywords: dict[str, Any]) -> None:
        self.scripted = policies.load("scripted", SINE, **keywords)
        self.pushes: dict[int, bool] = {}

    def reset(self) -> None:
        self.scripted.reset()

    def begin(self, rows: Any, seeds: Sequence[int]) -> None:
        self.pushes.update((row, seed % 3 == 1) for row, seed in zip(rows.tolist(), seeds, strict=True))

    def __call__(self, observation: Any) -> Any:
        pushes = np.array([self.pushes[row] for row in range(len(observation))])
        return np.where(pushes[:, None], super().__call__(observation), self.scripted(observation))


def test_an_adaptive_policy_begins_single_rows() -> None:
    keywords = {"duration_s": 3.0, "cell": WILD, "at_limits": "refuse"}
    alone, three, eight = (
        evaluate(SINE, Mixed(keywords), episodes=9, num_envs=num_envs, env_kwargs=keywords).episodes
        for num_envs in (1, 3, 8)
    )
    assert alone == three == eight
    assert len({each.steps for each in alone}) > 2


class Winding:
    """Actions that grow with the time since the reset, regardless of observations."""

    def reset(self) -> None:
        self.calls = 0

    def __call__(self, observation: Any) -> Any:
        self.calls += 1
        return np.tile(PUSHES * np.float32(np.sin(self.calls / 20)), (len(observation), 1))


def test_a_stateful_policy_is_reset_for_every_episode() -> None:
    keywords = {"duration_s": 4.0, "at_limits": "refuse"}
    alone, three, eight = (
        evaluate(SINE, Winding(), episodes=10, num_envs=num_envs, env_kwargs=keywords).episodes
        for num_envs in (1, 3, 8)
    )
    assert alone == three == eight
    assert len({each.steps for each in alone}) > 2


def test_an_episode_equals_a_rollout() -> None:
    keywords = {"duration_s": 1.2, "cell": WILD}
    found = evaluate(SINE, "scripted", episodes=5, num_envs=3, env_kwargs=keywords)
    env = gym.make(SINE, **keywords)
    for seed, episode in enumerate(found.episodes):
        record = rollout(env, policies.load("scripted", SINE, **keywords), seed=seed)
        assert record.flange_error_m is not None
        assert (episode.seed, episode.success, episode.steps) == (seed, record.success, record.steps)
        assert episode.total_reward == pytest.approx(record.reward.sum(), rel=1e-12)
        assert episode.time_s == record.time_s[-1]
        for arm, name in enumerate(("left", "right")):
            assert episode.peak[f"flange_error_m/{name}"] == record.flange_error_m[:, arm].max()
            assert episode.last[f"flange_error_m/{name}"] == record.flange_error_m[-1, arm]
    env.close()


def test_a_policy_object_is_used_without_changes() -> None:
    keywords = {"duration_s": 0.4, "cell": WILD, "action_mode": "joint_position"}
    policy = policies.load("scripted", SINE, **keywords)
    given_one = evaluate(SINE, policy, episodes=4, num_envs=2, env_kwargs=keywords)
    by_name = evaluate(SINE, "scripted", episodes=4, num_envs=2, env_kwargs=keywords)
    assert given_one.policy == "SineTrackingPolicy"
    assert by_name.policy == "scripted"
    assert given_one.episodes == by_name.episodes
    assert given_one.success_rate == 1.0


def test_random_actions_differ_between_episodes() -> None:
    found = evaluate(SINE, "random", episodes=4, env_kwargs={"duration_s": 0.4, "randomize": False})
    assert len({each.total_reward for each in found.episodes}) == 4
    still = evaluate(SINE, "zero", episodes=4, env_kwargs={"duration_s": 0.4, "randomize": False})
    assert len({each.total_reward for each in still.episodes}) == 1


def test_an_evaluation_names_its_subject() -> None:
    found = evaluate(SINE, "zero", episodes=2, seed=9, env_kwargs={"duration_s": 0.2})
    assert (found.env_id, found.policy, found.kwargs, found.seed) == (SINE, "zero", {"duration_s": 0.2}, 9)
    assert found.versions["dual_ur10"] == dual_ur10.__version__
    assert found.versions["numpy"] == np.__version__
    assert set(found.versions) == {"dual_ur10", "mujoco", "gymnasium", "numpy"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"episodes": 2.0}, "episodes is 2.0"),
        ({"episodes": True}, "episodes is True"),
        ({"seed": -1}, "seed is -1"),
        ({"num_envs": 0}, "num_envs is 0"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"env_kwargs": {"num_envs": 3}}, "keyword num_envs"),
        ({"env_kwargs": {"autoreset_mode": "NextStep"}}, "keyword autoreset_mode"),
        ({"env_kwargs": {"task": "Juggling"}}, "keyword task"),
        ({"env_kwargs": {"amplitud": 1}}, "DualUR10/SineTracking-v0 got an unexpected keyword argument 'amplitud'"),
        (
            {"policy": "magic"},
            "unknown policy 'magic': use one of 'scripted', 'learned', 'learned-two-agents', 'random', 'zero'",
        ),
        ({"env_id": "DualUR10/Juggling-v0"}, "unknown environment 'DualUR10/Juggling-v0'"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(errors.DualUR10Error, match=re.escape(message)):
        evaluate(**{"env_id": SINE, "policy": "scripted", "episodes": 1, **arguments})


# An environment with every kind of info


def stub_length(seed: int) -> int:
    return 3 + seed * 7 % 5


class Stub(VectorEnv[Any, Any, Any]):
    """Rows end after a time of their own. An observation is the seed and the step of its row.

    A seed that is reset again gives a huge reward, and an episode of one step or without an end: that none of it is
    kept can be seen.
    """

    made: Stub
    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self, num_envs: int, autoreset_mode: str, endless: int = -1, duration_s: float = 1.0, **others: Any
    ) -> None:
        assert autoreset_mode == "Disabled"
        type(self).made = self
        self.num_envs, self.endless = num_envs, endless
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (num_envs, 2), np.float32)
        task = SimpleNamespace(stages=("gripped", "handed over"), settings=SimpleNamespace(duration_s=duration_s))
        config, timing = SimpleNamespace(controllers=False), SimpleNamespace(period_s=0.5)
        self.core = SimpleNamespace(config=config, timing=timing, task=task, stop=lambda reason: None)
        self.seeds, self.steps = np.full(num_envs, -1), np.zeros(num_envs, dtype=int)
        self.done, self.again = np.ones(num_envs, dtype=bool), np.zeros(num_envs, dtype=bool)
        self.known: set[int] = set()
        self.order: list[int] = []

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        mask = options["reset_mask"]
        assert mask.all() or (mask == self.done).all()
        for row in np.flatnonzero(mask).tolist():
            self.again[row] = seed[row] in self.known
            self.known.add(seed[row])
            if not self.again[row]:
                self.order.append(seed[row])
            self.seeds[row], self.steps[row], self.done[row] = seed[row], 0, False
        return self.observation(), {"force_n": np.full(self.num_envs, 1e6), "_force_n": mask}

    def observation(self) -> Any:
        return np.stack([self.seeds, self.steps], axis=1).astype(np.float64)

    def step(self, actions: Any) -> Any:
        assert not self.done.any()
        assert actions.dtype == np.float32
        assert actions.shape == (self.num_envs, 2)
        self.steps += 1
        n, seeds, steps, everyone = self.num_envs, self.seeds, self.steps, np.ones(self.num_envs, dtype=bool)
        lengths = np.array([stub_length(int(each)) for each in seeds])
        over = np.where(self.again, seeds % 2 == 0, (steps == lengths) & (seeds != self.endless))
        refused = over & (seeds % 4 == 1)
        diverged = over & (seeds % 4 == 2)
        self.done = over
        text = np.full(n, None, dtype=object)
        text[refused], text[diverged] = "too close", "diverged"
        # Stage 2 is reached in between by seeds that are multiples of 3, and lost again.
        stage = np.where((seeds % 3 == 0) & (steps == 2), 2, seeds % 2)
        sometimes = steps % 2 == 1
        info = {
            "is_success": over & (seeds % 4 == 0),
            "_is_success": over,
            "stage": stage,
            "_stage": everyone,
            "force_n": np.where(self.again, 1e9, -10.0 * seeds - steps),
            "_force_n": everyone,
            "gap_m": np.stack([steps * 1.0, -steps * 2.0], axis=1),
            "_gap_m": sometimes,
            "late_s": np.where(steps == 2, 7.0, np.nan),
            "_late_s": everyone,
            "never_s": np.full(n, np.nan),
            "_never_s": everyone,
            "wild_rad": np.where(seeds == 5, np.inf, 1.0),
            "_wild_rad": everyone,
            "q_rad": np.zeros((n, 2, 6)),
            "_q_rad": everyone,
            "count_n": np.ones(n, dtype=int),
            "_count_n": everyone,
            "share": np.ones(n),
            "_share": everyone,
            "name_m": np.full(n, "x", dtype=object),
            "_name_m": everyone,
        }
        if (seeds == 6).any():
            info |= {"rare_m": np.ones(n), "_rare_m": seeds == 6}
        reasons = np.where(refused, "refused/distance", np.where(diverged, "physics", "time")).astype(object)
        if over.any():
            info |= {"end_reason": np.where(over, reasons, None), "_end_reason": over}
        if refused.any():
            info |= {"safety": text, "_safety": refused}
        if diverged.any():
            info |= {"physics_error": text, "_physics_error": diverged}
        reward = np.where(self.again, 1e9, seeds + 0.25)
        return self.observation(), reward, refused | diverged, over & ~refused & ~diverged, info


class Watching:
    """A policy that checks its notifications against its observations."""

    def __init__(self) -> None:
        self.resets = 0
        self.begun: list[tuple[int, int]] = []
        self.expected: dict[int, int] = {}

    def reset(self) -> None:
        self.resets += 1

    def begin(self, rows: Any, seeds: Sequence[int]) -> None:
        self.begun += zip(rows.tolist(), seeds, strict=True)
        self.expected = dict(zip(rows.tolist(), seeds, strict=True))

    def __call__(self, observation: Any) -> Any:
        first = {row: int(seed) for row, (seed, step) in enumerate(observation) if step == 0}
        assert first == self.expected
        self.expected = {}
        return np.zeros((len(observation), 2))


@pytest.fixture(autouse=True)
def stub() -> Iterator[None]:
    gym.register(STUB, entry_point=lambda: None, vector_entry_point=Stub)
    TASKS[STUB] = TaskEntry(task="no:Task")
    yield
    del gym.registry[STUB], TASKS[STUB]


def stub_evaluation(**arguments: Any) -> Evaluation:
    return evaluate(STUB, Watching(), **{"episodes": 9, "num_envs": 4, **arguments})


def test_every_episode_counts_once_in_the_order_of_seeds() -> None:
    alone = stub_evaluation(num_envs=1)
    assert [each.steps for each in alone.episodes] == [stub_length(seed) for seed in range(9)]
    assert [each.time_s for each in alone.episodes] == [0.5 * stub_length(seed) for seed in range(9)]
    assert [each.total_reward for each in alone.episodes] == [(s + 0.25) * stub_length(s) for s in range(9)]
    assert [each.success for each in alone.episodes] == [seed % 4 == 0 for seed in range(9)]
    assert [each.ended_by for each in alone.episodes] == (["", "too close", "diverged", ""] * 3)[:9]
    assert [each.end_reason for each in alone.episodes][:4] == ["time", "refused/distance", "physics", "time"]
    assert list(alone.end_reasons.items()) == [("time", 5), ("physics", 2), ("refused/distance", 2)]
    for num_envs in (2, 3, 4, 8, 9, 50):
        found = stub_evaluation(num_envs=num_envs)
        assert found.episodes == alone.episodes
        assert Stub.made.order == list(range(9))
        assert Stub.made.num_envs == min(num_envs, 9)
        assert found.as_table().row_count == alone.as_table().row_count


def test_numbers_of_info_are_kept_with_their_peaks() -> None:
    episode = stub_evaluation(seed=3, episodes=4).episodes[1]  # seed 4, 6 steps
    assert stub_length(4) == 6
    assert episode.peak == {
        "force_n": 46.0,
        "gap_m/left": 5.0,
        "gap_m/right": 10.0,
        "late_s": 7.0,
        "wild_rad": 1.0,
    }
    assert episode.last == {
        "force_n": -46.0,
        "gap_m/left": 5.0,
        "gap_m/right": -10.0,
        "late_s": None,
        "wild_rad": 1.0,
    }


def test_info_of_one_row_stays_out_of_the_others() -> None:
    for num_envs in (1, 4):
        found = stub_evaluation(num_envs=num_envs)
        assert [each.seed for each in found.episodes if "rare_m" in each.peak] == [6]
        assert [each.seed for each in found.episodes if "wild_rad" not in each.peak] == [5]
        assert found.spreads["rare_m"].largest == 1.0


def test_stages_that_were_reached_count_even_if_lost_again() -> None:
    found = stub_evaluation()
    assert [each.stage for each in found.episodes] == [seed % 2 for seed in range(9)]
    assert [each.best_stage for each in found.episodes] == [2, 1, 0, 2, 0, 1, 2, 1, 0]
    assert found.stages == ("gripped", "handed over")
    assert found.stage_scores == {"gripped": 6 / 9, "handed over": 3 / 9}
    without = evaluate(SINE, "zero", episodes=1, env_kwargs={"duration_s": 0.2})
    assert (without.episodes[0].stage, without.stages, without.stage_scores) == (None, (), {})


def test_a_policy_is_notified_of_every_beginning() -> None:
    policy = Watching()
    assert isinstance(policy, EpisodeAware)
    evaluate(STUB, policy, episodes=9, num_envs=4)
    assert policy.begun[:4] == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert policy.resets == 1  # these episodes never begin at the same time again
    evaluate(STUB, policy, episodes=9, num_envs=1)
    assert policy.resets == 1 + 9


def test_other_policies_begin_all_rows_together() -> None:
    class Counting:
        resets = 0

        def reset(self) -> None:
            self.resets += 1

        def __call__(self, observation: Any) -> Any:
            return np.zeros((len(observation), 2))

    for num_envs, waves in ((1, 9), (3, 3), (4, 3), (9, 1)):
        policy = Counting()
        found = evaluate(STUB, policy, episodes=9, num_envs=num_envs, max_steps=7)
        assert found.episodes == stub_evaluation().episodes
        assert policy.resets == waves
        assert len(Stub.made.order) == 9


def test_an_endless_episode_is_an_error_but_an_idle_row_is_not() -> None:
    for num_envs in (1, 4):
        with pytest.raises(errors.DualUR10Error, match="seed 5 has not ended after 40 steps \\(20 s\\)"):
            stub_evaluation(num_envs=num_envs, max_steps=40, env_kwargs={"endless": 5})
        assert Stub.made.closed
    with pytest.raises(errors.DualUR10Error, match="after 1200 steps"):
        stub_evaluation(episodes=1, env_kwargs={"endless": 0})
    with pytest.raises(errors.DualUR10Error, match="after 4000 steps"):
        stub_evaluation(episodes=1, env_kwargs={"endless": 0, "duration_s": 1000.0})
    # The last rows to run leave the others with an endless episode of the stub's; the longest has 7 steps.
    assert len(stub_evaluation(max_steps=7).episodes) == 9
    with pytest.raises(errors.DualUR10Error, match="after 6 steps"):
        stub_evaluation(max_steps=6)


@pytest.mark.parametrize("num_envs", [1, 4])
def test_progress_equals_smaller_evaluations(num_envs: int) -> None:
    seen: list[Evaluation] = []
    whole = stub_evaluation(num_envs=num_envs, on_progress=seen.append)
    sizes = [len(each.episodes) for each in seen]
    assert sizes == sorted(set(sizes))
    assert sizes[-1] == 9
    assert len(sizes) > 3
    assert seen[-1] == whole
    for each in seen:
        assert each == stub_evaluation(episodes=len(each.episodes), num_envs=1)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_each_step_counts_as_its_ratio_of_an_episode(num_envs: int) -> None:
    done: list[float] = []
    evaluate(SINE, "zero", episodes=4, num_envs=num_envs, env_kwargs={"duration_s": 0.4}, on_step=done.append)
    together = [min(num_envs, 4 - first) for first in range(0, 4, num_envs)]  # zero holds nothing from step to step
    rises = np.diff([0.0, *done])
    np.testing.assert_allclose(rises, np.repeat([each / 10 for each in together], 10), atol=1e-12)


def test_the_environment_is_closed_when_the_policy_fails() -> None:
    class Broken(Watching):
        def __call__(self, observation: Any) -> Any:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        evaluate(STUB, Broken(), episodes=1)
    assert Stub.made.closed


def test_a_plain_function_is_a_policy() -> None:
    def pushing(observation: Any) -> Any:
        return 0.01 * np.tanh(observation[:12])

    found = evaluate("SineTracking", pushing, episodes=3, num_envs=2, env_kwargs={"duration_s": 0.4})
    assert (found.env_id, found.policy) == (SINE, "pushing")
    env = gym.make(SINE, duration_s=0.4)
    alone = [rollout(env, pushing, seed=seed).reward.sum() for seed in range(3)]
    env.close()
    assert [each.total_reward for each in found.episodes] == pytest.approx(alone)
    assert len({*alone}) == 3


@pytest.mark.parametrize(
    ("policy", "text"),
    [
        (3, "int is no policy: found no reset and no __call__"),
        (Watching, "Watching is no policy: found a class, not an object of it"),
        (type("Late", (), {"__call__": lambda *_: 0.0})(), "Late is no policy: found no reset; .* a plain function"),
    ],
)
def test_what_is_no_policy_is_refused_before_an_environment_is_made(
    policy: Any, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gym, "make_vec", None)
    with pytest.raises(errors.PolicyError, match=text):
        evaluate(SINE, policy, episodes=1)
    with pytest.raises(errors.PolicyError, match=text):
        rollout(None, policy)


# What the episodes say together


def episode(seed: int, success: bool = True, time_s: float = 1.0, **values: Any) -> EpisodeResult:
    return EpisodeResult(seed=seed, success=success, total_reward=float(seed), steps=10, time_s=time_s, **values)


def evaluation(*episodes: EpisodeResult, **values: Any) -> Evaluation:
    plain: dict[str, Any] = {"env_id": SINE, "policy": "scripted", "kwargs": {}, "seed": 0, "stages": ()}
    return Evaluation(**{**plain, "versions": {}, "episodes": episodes, **values})


def test_rates_times_and_returns() -> None:
    found = evaluation(*(episode(k, k != 3, 1.0 + k) for k in range(11)))
    assert (found.successes, found.success_rate, found.mean_return) == (10, 10 / 11, 5.0)
    assert found.interval == wilson_interval(10, 11)
    assert found.std_return == pytest.approx(math.sqrt(10))
    assert (found.median_time_s, found.p90_time_s) == (6.5, pytest.approx(10.1))
    none = evaluation(episode(0, False))
    assert (none.median_time_s, none.p90_time_s) == (None, None)


def test_spreads() -> None:
    found = evaluation(
        episode(0, peak={"x_m": 3.0, "y_m": 1.0}, last={"x_m": -2.0, "y_m": None}),
        episode(1, peak={"x_m": 1.0}, last={"x_m": 1.0}),
    ).spreads
    assert (found["x_m"].largest, found["x_m"].median, found["x_m"].last) == (3.0, 2.0, 1.5)
    assert (found["y_m"].largest, found["y_m"].median, found["y_m"].last) == (1.0, 1.0, None)


def test_an_evaluation_needs_an_episode() -> None:
    with pytest.raises(errors.SettingsError):
        evaluation()


def test_the_table_has_every_figure() -> None:
    found = replace(stub_evaluation(), policy="[b]me[/b]")
    console = Console(file=io.StringIO(), width=120)
    console.print(found.as_table())
    text = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO
    for words in (
        "Test/Stub-v0, [b]me[/b], 9 episodes from seed 0",
        "3 of 9, 33.3 %",
        "12.1 % to 64.6 %",
        "reached: handed over",
        "2.00 s",
        "seed 1: too close",
        "force, N",
        "gap/left, mm",
    ):
        assert words in text
    assert re.search(r"cut short\s*│\s*4 ", text)
    assert re.search(r"ended: refused/distance\s*│\s*2 ", text)


def test_a_summary_prints_as_a_table_and_is_a_dict() -> None:
    summary = stub_evaluation().summary()
    lines = str(summary).splitlines()
    assert lines[0].startswith("Test/Stub-v0, Watching, 9 episodes from seed 0")
    assert any(re.fullmatch(r"│ success +│ +3 of 9, 33.3 % │", line) for line in lines)
    assert max(map(len, lines)) <= 100
    assert f"{summary}" == str(summary)
    assert json.loads(json.dumps(summary)) == dict(summary)
    assert summary["successes"] == 3


def test_json_is_complete_and_independent_of_the_rows(tmp_path: Path) -> None:
    for num_envs in (1, 4):
        stub_evaluation(num_envs=num_envs, episodes=4).to_json(tmp_path / f"{num_envs}.json")
    text = (tmp_path / "1.json").read_text()
    assert text == (tmp_path / "4.json").read_text()
    data = json.loads(text)
    assert [each["return"] for each in data["episodes"]] == [(s + 0.25) * stub_length(s) for s in range(4)]
    assert data["episodes"][1]["ended_by"] == "too close"
    assert data["summary"]["success_rate"] == 0.25
    assert data["summary"]["success_interval"] == list(wilson_interval(1, 4))
    assert data["stages"] == ["gripped", "handed over"]
    assert data["versions"]["dual_ur10"] == dual_ur10.__version__


def test_json_takes_every_keyword(tmp_path: Path) -> None:
    kwargs = {"cell": WILD, "axis": (0, 1, np.float32(0.5)), "a": np.arange(2), "f": print, "i": math.inf, "n": None}
    evaluation(episode(0), kwargs=kwargs).to_json(tmp_path / "x.json")
    found = json.loads((tmp_path / "x.json").read_text())["kwargs"]
    assert found["cell"]["type"] == "CellConfig"
    assert found["cell"]["perturbation"]["loss"] == 0.05
    assert (found["axis"], found["a"], found["n"], found["i"]) == ([0, 1, 0.5], [0, 1], None, "inf")
    assert found["f"] == "<builtin_function_or_method>"


def test_csv_has_a_row_per_episode(tmp_path: Path) -> None:
    found = stub_evaluation()
    found = replace(found, episodes=(*found.episodes[:8], replace(found.episodes[8], ended_by='a, "b"\nc')))
    found.to_csv(tmp_path / "x.csv")
    with (tmp_path / "x.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["seed"]) for row in rows] == list(range(9))
    assert [float(row["return"]) for row in rows] == [each.total_reward for each in found.episodes]
    assert [row["peak/rare_m"] for row in rows] == ["", "", "", "", "", "", "1.0", "", ""]
    assert rows[0]["last/late_s"] == ""
    assert float(rows[4]["last/force_n"]) == -46.0
    assert rows[8]["ended_by"] == 'a, "b"\nc'


@pytest.mark.parametrize("kind", ["name", "folder", "policy"])
def test_a_learned_policy_gets_the_latency_that_it_was_made_for(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    folder = shipped_folder("learned", SINE)
    policy: Any = {"name": "learned", "folder": str(folder), "policy": load(folder)}[kind]
    short = {"duration_s": 0.4, "threads": 1, "max_episode_steps": 50}
    found = evaluate(SINE, policy, episodes=1, env_kwargs=short)
    assert found.kwargs == {**short, "action_latency_ticks": 5}
    assert found.successes == 1
    other = {**short, "action_latency_ticks": 4}
    if kind == "policy":  # which its user may try anywhere
        caplog.clear()
        for _ in range(2):
            evaluate(SINE, policy, episodes=1, env_kwargs=other)
        (record,) = caplog.records
        assert "rate.latency_ticks was 5 and is 4; duration_s was 30.0 and is 0.4" in record.message
    else:
        with pytest.raises(errors.CheckpointError, match="latency_ticks 5, the environment has 4"):
            evaluate(SINE, policy, episodes=1, env_kwargs=other)
    assert "action_latency_ticks" not in evaluate(SINE, "zero", episodes=1, env_kwargs=short).kwargs


def test_a_carry_that_never_begins_ends_with_its_reason() -> None:
    found = evaluate("DualUR10/SyncCarry-v0", "zero", episodes=2, num_envs=2)
    assert [(each.end_reason, each.ended_by) for each in found.episodes] == [("bar_lost", "bar_lost")] * 2
    assert found.end_reasons == found.summary()["end_reasons"] == {"bar_lost": 2}
    limited = evaluate("DualUR10/SyncCarry-v0", "zero", episodes=2, num_envs=2, env_kwargs={"max_episode_steps": 3})
    assert limited.end_reasons == {"time": 2}
    assert not limited.cut_short


# Files


@pytest.mark.parametrize("write", [Evaluation.to_json, Evaluation.to_csv])
def test_a_file_is_replaced_at_once_or_not_at_all(write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, link = tmp_path / "x", tmp_path / "link"
    path.write_text("before")
    link.symlink_to(path)

    def full(_: int) -> None:
        assert path.read_text() == "before"
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with pytest.raises(errors.DualUR10Error, match="no space left"):
            write(evaluation(episode(0)), path)
    assert path.read_text() == "before"
    assert sorted(tmp_path.iterdir()) == [link, path]
    with path.open() as reader:
        write(evaluation(episode(0)), str(link))
        assert reader.read() == "before"
    assert "before" not in path.read_text()
    assert link.is_symlink()
    assert sorted(tmp_path.iterdir()) == [link, path]


def test_the_unfinished_file_of_another_writer_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder shared by containers two processes may have the same id, and names may coincide by chance."""
    parts = []

    def full(_: int) -> None:
        parts.extend(tmp_path.glob(".*.part"))
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        patch.setattr(files, "secrets", SimpleNamespace(token_hex=lambda size: "1"), raising=False)
        with pytest.raises(errors.DualUR10Error, match="no space left"):
            files.write_text(tmp_path / "x", "mine")
        parts[0].write_text("theirs")
        with pytest.raises(errors.DualUR10Error, match="File exists"):
            files.write_text(tmp_path / "x", "mine")
    assert parts[0].read_text() == "theirs"
    files.write_text(tmp_path / "x", "mine")
    assert (tmp_path / "x").read_text() == "mine"
    assert sorted(tmp_path.iterdir()) == [parts[0], tmp_path / "x"]


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path, reason in (
        (tmp_path / "none" / "x.json", "does not exist"),
        (tmp_path, "no regular file"),
        (Path("/dev/null"), "no regular file"),
        (tmp_path / "loop" / "x.json", "cannot write"),
    ):
        with pytest.raises(errors.DualUR10Error, match=reason):
            evaluation(episode(0)).to_json(path)
