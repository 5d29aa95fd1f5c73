"""Audit of a task: what makes it unlearnable or dishonest."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import env_id_of
from dual_ur10.policies.evaluation.audit import rules
from dual_ur10.policies.evaluation.audit.cheats import cheats_of
from dual_ur10.policies.evaluation.audit.episodes import FLOORS, SCRIPT, AuditEpisode, Behaviour, Job, run
from dual_ur10.policies.evaluation.audit.probes import on_actions, on_randomization
from dual_ur10.policies.evaluation.audit.report import SEVERITIES, AuditFinding, AuditReport
from dual_ur10.policies.evaluation.evaluate import check_whole, evaluate
from dual_ur10.policies.policy import Policy, as_policy
from dual_ur10.policies.registry import load, load_named

_OWN: Final = ("observation", "on_refusal", "randomization", "record", "reward", "threads", "num_envs")
_LONGEST_S: Final = 60.0  # of an episode whose task ends none
_CUT: Final = 1.05  # times the script's steps, after which episodes of a quick audit end
_ROWS: Final = 8
_MORE: Final = 2  # seeds of the script and of the floors beside those of cheats


def audit(
    env_id: str,
    *,
    cheats: Mapping[str, Policy | Callable[[Any], Any] | str] | None = None,
    episodes: int = 1,
    seed: int = 0,
    quick: bool = False,
    on_progress: Callable[[float], None] = lambda ratio: None,
    **env_kwargs: Any,
) -> AuditReport:
    """Audit a task in simulation: find what makes it unlearnable, or a success in it worthless.

    Its rules are on the page "What makes these tasks learnable". Zero and random actions must earn little of what the
    script earns, and no episode that fails nearly as much as success. The reward must not fall when a stage is passed.
    Every number of the action, every field of the observation and every range must change something. No cheat may
    succeed: one arm alone, grippers that never close, arms exchanged, actions of another seed, and more. A finding
    whose subject is in `Task.accepted` is a note, with the reason given there.

    Args:
        env_id: Id of the environment, or its short form.
        cheats: Further cheats by name, each a policy as for `evaluate`, or "module:Class".
        episodes: Seeds of each cheat; the script, and zero and random actions have two more.
        seed: First seed.
        quick: One seed of each, fewer cheats, and no episode longer than 1.05 times the script's; the last rewards then
            stand for those of the missing steps.
        on_progress: Callback with the ratio of episodes that have run.
        **env_kwargs: Keywords of the environment. The audit sets some itself.

    Raises:
        UnknownNameError: No such environment or keyword.
        SettingsError: A number is out of its range, a keyword is not legal or set by the audit, or the cell is not
            simulated with physics.
        PolicyError: A further cheat is no policy.
        TaskError: A reward or an observation of the task is not finite.
    """
    env_id = env_id_of(env_id)
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        check_whole(name, value, least)
    for name in _OWN:
        if name in env_kwargs:
            raise SettingsError(f"the keyword {name} is set by the audit: leave it out")
    if env_kwargs.get("action_mode") == "joint_position":
        raise SettingsError("action_mode is 'joint_position': the audit stops arms by actions of 0, use 'joint_delta'")
    if env_kwargs.get("action_mode") == "tcp_translation":
        raise SettingsError(
            "action_mode is 'tcp_translation': the audit closes grippers by a seventh number of -1, use 'tcp_delta'"
        )
    for policy in (cheats or {}).values():  # before anything runs
        load_named(policy if isinstance(policy, str) else as_policy(policy), env_id, env_kwargs)
    given = _Audit(env_id, dict(env_kwargs), episodes, seed, quick, on_progress)
    return given.report(cheats or {})


class _Audit:
    """One audit.

    Args:
        env_id: Id of the environment.
        keywords: Its keywords.
        episodes: Seeds of each cheat.
        seed: First seed.
        quick: See `audit`.
        on_progress: See `audit`.
    """

    def __init__(
        self,
        env_id: str,
        keywords: dict[str, Any],
        episodes: int,
        seed: int,
        quick: bool,
        on_progress: Callable[[float], None],
    ) -> None:
        self._env_id, self._keywords, self._episodes, self._seed = env_id, keywords, episodes, seed
        self._quick, self._on_progress = quick, on_progress
        self._stepped, self._taken_s, self._done = 0, 0.0, 0.0
        with self._make(1) as env:
            core = env.core
            if core.config.kind != "mujoco":
                raise SettingsError(f"the cell is {core.config.kind!r}: the audit is for cell='mujoco'")
            self._task, self._layout = core.task, core.task.layout
            self._weights = {name: core.weights[name] for name in core.task.weights}
            self._longest = core.task.horizon or math.ceil(_LONGEST_S / core.timing.period_s)

    @contextmanager
    def _make(self, n: int, **keywords: Any) -> Iterator[DualArmVectorEnv]:
        env = DualArmVectorEnv(n, self._env_id, autoreset_mode="Disabled", **{**self._keywords, **keywords})
        try:
            yield env
        finally:
            env.close()

    def _script(self) -> Policy:
        return load("scripted", self._env_id, **self._keywords)

    def _run(
        self, behaviours: Mapping[str, Behaviour], seeds: Sequence[int], most: int, until: float, **keywords: Any
    ) -> list[AuditEpisode]:
        """Run an episode of each behaviour with each seed, of at most some steps.

        Args:
            behaviours: By name.
            seeds: Seeds of each.
            most: Steps after which an episode is cut short.
            until: Ratio of the audit that is over then.
            **keywords: Keywords of the environment.
        """
        jobs = [Job(name, behaviour, each) for name, behaviour in behaviours.items() for each in seeds]
        rounds = math.ceil(len(jobs) / _ROWS)
        script = self._script if any(each.scripted for each in behaviours.values()) else None
        with self._make(math.ceil(len(jobs) / rounds), max_episode_steps=most, **keywords) as env:
            begin_s = time.perf_counter()
            begin, rest = self._done, until - self._done
            found = run(env, jobs, script, most, lambda done: self._show(begin + rest * done / len(jobs)))
            self._taken_s += time.perf_counter() - begin_s
        self._stepped += sum(each.steps for each in found)
        return found

    def _show(self, ratio: float) -> None:
        self._done = ratio
        self._on_progress(ratio)

    def report(self, further: Mapping[str, Any]) -> AuditReport:
        """Run everything, and return the report."""
        findings, first = on_randomization(self._make, self._seed)
        self._show(0.03)
        script: list[AuditEpisode] = []
        more = 0 if self._quick else _MORE
        seeds = range(self._seed, self._seed + self._episodes + more)
        if not self._weights:
            findings.append(
                AuditFinding(
                    severity="note",
                    rule="returns",
                    subject="reward",
                    found="the task has no reward: returns, camping, stages, observations and cheats are not audited",
                )
            )
        else:
            try:
                self._script()
            except UnknownNameError:
                findings.append(
                    AuditFinding(
                        severity="warning",
                        rule="script",
                        subject="missing",
                        found="no script is registered: returns, camping, stages and cheats are not audited",
                        limit="one script",
                        remedy='Register one, @register("MyLab/Task-v0", scripted="TaskPolicy")',
                    )
                )
            else:
                script = self._run({"script": SCRIPT}, seeds, self._longest, 0.15, **AS_ON_CONTROLLERS)
        findings += on_actions(self._make, self._seed, script[0] if script else None)
        horizon = self._task.horizon or 2 * max((each.steps for each in script), default=self._longest // 2)
        most = min(horizon, math.ceil(_CUT * max(each.steps for each in script))) if self._quick and script else horizon
        found = rules.AuditedEpisodes(script, [], [], horizon, self._task.stages, self._weights, self._task.layout)
        if self._weights:
            found = found._replace(floors=self._run(FLOORS, seeds, most, 0.3))
        if script:
            made = cheats_of(self._task.stages, script[0], quick=self._quick)
            tried = range(self._seed + 1, self._seed + 1 + self._episodes)
            found = found._replace(cheats=self._run(made, tried, most, 0.95, **AS_ON_CONTROLLERS))
            for rule in (rules.on_returns, rules.on_camping, rules.on_stages, rules.on_cheats):
                findings += rule(found)
        if self._weights:
            findings += rules.on_observations(found, first)
        return self._concluded(found, findings, further)

    def _concluded(
        self, found: rules.AuditedEpisodes, findings: list[AuditFinding], further: Mapping[str, Any]
    ) -> AuditReport:
        """Try the further cheats, and return the report."""
        every = (*found.script, *found.floors, *found.cheats)
        successes = {
            name: (sum(each.success for each in every if each.name == name), sum(each.name == name for each in every))
            for name in dict.fromkeys(each.name for each in every)
        }
        for name, policy in further.items():
            tried = evaluate(
                self._env_id, policy, episodes=self._episodes, seed=self._seed + 1, env_kwargs=self._keywords
            )
            successes[name] = tried.successes, self._episodes
            findings += rules.on_success(name, tried.successes, self._episodes)
        rate = self._stepped / max(self._taken_s, 1e-9)
        if self._stepped:
            findings.append(
                AuditFinding(
                    severity="note",
                    rule="speed",
                    subject="steps",
                    found=f"{rate:.0f} steps of a cell per second, with the script, on this machine now",
                )
            )
        self._show(1.0)
        returns = found.returns()
        base = returns.get("script")
        judged = sorted(map(self._accepted, findings), key=lambda each: -SEVERITIES.index(each.severity))
        return AuditReport(
            env_id=self._env_id,
            kwargs=self._keywords,
            seed=self._seed,
            quick=self._quick,
            script_return=base,
            returns={name: each / base for name, each in returns.items()} if base else {},
            successes=successes,
            steps_per_s=rate,
            findings=tuple(judged),
        )

    def _accepted(self, finding: AuditFinding) -> AuditFinding:
        """Return a finding, as a note with the task's reason if that accepts it."""
        reason = self._task.accepted.get(finding.subject)
        if reason is None or finding.severity == "note":
            return finding
        return dataclasses.replace(finding, severity="note", remedy=f"Accepted: {reason}")
