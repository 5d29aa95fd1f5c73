"""Evaluation of a policy over many seeded episodes on the vector environment.

Every number depends on the policy, the environment's keywords and the seeds alone, not on the number of parallel
episodes or of threads. Row and order of an episode are no part of its result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10.envs.core.ends import details_of, early_end
from dual_ur10.envs.core.options import AS_ON_CONTROLLERS, MOVE_TO_START
from dual_ur10.errors import DualUR10Error, ResetRefusedError, SettingsError
from dual_ur10.ids import __version__
from dual_ur10.policies.baselines import RandomPolicy, ZeroPolicy
from dual_ur10.policies.chunks.chunk_policy import ChunkPolicy
from dual_ur10.policies.evaluation.results import EpisodeResult, Evaluation
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.learned.checkpoint import warn_outside
from dual_ur10.policies.policy import (
    EpisodeAware,
    FunctionPolicy,
    Policy,
    as_policy,
    close_policy,
    is_alone,
    policy_name,
)
from dual_ur10.policies.registry import (
    check_name,
    env_id_beside,
    executed,
    keywords_for,
    load_named,
    provenance,
    setup_of,
    wrong_types_named,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array, Mask

UNITS = ("_m", "_rad", "_n", "_s")
"""Endings of the names of values in `info` whose largest and last value an episode keeps."""

_LONGEST_S = 600.0  # simulated time after which an episode counts as endless, unless its task is longer
_OWN = ("id", "task", "num_envs", "vectorization_mode", "autoreset_mode", "vector_kwargs", "wrappers")
_RECORD = ("record", "record_failure", "record_about")  # recording does not change the results
_PACKAGES = ("mujoco", "gymnasium", "numpy")


def evaluate(
    env_id: str,
    policy: Policy | ChunkPolicy | Callable[[Any], Any] | str,
    *,
    episodes: int = 300,
    seed: int = 0,
    num_envs: int = 8,
    env_kwargs: Mapping[str, Any] | None = None,
    max_steps: int | None = None,
    move_to_start: bool = False,
    on_progress: Callable[[Evaluation], None] | None = None,
    on_step: Callable[[float], None] | None = None,
    on_episode: Callable[[EpisodeResult, Array], None] | None = None,
) -> Evaluation:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and return their results.

    With an `EpisodeAware` policy, a row whose episode ends begins the next one at once. For any other policy all rows
    begin together, and it is reset then. Its own detection of new episodes is not relied upon: an episode that begins
    much like the state in which the previous one ended would inherit the policy's memory. The policy always receives
    the observations of all rows; an idle row repeats its last episode without any effect on the results.

    Args:
        env_id: Id of the environment, or its short form.
        policy: A policy that takes batches; or a chunk policy, or a plain function from an observation to an action,
            which are called with each row; or a name, one of `dual_ur10.policies.NAMES`, "random" or "zero"; or the
            folder of a checkpoint, made for this environment; or "module:Class", as for `load`.
        episodes: Number of episodes, 1 or more.
        seed: Seed of the first episode, 0 or more.
        num_envs: Number of parallel episodes. A server, and a chunk policy without a true attribute `stateless`, may
            keep the state of one episode: theirs run one at a time.
        env_kwargs: Keywords of the environment. Unless they state them, it has those that a learned policy needs, as
            of `dual_ur10.policies.make`. They include `threads` and `max_episode_steps` of its vector form. With
            `record`, `num_envs` must be 1: only one cell can be recorded.
        max_steps: Steps after which an episode that has not ended is an error. None: 600 s of simulated time, or twice
            the task's `duration_s` if that is longer.
        move_to_start: Consent to the motion of both arms to the start of every episode, on a cell of two controllers;
            as in the options of a reset, only the first episode needs none. It has no effect in simulation.
        on_progress: Callback with the evaluation of all leading episodes that have ended, as it would be without the
            others. Called whenever their number grows.
        on_step: Callback after each step with the number of episodes that have run, where one that is running counts
            as the elapsed ratio of its longest time.
        on_episode: Callback with the result of each episode and its actions, (k, D), in the order of their ends.

    Raises:
        SettingsError: A number is out of its range, the evaluation itself sets a keyword, or environment and policy are
            exchanged.
        UnknownNameError: No such environment, policy or keyword.
        PolicyError: The policy is none.
        ResetRefusedError: Several episodes on a cell of two controllers lack consent. Nothing has moved.
        DualUR10Error: An episode did not end within `max_steps`, or the policy or the environment failed.
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("num_envs", num_envs, 1)):
        check_whole(name, value, least)
    if max_steps is not None:
        check_whole("max_steps", max_steps, 1)
    env_id = env_id_beside(policy, env_id)
    if isinstance(policy, str):
        check_name(policy)
    given = keywords_for(policy, env_id, dict(env_kwargs or {}))
    if not isinstance(policy, str):
        policy = as_policy(executed(policy, lambda: setup_of(env_id, given)))
    if given.get("record") is not None:
        given = {"record_about": provenance(policy, env_id), **given}
    keywords = {name: value for name, value in given.items() if name not in _RECORD}
    actor = load_named(policy, env_id, keywords)  # before anything is connected or a folder of the run is made
    try:
        env = _make(env_id, 1 if is_alone(policy if actor is None else actor) else min(num_envs, episodes), given)
    except BaseException:
        close_policy(actor)  # a server takes one client at a time
        raise
    try:
        actor = actor_of(policy, env) if actor is None else actor
        core = env.unwrapped.core
        bound = _bound(core, max_steps)
        if episodes > 1 and core.config.controllers and not (move_to_start or core.options.confirm is not None):
            raise ResetRefusedError(
                f"{episodes} episodes on a cell of two controllers move both arms to where each of them begins, and "
                "that needs your consent: pass evaluate(..., move_to_start=True), or confirm= in env_kwargs, which is "
                "asked before each such motion. Nothing has moved"
            )

        def result(found: Sequence[EpisodeResult]) -> Evaluation:
            return Evaluation(
                env_id=env_id,
                policy=policy_name(policy),
                kwargs=keywords,
                seed=int(seed),
                stages=tuple(getattr(core.task, "stages", ())),
                episodes=tuple(found),
                versions={"dual_ur10": __version__, **{name: version(name) for name in _PACKAGES}},
                late_actions=getattr(core, "late_actions", 0),
            )

        def report(found: Sequence[EpisodeResult]) -> None:
            if on_progress is not None:
                on_progress(result(found))

        seeds = range(seed, seed + episodes)
        return result(_run(env, actor, seeds, core.timing.period_s, bound, move_to_start, report, on_step, on_episode))
    finally:
        env.close()
        if isinstance(policy, str):
            close_policy(actor)


def _run(
    env: Any,
    actor: Policy,
    seeds: range,
    period_s: float,
    max_steps: int,
    move_to_start: bool,
    report: Callable[[Sequence[EpisodeResult]], None],
    on_step: Callable[[float], None] | None,
    on_episode: Callable[[EpisodeResult, Array], None] | None,
) -> list[EpisodeResult]:
    horizon = getattr(env.unwrapped.core.task, "horizon", None) or math.inf
    n, kind, one_by_one = env.num_envs, env.single_action_space.dtype, isinstance(actor, EpisodeAware)
    tally = _Tally(n)
    current = list(range(n))  # index into `seeds` of the episode in each row
    upcoming, reported = n, 0
    live, fresh = np.ones(n, dtype=bool), np.ones(n, dtype=bool)
    found: list[EpisodeResult | None] = [None] * len(seeds)
    played: list[list[Array]] = [[] for _ in range(n)]
    observation: Any = None
    while live.any():
        if fresh.any():
            options = {"reset_mask": fresh, MOVE_TO_START: move_to_start}
            observation, _ = env.reset(seed=[seeds[k] for k in current], options=options)
            tally.begin(fresh)
            if fresh.all():
                actor.reset()
            if isinstance(actor, EpisodeAware):
                rows = np.flatnonzero(fresh)
                actor.begin(rows, [seeds[current[row]] for row in rows.tolist()])
        action = act(actor, observation, env, kind)
        if on_episode is not None:
            for row in np.flatnonzero(live).tolist():
                played[row].append(action[row].copy())
        observation, reward, terminated, truncated, info = env.step(action)
        tally.add(reward, info)
        fresh = terminated | truncated
        for row in np.flatnonzero(fresh & live).tolist():
            ended = found[current[row]] = tally.episode(row, seeds[current[row]], period_s, info)
            live[row] = False
            if on_episode is not None:
                on_episode(ended, np.array(played[row]))
                played[row].clear()
        if one_by_one or not live.any():
            for row in np.flatnonzero(~live).tolist()[: len(seeds) - upcoming]:
                current[row], upcoming, live[row] = upcoming, upcoming + 1, True
                fresh = fresh if one_by_one else np.ones(n, dtype=bool)
        if on_step is not None:
            running = tally.steps[live & ~fresh] / horizon
            on_step(sum(each is not None for each in found) + float(running.sum()))
        endless = ~fresh & (tally.steps >= max_steps)  # an idle row runs shorter than an active one
        if endless.any():
            raise DualUR10Error(
                f"the episode with seed {seeds[current[int(endless.argmax())]]} has not ended after {max_steps} steps "
                f"({max_steps * period_s:g} s): allow more with max_steps, or end it with max_episode_steps"
            )
        leading = reported
        while leading < len(found) and found[leading] is not None:
            leading += 1
        if leading > reported:
            reported = leading
            report([each for each in found[:leading] if each is not None])
    return [each for each in found if each is not None]


class _Tally:
    """Running totals of the episodes in n rows."""

    def __init__(self, n: int) -> None:
        self._n = n
        self.steps = np.zeros(n, dtype=np.int64)
        self._reward = np.zeros(n)
        self._stage, self._best_stage = np.full(n, -1), np.full(n, -1)  # -1: none was reported
        self._peak: dict[str, Array] = {}
        self._last: dict[str, Array] = {}

    def begin(self, rows: Mask) -> None:
        """Begin episodes in the masked rows."""
        self.steps[rows] = 0
        self._reward[rows] = 0.0
        self._stage[rows] = self._best_stage[rows] = -1
        for values in (*self._peak.values(), *self._last.values()):
            values[rows] = np.nan

    def add(self, reward: Array, info: Mapping[str, Any]) -> None:
        """Add one step of all rows."""
        self.steps += 1
        self._reward += reward
        for name, value in info.items():
            if name == "stage":
                known = info["_stage"]
                self._stage = np.where(known, value, self._stage)
                self._best_stage = np.maximum(self._best_stage, self._stage)
            elif self._is_kept(name, value):
                if name not in self._peak:
                    self._peak[name], self._last[name] = (np.full(value.shape, np.nan) for _ in range(2))
                known = info["_" + name].reshape(self._n, *[1] * (value.ndim - 1))
                finite = known & np.isfinite(value)
                self._peak[name] = np.where(finite, np.fmax(self._peak[name], np.abs(value)), self._peak[name])
                self._last[name] = np.where(known, value, self._last[name])

    def _is_kept(self, name: str, value: Any) -> bool:
        """Return True for a float with a unit for each row, or for each arm of each row."""
        if name.startswith("_") or not name.endswith(UNITS) or not isinstance(value, np.ndarray):
            return False
        return value.dtype.kind == "f" and value.shape in ((self._n,), (self._n, len(ARMS)))

    def episode(self, row: int, seed: int, period_s: float, info: Mapping[str, Any]) -> EpisodeResult:
        """Return the episode that has ended in a row with this `info`."""
        steps, staged = int(self.steps[row]), self._best_stage[row] >= 0
        # A name that only another row's info had is no part of this episode.
        peak = {name: value for name, value in _by_name(self._peak, row).items() if math.isfinite(value)}
        last = {name: value for name, value in _by_name(self._last, row).items() if name in peak}
        ended = details_of(info, row)
        return EpisodeResult(
            seed=seed,
            success=bool("is_success" in info and info["_is_success"][row] and info["is_success"][row]),
            total_reward=float(self._reward[row]),
            steps=steps,
            time_s=steps * period_s,
            end_reason=str(ended.get("end_reason", "")),
            ended_by=early_end(ended),
            stage=int(self._stage[row]) if staged else None,
            best_stage=int(self._best_stage[row]) if staged else None,
            peak=peak,
            last={name: value if math.isfinite(value) else None for name, value in last.items()},
        )


def _by_name(values: Mapping[str, Array], row: int) -> dict[str, float]:
    """Return a row's values by name, one entry per arm where there is one value for each."""
    result: dict[str, float] = {}
    for name in sorted(values):
        names = [name] if values[name].ndim == 1 else [f"{name}/{arm}" for arm in ARMS]
        result.update(zip(names, np.atleast_1d(values[name][row]).tolist(), strict=True))
    return result


