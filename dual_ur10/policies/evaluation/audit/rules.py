"""Rules on the episodes of an audit: returns, camping, stages, observations and cheats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.envs.tasks.task import FINISH
from dual_ur10.policies.evaluation.audit.cheats import ONE_ARM, REPLAY
from dual_ur10.policies.evaluation.audit.episodes import FLOORS, AuditEpisode
from dual_ur10.policies.evaluation.audit.report import AuditFinding, Severity
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

FLOOR_RATIO: Final = 0.08
"""Largest return of zero and random actions, as a ratio of the script's."""

CAMPING_RATIO: Final = 1.1
"""Least ratio of the return of success to the largest one of an episode that fails."""

FALL: Final = 0.02
"""Largest fall of the reward of a step when a stage is passed, as a ratio of the largest reward of a step."""

_AROUND: Final = 5  # steps before and after a stage is passed
_END: Final = 10  # last steps of an episode that was cut short, which stand for those that are missing
_LEAST_USED: Final = 0.01  # of a field's bounds, below which it is noted
_SATURATED, _MOST_SATURATED = 0.95, 0.5  # a value of the concise view, and the ratio of steps with such values
_FLAT: Final = 1e-9


class AuditedEpisodes(NamedTuple):
    """All episodes of an audit, and what they are of.

    Attributes:
        script: Episodes of the script.
        floors: Episodes of zero and random actions.
        cheats: Episodes of cheats.
        horizon: Steps of an episode whose time runs out.
        stages: Names of the task's stages.
        weights: Weights of the reward terms.
        layout: Fields of an observation.
    """

    script: Sequence[AuditEpisode]
    floors: Sequence[AuditEpisode]
    cheats: Sequence[AuditEpisode]
    horizon: int
    stages: Sequence[str]
    weights: Mapping[str, float]
    layout: ObservationLayout

    def income(self, episode: AuditEpisode) -> float:
        """Return the return of an episode; of one that was cut short, with its last rewards for the missing steps."""
        cut = episode.cut and episode.steps < self.horizon
        return episode.earned + cut * float(episode.rewards[-_END:].mean()) * (self.horizon - episode.steps)

    def returns(self) -> dict[str, float]:
        """Return the mean return of each behaviour by name."""
        every = [*self.script, *self.floors, *self.cheats]
        return {
            name: float(np.mean([self.income(each) for each in every if each.name == name]))
            for name in dict.fromkeys(each.name for each in every)
        }


def on_returns(run: AuditedEpisodes) -> Iterator[AuditFinding]:
    """Find zero and random actions that earn much, and a script that fails or earns nothing."""
    returns, successes = run.returns(), sum(each.success for each in run.script)
    severity: Severity = "warning" if successes else "error"
    if successes < len(run.script):
        yield AuditFinding(
            severity=severity,
            rule="script",
            subject="success",
            found=f"{successes} of {len(run.script)} episodes succeed",
            limit="all of them",
            remedy="Mend the script, or the task: `python -m dual_ur10 evaluate` names the ends",
        )
    script = returns["script"]
    if script <= 0.0:
        yield AuditFinding(
            severity="error",
            rule="returns",
            subject="script",
            found=f"it earns {script:.3g}",
            limit="above 0",
            remedy="Let the reward grow with what the task asks for",
        )
        return
    for name in FLOORS:
        if returns[name] > FLOOR_RATIO * script:
            yield AuditFinding(
                severity="warning",
                rule="returns",
                subject=name,
                found=f"{name} actions earn {100 * returns[name] / script:.1f} % of the script's return",
                limit=f"{100 * FLOOR_RATIO:g} %",
                remedy="Pay less for what is so from the start, or happens by chance",
            )


