"""Agreement of success in simulation with success on a cell, over several policies of each task."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.results import wilson_interval
from ur_core.types import Array

COLUMNS: Final = (
    "task",
    "policy",
    "simulation_successes",
    "simulation_episodes",
    "cell_successes",
    "cell_episodes",
)
"""Columns of a table of policies, in any order."""

LEAST_POLICIES: Final = 3
"""Fewest policies of a task: two of them always lie on a line."""

_MOST_BYTES: Final = 10_000_000
_MOST_EPISODES: Final = 1_000_000_000


@dataclass(frozen=True)
class SuccessCount:
    """Successes among episodes.

    Attributes:
        successes: Number of successful episodes.
        episodes: Number of episodes, 1 or more.
    """

    successes: int
    episodes: int

    @property
    def rate(self) -> float:
        """Ratio of successful episodes."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of the true rate, with a confidence of 95 %."""
        return wilson_interval(self.successes, self.episodes)


@dataclass(frozen=True)
class MeasuredPolicy:
    """One policy in one task, measured in simulation and on a cell.

    Attributes:
        task: Name of the task.
        policy: Name of the policy.
        simulation: Success in simulation.
        cell: Success on the cell.
    """

    task: str
    policy: str
    simulation: SuccessCount
    cell: SuccessCount


@dataclass(frozen=True)
class Agreement:
    """Agreement over the policies of one task.

    Attributes:
        task: Name of the task.
        policies: Its policies, in the order of the table.
        pearson: Pearson's r of the success rates; None: all rates of one side are equal.
        spearman: Spearman's rank correlation; policies of equal rate share the mean of their ranks. None as above.
        max_rank_violation: Mean maximum rank violation of X. Li et al., "Evaluating Real-World Robot Manipulation
            Policies in Simulation", CoRL 2024: the mean over the policies of the largest difference between a policy's
            rate on the cell and that of another one that it exceeds on one side alone. 0 is best.
        notes: Caveats for the reader of the figures.
    """

    task: str
    policies: tuple[MeasuredPolicy, ...]
    pearson: float | None
    spearman: float | None
    max_rank_violation: float
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as they are written to files, with the interval of each rate."""
        result = dataclasses.asdict(self)
        for row, each in zip(result["policies"], self.policies, strict=True):
            for side in ("simulation", "cell"):
                count: SuccessCount = getattr(each, side)
                row[side] |= {"rate": count.rate, "interval": list(count.interval)}
        return result


def read_policies(path: str | Path) -> list[MeasuredPolicy]:
    """Read a table of policies: a CSV file in UTF-8 with `COLUMNS`, and a row for each policy of each task.

    Raises:
        SettingsError: The file cannot be read, has other columns, or a row holds no such numbers.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise SettingsError(f"{path} is no table of policies: it is larger than {_MOST_BYTES // 1_000_000} MB")
        rows = list(csv.reader(data.decode("utf-8-sig").splitlines(), strict=True))
    except OSError as error:
        raise SettingsError(f"cannot read {path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SettingsError(f"{path} is no table of policies: it must be a CSV file in UTF-8 ({error})") from error
    names = [each.strip() for each in rows[0]] if rows else []
    if sorted(names) != sorted(COLUMNS):
        raise SettingsError(
            f"{path} has the columns {', '.join(names)[:300] or 'of no line'}: a table of policies has "
            f"{', '.join(COLUMNS)}, in any order"
        )
    found: dict[tuple[str, str], MeasuredPolicy] = {}
    for line, row in enumerate(rows[1:], start=2):
        if not any(each.strip() for each in row):
            continue
        where = f"{path}, row {line}"
        if len(row) != len(names):
            raise SettingsError(f"{where} has {len(row)} values: there are {len(names)} columns")
        values = dict(zip(names, (each.strip() for each in row), strict=True))
        each = MeasuredPolicy(
            values["task"], values["policy"], *(_count(where, values, side) for side in ("simulation", "cell"))
        )
        if not (each.task and each.policy):
            raise SettingsError(f"{where} names no {'policy' if each.task else 'task'}: name it")
        if (each.task, each.policy) in found:
            raise SettingsError(f"{where} is the second one of {each.policy!r} in {each.task!r}: add their episodes up")
        found[each.task, each.policy] = each
    return list(found.values())


def _count(where: str, values: dict[str, str], side: str) -> SuccessCount:
    numbers = []
    for name in (f"{side}_successes", f"{side}_episodes"):
        text = values[name]
        if not (text.isascii() and text.isdigit() and len(text) <= 20 and int(text) <= _MOST_EPISODES):
            raise SettingsError(f"{where}: {name} is {text!r:.80}: it must be a whole number")
        numbers.append(int(text))
    successes, episodes = numbers
    if not successes <= episodes or episodes == 0:
        raise SettingsError(
            f"{where}: {successes} successes in {episodes} episodes ({side}): one episode or more, and no more "
            "successes than episodes"
        )
    return SuccessCount(successes, episodes)


def agreements(policies: Sequence[MeasuredPolicy]) -> list[Agreement]:
    """Return the agreement of each task, in the order of the table.

    Raises:
        SettingsError: A task has fewer than `LEAST_POLICIES` policies, or there is none.
    """
    if not policies:
        raise SettingsError("the table has no policies: add a row for each")
    by_task: dict[str, list[MeasuredPolicy]] = {}
    for each in policies:
        by_task.setdefault(each.task, []).append(each)
    for task, several in by_task.items():
        if len(several) < LEAST_POLICIES:
            raise SettingsError(
                f"{len(several)} {'policy' if len(several) == 1 else 'policies'} of {task}: a correlation needs "
                f"{LEAST_POLICIES} or more. Measure others, of different quality"
            )
    return [_agreement(task, several) for task, several in by_task.items()]


def _agreement(task: str, policies: Sequence[MeasuredPolicy]) -> Agreement:
    simulated = np.array([each.simulation.rate for each in policies])
    measured = np.array([each.cell.rate for each in policies])
    notes = []
    for side, rates in (("in simulation", simulated), ("on the cell", measured)):
        tied = len(rates) - len(np.unique(rates))
        if tied == len(rates) - 1:
            notes.append(f"all policies have the same rate {side}: there is no correlation")
        elif tied:
            shared = sum(int((rates == each).sum() > 1) for each in rates)
            notes.append(f"{shared} of {len(rates)} policies share a rate with another one {side}: their order is open")
    return Agreement(
        task=task,
        policies=tuple(policies),
        pearson=_pearson(simulated, measured),
        spearman=_pearson(_ranks(simulated), _ranks(measured)),
        max_rank_violation=_max_rank_violation(simulated, measured),
        notes=tuple(notes),
    )


def _pearson(one: Array, other: Array) -> float | None:
    if np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return None
    return float(np.clip(np.corrcoef(one, other)[0, 1], -1.0, 1.0))


def _ranks(values: Array) -> Array:
    """Return ranks from 1 on; equal values share the mean of theirs."""
    below, equal = values[:, None] > values, values[:, None] == values
    ranks: Array = below.sum(axis=1) + (equal.sum(axis=1) + 1) / 2
    return ranks


def _max_rank_violation(simulated: Array, measured: Array) -> float:
    apart = np.abs(measured[:, None] - measured)
    violated = (simulated[:, None] > simulated) != (measured[:, None] > measured)
    return float((apart * violated).max(axis=1).mean())