def check_whole(name: str, value: object, least: int) -> None:
    """Check that an argument is a whole number.

    Raises:
        SettingsError: It is not, or below the least one.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise SettingsError(f"{name} is {value!r}: it must be a whole number, {least} or more")


def _bound(core: Any, max_steps: int | None) -> int:
    if max_steps is not None:
        return int(max_steps)
    task = core.task
    duration_s = getattr(task, "duration_s", getattr(task.settings, "duration_s", 0.0))
    longest_s = max(_LONGEST_S, 2.0 * float(duration_s))
    return math.ceil(longest_s / float(core.timing.period_s))


def _make(env_id: str, num_envs: int, keywords: Mapping[str, Any]) -> Any:
    """Make the vector environment, without automatic resets."""
    for name in _OWN:
        if name in keywords:
            raise SettingsError(f"the keyword {name} is set by the evaluation: leave it out")
    with wrong_types_named(env_id):
        return gym.make_vec(
            env_id,
            num_envs=num_envs,
            vectorization_mode="vector_entry_point",
            autoreset_mode="Disabled",
            **{**AS_ON_CONTROLLERS, **keywords},
        )


def actor_of(policy: Policy | str, env: Any) -> Policy:
    """Return the policy that acts in a vector environment: a baseline by its name, the policy, or a function's rows.

    Args:
        policy: A policy, or the name of a baseline.
        env: The vector environment.

    Raises:
        PolicyError: It is no policy.
    """
    warn_outside(policy, env)
    if policy == "random":
        return RandomPolicy(env.single_action_space, env.num_envs)
    if isinstance(policy, FunctionPolicy):
        return policy.of_rows(env.observation_space)
    return ZeroPolicy(env.action_space) if policy == "zero" else as_policy(policy)