def on_camping(run: AuditedEpisodes) -> Iterator[AuditFinding]:
    """Find an income without success that is nearly that of success."""
    success = float(np.mean([each.earned for each in run.script]))
    failed = [(run.income(each), f'"{each.name}"') for each in (*run.floors, *run.cheats) if not each.success]
    held = [each for episode in run.script for each in _held(run, episode)]
    income, text = max([*failed, *held], default=(0.0, "nothing"))
    if success < CAMPING_RATIO * income:
        yield AuditFinding(
            severity="warning",
            rule="camping",
            subject="income",
            found=f"success earns {success / max(income, 1e-9):.2f} times what {text} earns without it",
            limit=f"{CAMPING_RATIO:g} times",
            remedy="Pay more for the end (`quality` of a StagedTask), or less for each step before it",
        )
    rates = [(float(rate), k) for each in run.script for k, rate in enumerate(each.rewards[:-1])]
    if run.stages and rates:
        rate, at = max(rates)
        yield AuditFinding(
            severity="note",
            rule="camping",
            subject="rate",
            found=f"before success a step earns up to {rate:.2f} (step {at}), and the largest income without success "
            f"is {100 * income / success:.0f} % of that of success, by {text}",
        )


def _held(run: AuditedEpisodes, episode: AuditEpisode) -> Iterator[tuple[float, str]]:
    """Yield the income of holding each stage to the horizon once it is passed, but not the last one."""
    stage, earned = episode.numbers.get("stage"), np.cumsum(episode.rewards)
    if stage is None:
        return
    for number in range(1, len(run.stages)):
        at = int(np.argmax(stage >= number))
        if stage[at] >= number:
            passed = (episode.numbers[f"reward/{name}"][at] * run.weights[name] for name in run.stages[:number])
            left = run.horizon - at - 1
            yield float(earned[at] + sum(passed) * left), f"holding {run.stages[number - 1]!r}"


def on_stages(run: AuditedEpisodes) -> Iterator[AuditFinding]:
    """Find rewards of a step that fall when a later stage is passed, or, without stages, at the end."""
    found: dict[str, tuple[float, float]] = {}
    for episode in run.script:
        dense = [
            (name, weight * episode.numbers[f"reward/{name}"][:-1])
            for name, weight in run.weights.items()
            if weight > 0.0 and name != FINISH
        ]
        total = np.add.reduce([values for _, values in dense])
        if len(total) < 2 * _AROUND or total.max() <= 0.0:
            continue
        stage = episode.numbers.get("stage", np.zeros(len(total)))[:-1]
        changes = (np.flatnonzero(np.diff(stage) > 0) + 1).tolist()
        for last, at, following in zip([0, *changes], changes, [*changes[1:], len(total)], strict=False):
            before = float(total[max(last, at - _AROUND) : at].mean())
            after = float(total[at : min(following, at + _AROUND)].mean())
            if after < before - FALL * total.max():
                found[f"passing {run.stages[int(stage[at]) - 1]}"] = before, after
        if not run.stages:
            parts = [float(each.mean()) for each in np.array_split(total, 2 * _AROUND)]
            if parts[-1] < max(parts) - 5 * FALL * total.max():
                found["end"] = max(parts), parts[-1]
    for subject, (before, after) in found.items():
        yield AuditFinding(
            severity="warning",
            rule="stages",
            subject=subject,
            found=f"the reward of a step falls from {before:.3f} to {after:.3f}",
            limit=f"a fall by {100 * FALL * (1 if run.stages else 5):g} %",
            remedy="Hold the term of a stage up once its successor is reached",
        )


