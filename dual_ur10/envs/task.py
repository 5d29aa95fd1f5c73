"""What a task is: where an episode starts, what is observed, what is rewarded, when it ends."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.cell import CellConfig, CellState
from dual_ur10.sim2real.limits import MotionLimits

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


class Outcome(NamedTuple):
    """What a task says of n cells after a step.

    Attributes:
        terms: (n, terms) raw reward terms in the order of `Task.weights`; the reward is their weighted sum.
        success: (n,) whether the task is done well. True only where `over` is.
        over: (n,) whether the episode has come to its natural end.
        info: Values for `info` by name, (n, ...) each.
    """

    terms: Array
    success: Mask
    over: Mask
    info: dict[str, Array]


@dataclasses.dataclass(frozen=True)
class Timing:
    """When things happen.

    Attributes:
        period_s: Time between two actions.
        ahead_s: Time from an observation to where the motion of its action ends: period and action latency.
    """

    period_s: float
    ahead_s: float


SettingsT = TypeVar("SettingsT")
MeasuredT = TypeVar("MeasuredT")


class Task(ABC, Generic[SettingsT, MeasuredT]):
    """A task for n cells. It sees nothing but `CellState`, and keeps what belongs to the running episodes.

    Attributes:
        name: As in the id.
        limits: What the arms may do in this task, in simulation and in reality.
        weights: Weight of each reward term, by its name.
        settings_type: Dataclass of what the user may set.
        observation_bound: (size,) largest magnitude of each number of an observation.

    Args:
        settings: What the user may set.
        cell: The cell it runs in.
        timing: Rate and latency of actions.
        n: Number of cells.
    """

    name: ClassVar[str]
    limits: ClassVar[MotionLimits]
    weights: ClassVar[Mapping[str, float]]
    settings_type: ClassVar[type[Any]]
    observation_bound: Array

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int) -> None:
        self.settings, self.cell, self.timing, self.n = settings, cell, timing, n

    @abstractmethod
    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Array:
        """Draw new episodes for `rows`, one generator each. Returns the start postures, (len(rows), 2, 6)."""

    @abstractmethod
    def measure(self, state: CellState) -> MeasuredT:
        """Everything about a state that observation and reward share."""

    @abstractmethod
    def observe(self, state: CellState, measured: MeasuredT, commanded_q_rad: Array) -> Array:
        """Observations, (n, size)."""

    @abstractmethod
    def evaluate(self, state: CellState, measured: MeasuredT) -> Outcome:
        """Reward terms and success. Called once per step, for it may keep count of an episode."""


def task_settings(task: type[Task[Any, Any]], keywords: Mapping[str, Any]) -> Any:
    """The settings of a task from plain keywords.

    Raises:
        UnknownNameError: A keyword is not one of the task's settings.
    """
    known = [each.name for each in dataclasses.fields(task.settings_type)]
    for key in keywords:
        if key not in known:
            raise UnknownNameError(f"keyword of {task.name}", str(key), [*known, *ENV_KEYWORDS])
    return task.settings_type(**keywords)


ENV_KEYWORDS = (
    "render_mode",
    "cell",
    "policy_rate_hz",
    "action_mode",
    "action_latency_ticks",
    "compensate_lag",
    "camera",
    "width",
    "height",
    "shadows",
)
"""Keywords of every environment, beside those of its task."""


_LOG_TENTH = float(np.log(0.1))


def gaussian(distance: Array, margin: float | Array) -> Array:
    """1 at distance 0, 0.1 at `margin`: dm_control's `tolerance` with bounds (0, 0) and its gaussian sigmoid."""
    scaled = distance / margin
    result: Array = np.exp(scaled * scaled * _LOG_TENTH)
    return result
