"""Progress of a training, and its learning curve."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned.schema import StrictJson


@dataclass(frozen=True)
class Check(StrictJson):
    """Evaluation of the policy during a training.

    Attributes:
        steps: Total environment steps so far.
        seconds: Training time so far.
        mean_return: Mean return of the episodes.
        success_rate: Ratio of successful episodes.
        episodes: Number of episodes.
        low, high: Wilson's interval of the success rate, 95 %.
    """

    steps: int
    seconds: float
    mean_return: float
    success_rate: float
    episodes: int
    low: float
    high: float

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key: a better check has a greater one."""
        return self.success_rate, self.mean_return


@dataclass
class Progress:
    """Progress of a training.

    Attributes:
        steps, total: Environment steps so far, and in total.
        rate: Recent steps per second.
        seconds_left: Estimated remaining time; None: unknown.
        mean_return, success_rate: Figures of recent episodes; None: no episode has ended.
        doing: Current activity, in a few words.
    """

    steps: int
    total: int
    rate: float = 0.0
    seconds_left: float | None = None
    mean_return: float | None = None
    success_rate: float | None = None
    doing: str = ""


OnProgress = Callable[[Progress], None]


def draw_curve(path: Path, title: str, checks: Sequence[Check], goal: float | None = None) -> None:
    """Draw success rate and return over steps to a PNG file.

    Raises:
        MissingExtraError: Matplotlib is not installed.
        TrainingError: The file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "plot", "drawing a learning curve") from None
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    success: Any
    success, reward = figure.subplots(2, 1, sharex=True)
    steps = [each.steps for each in checks]
    low, high = [100 * each.low for each in checks], [100 * each.high for each in checks]
    success.fill_between(steps, low, high, color="tab:blue", alpha=0.2, linewidth=0, label="95 % interval")
    success.plot(
        steps, [100 * each.success_rate for each in checks], "o-", markersize=3, color="tab:blue", label="success"
    )
    if goal is not None:
        success.axhline(100 * goal, color="tab:gray", linestyle="--", linewidth=0.8, label="goal")
    success.set(ylabel="success, %", ylim=(-3, 103), title=title)
    success.legend(loc="lower right", fontsize="small")
    reward.plot(steps, [each.mean_return for each in checks], "o-", markersize=3, color="tab:orange")
    reward.set(ylabel="mean return", xlabel="steps of the environment")
    for axes in (success, reward):
        axes.grid(alpha=0.3)
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format="png", dpi=110)
        part.replace(path)
    except OSError as error:
        raise TrainingError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


class TimeLeft:
    """Estimate of the time that rounds of gathering and fitting still take, from the rates so far.

    Args:
        clock: Function that returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._step_s = self._fit_s = 0.0
        self._fitting_since: float | None = None

    def gathered(self, steps: int, seconds: float) -> None:
        """Take the duration of the steps of this round."""
        self._step_s = seconds / max(1, steps)

    def fit_begins(self) -> None:
        """Begin to measure a fit."""
        self._fitting_since = self._clock()

    def fit_ends(self) -> None:
        """End the measurement of a fit and its progress check."""
        if self._fitting_since is not None:
            self._fit_s, self._fitting_since = self._clock() - self._fitting_since, None

    def __call__(self, steps: int, round_steps: float, *, refits: bool) -> float | None:
        """Return seconds; None before the first fit.

        Args:
            steps: Steps that are still to be gathered.
            round_steps: Steps of a round.
            refits: True if each round begins with a fit. A last fit follows in any case.
        """
        if not self._fit_s:
            return None
        fits = math.ceil(steps / round_steps) if refits else 0
        if self._fitting_since is None:
            return steps * self._step_s + max(1, fits) * self._fit_s
        rest_s = max(0.0, self._fit_s - (self._clock() - self._fitting_since))
        return steps * self._step_s + fits * self._fit_s + rest_s