def on_observations(run: AuditedEpisodes, first: Array) -> Iterator[AuditFinding]:
    """Find fields that are constant, outside their bounds, or of another size; and saturated ones of the goals view.

    Args:
        run: The episodes.
        first: (n, size) first observations of further episodes.
    """
    every = np.concatenate([*(each.observations for each in (*run.script, *run.floors, *run.cheats)), first])
    fields, flat = run.layout.split(every), []
    for field in run.layout.fields:
        values = fields[field.name]
        low, high = float(values.min()), float(values.max())
        if outside := [each for each in (*run.script, *run.floors, *run.cheats) if not _is_within(run, each, field)]:
            # Cheats jam arms, at which measured speeds and forces are those of the contacts.
            grave = any(each.group in ("script", "floor") for each in outside)
            yield AuditFinding(
                severity="error" if grave else "note",
                rule="observations",
                subject=field.name,
                found=f'it reaches {low:.4g} to {high:.4g}, in "{outside[0].name}"',
                limit=f"{field.low:g} to {field.high:g}",
                remedy="Widen its bounds in the layout, or mend `observe`",
            )
        constant = np.ptp(values, axis=0) <= _FLAT
        if constant.all():
            yield AuditFinding(
                severity="warning",
                rule="observations",
                subject=field.name,
                found=f"it is constant, {values[0].ravel().tolist()!s:.60}, in all episodes",
                limit="a change",
                remedy="Leave it out of the layout, or name the setting that changes it",
            )
        elif constant.any():
            flat.append(f"{int(constant.sum())} of {constant.size} of {field.name}")
        used = max(abs(low), abs(high)) / max(abs(field.low), abs(field.high))
        if used < _LEAST_USED and not constant.all():
            yield AuditFinding(
                severity="note",
                rule="observations",
                subject=field.name,
                found=f"it uses {100 * used:.2g} % of its bounds",
                limit=f"{100 * _LEAST_USED:g} %",
                remedy="State narrower bounds, from which learners scale",
            )
        saturated = np.mean(np.abs(values) > _SATURATED / (1.0 - _SATURATED) * max(field.concise, default=np.inf))
        if saturated > _MOST_SATURATED:
            yield AuditFinding(
                severity="warning",
                rule="observations",
                subject=field.name,
                found=f"{100 * saturated:.0f} % of its values are above {_SATURATED:g} in observation='goals'",
                limit=f"{100 * _MOST_SATURATED:g} %",
                remedy="Give it a larger unit, Field(..., concise=(...))",
            )
    if flat:
        yield AuditFinding(
            severity="note",
            rule="observations",
            subject="numbers",
            found=f"constant: {', '.join(flat)}",
        )
    if not any(field.concise for field in run.layout.fields):
        yield AuditFinding(
            severity="note",
            rule="observations",
            subject="goals",
            found="no field has units for observation='goals'",
            remedy="Give those that lead to the goal units, Field(..., concise=(0.1, 0.01))",
        )


def _is_within(run: AuditedEpisodes, episode: AuditEpisode, field: Field) -> bool:
    """Return True if a field stays in its bounds in an episode."""
    values = run.layout.split(episode.observations)[field.name]
    return bool(values.min() >= field.low and values.max() <= field.high)


def on_cheats(run: AuditedEpisodes) -> Iterator[AuditFinding]:
    """Find cheats that succeed."""
    judged = [each for each in (*run.floors, *run.cheats) if each.group != "disturbed"]
    for name in dict.fromkeys(each.name for each in judged):
        episodes = [each for each in judged if each.name == name]
        if not any(each.changed for each in episodes):
            yield AuditFinding(
                severity="note",
                rule="cheats",
                subject=name,
                found="it is what the script does, and so no cheat",
            )
            continue
        yield from on_success(name, sum(each.success for each in episodes), len(episodes))


def on_success(name: str, successes: int, episodes: int) -> Iterator[AuditFinding]:
    """Find that a cheat succeeds."""
    if not successes:
        return
    remedy = "Let success ask for what this leaves out"
    if name in [ONE_ARM.format(arm) for arm in ARMS]:
        remedy = "Let success ask for something of both arms"
    elif name == REPLAY:
        remedy = "Widen what an episode samples, so that a policy must observe"
    yield AuditFinding(
        severity="warning" if name == REPLAY else "error",
        rule="cheats",
        subject=name,
        found=f"{successes} of {episodes} episodes succeed",
        limit="0",
        remedy=remedy,
    )
