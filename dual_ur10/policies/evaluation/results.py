"""Results of an evaluation: its episodes, their summary, and both as a table and as files."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.coupling import APART_M, APART_RAD, is_beyond
from ur_core.files import write_text

if TYPE_CHECKING:
    from rich.table import Table

_WIDTH = 100  # of a printed summary, in characters

CONFIDENCE = 0.95
"""Confidence of every interval of an evaluation."""


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return Wilson's score interval of a success rate; (0, 1) without any trial.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", Journal of the American
    Statistical Association 22 (1927), pages 209 to 212. It keeps its coverage for few trials and for rates near 0 and
    1, where the interval of the normal approximation shrinks to a point.

    Args:
        successes: Number of successes, 0 to `trials`.
        trials: Number of trials, 0 or more.
        confidence: Probability that such an interval holds the true rate, between 0 and 1.

    Raises:
        SettingsError: A number is out of its range.
    """
    if not 0 <= successes <= trials:
        raise SettingsError(f"{successes} successes in {trials} trials: allowed are 0 to {trials} successes")
    if not 0.0 < confidence < 1.0:
        raise SettingsError(f"confidence is {confidence!r}: it must be between 0 and 1")
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, NormalDist().inv_cdf((1.0 + confidence) / 2.0)
    weight = z * z / trials
    center = (rate + weight / 2.0) / (1.0 + weight)
    half = math.sqrt(weight * (rate * (1.0 - rate) + weight / 4.0)) / (1.0 + weight)
    # The interval always holds the observed rate: rounding must not exclude it.
    low, high = min(rate, center - half), max(rate, center + half)
    return (0.0 if successes == 0 else low), (1.0 if successes == trials else high)


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode.

    Attributes:
        seed: Seed of its reset.
        success: True if the task reports success.
        total_reward: Sum of all rewards; "return" in files.
        steps: Number of steps.
        time_s: Simulated time from the reset to the end.
        end_reason: `info["end_reason"]` of its last step; "" if there was none.
        ended_by: Reason of an early end, such as the gate's verdict or "bar_lost"; "" if there was none.
        stage: Stage of the task at the end, 0 before the first; None if the task has no stages.
        best_stage: Highest stage that was reached; None as above.
        peak: Largest magnitude over all steps of each number in `info` with a unit, by name; values per arm as
            `name/left` and `name/right`. Numbers that were never finite are left out.
        last: The same numbers at the end, with their signs; None: not finite.
    """

    seed: int
    success: bool
    total_reward: float
    steps: int
    time_s: float
    end_reason: str = ""
    ended_by: str = ""
    stage: int | None = None
    best_stage: int | None = None
    peak: Mapping[str, float] = dataclasses.field(default_factory=dict)
    last: Mapping[str, float | None] = dataclasses.field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the episode as it is written to files."""
        result: dict[str, Any] = {}
        for each in dataclasses.fields(self):
            result["return" if each.name == "total_reward" else each.name] = getattr(self, each.name)
        return result


class Summary(dict[str, Any]):
    """Figures by name, which print as a table.

    Args:
        figures: Figures by name.
        table: The same for a person.
    """

    def __init__(self, figures: Mapping[str, Any], table: Table) -> None:
        super().__init__(figures)
        self._table = table

    def __str__(self) -> str:
        from rich.console import Console

        text = io.StringIO()
        Console(file=text, width=_WIDTH, color_system=None).print(self._table)
        return text.getvalue().rstrip("\n")


@dataclass(frozen=True)
class Spread:
    """A number of `info` over the episodes that have it.

    Attributes:
        largest: Largest of the episodes' peaks.
        median: Median of the episodes' peaks.
        last: Median of the magnitudes at the episodes' ends; None where no episode ends with a finite one.
    """

    largest: float
    median: float
    last: float | None


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one policy in one environment. Everything in it depends on nothing but what it names.

    Attributes:
        env_id: Id of the environment.
        policy: Name of the policy, or of its class.
        kwargs: Keywords of the environment.
        seed: Of the first episode; the next ones count on.
        stages: Names of the task's stages; empty if it has none.
        episodes: In the order of their seeds, one or more.
        versions: Of the packages that the result depends on, by name.
        late_actions: Number of actions that missed their deadline on two controllers, so that both arms stopped.
    """

    env_id: str
    policy: str
    kwargs: Mapping[str, Any]
    seed: int
    stages: tuple[str, ...]
    episodes: tuple[EpisodeResult, ...]
    versions: Mapping[str, str]
    late_actions: int = 0

    def __post_init__(self) -> None:
        if not self.episodes:
            raise SettingsError("an evaluation needs one episode or more")

    def __repr__(self) -> str:
        count = f"success {self.successes} of {len(self.episodes)}"
        return f"{type(self).__name__}({self.env_id}, {self.policy}, {count}, seeds from {self.seed})"

    @property
    def successes(self) -> int:
        """Number of successful episodes."""
        return sum(each.success for each in self.episodes)

    @property
    def success_rate(self) -> float:
        """Ratio of successful episodes."""
        return self.successes / len(self.episodes)

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of the true success rate, with a confidence of 95 %."""
        return wilson_interval(self.successes, len(self.episodes), CONFIDENCE)

    @property
    def mean_return(self) -> float:
        """Mean of the sums of rewards."""
        return float(np.mean([each.total_reward for each in self.episodes]))

    @property
    def std_return(self) -> float:
        """Standard deviation of the sums of rewards over these episodes."""
        return float(np.std([each.total_reward for each in self.episodes]))

    @property
    def median_time_s(self) -> float | None:
        """Median duration of the successful episodes; None if none was."""
        return self._time_s(50.0)

    @property
    def p90_time_s(self) -> float | None:
        """90th percentile of the duration of the successful episodes; None if none was."""
        return self._time_s(90.0)

    def _time_s(self, percent: float) -> float | None:
        times = [each.time_s for each in self.episodes if each.success]
        return float(np.percentile(times, percent)) if times else None

    @property
    def cut_short(self) -> tuple[EpisodeResult, ...]:
        """Episodes that the safety gate, a failure or an error ended."""
        return tuple(each for each in self.episodes if each.ended_by)

    @property
    def end_reasons(self) -> dict[str, int]:
        """Number of episodes by the reason of their end, the most frequent first."""
        counts = Counter(each.end_reason for each in self.episodes if each.end_reason)
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    @property
    def stage_scores(self) -> dict[str, float]:
        """Ratio of episodes that reached each stage or a later one, by its name."""
        best = [each.best_stage or 0 for each in self.episodes]
        return {name: sum(stage > k for stage in best) / len(best) for k, name in enumerate(self.stages)}

    @property
    def apart(self) -> int:
        """Number of episodes whose coupling error exceeded what two controllers allow: they would stop both arms."""
        peaks = [each.peak for each in self.episodes]
        return sum(is_beyond(each.get("coupling_error_m", 0.0), each.get("coupling_error_rad", 0.0)) for each in peaks)

    @cached_property
    def spreads(self) -> dict[str, Spread]:
        """The numbers of `info` with a unit over all episodes, by name; see `EpisodeResult.peak`."""
        result = {}
        for name in self._names():
            peaks = [each.peak[name] for each in self.episodes if name in each.peak]
            lasts = [abs(value) for each in self.episodes if (value := each.last.get(name)) is not None]
            result[name] = Spread(
                largest=max(peaks),
                median=float(np.median(peaks)),
                last=float(np.median(lasts)) if lasts else None,
            )
        return result

    def _names(self) -> list[str]:
        return sorted({name for each in self.episodes for name in each.peak})

    def summary(self) -> Summary:
        """Return the figures of all episodes together, as they are written to files. They print as a table."""
        figures = {
            "episodes": len(self.episodes),
            "successes": self.successes,
            "success_rate": self.success_rate,
            "success_interval": list(self.interval),
            "confidence": CONFIDENCE,
            "mean_return": self.mean_return,
            "std_return": self.std_return,
            "median_time_s": self.median_time_s,
            "p90_time_s": self.p90_time_s,
            "end_reasons": self.end_reasons,
            "cut_short": len(self.cut_short),
            **({"late_actions": self.late_actions} if self.late_actions else {}),
            "stage_scores": self.stage_scores,
            **({"apart": self.apart} if "coupling_error_m" in self.spreads else {}),
            "spreads": {name: dataclasses.asdict(spread) for name, spread in self.spreads.items()},
        }
        return Summary(figures, self.as_table())

    def as_table(self) -> Table:
        """Return the figures of all episodes together as a table for the terminal."""
        from rich.markup import escape
        from rich.table import Table

        count = len(self.episodes)
        noun = "episode" if count == 1 else "episodes"
        title = f"{self.env_id}, {self.policy}, {count} {noun} from seed {self.seed}"
        table = Table(title=escape(title), title_justify="left", title_style="bold", show_header=False)
        table.add_column()
        table.add_column(justify="right")
        low, high = self.interval
        table.add_row("success", f"{self.successes} of {count}, [bold]{_percent(self.success_rate)}[/]")
        table.add_row("95 % interval of it", f"{_percent(low)} to {_percent(high)}")
        for name, ratio in self.stage_scores.items():
            table.add_row(f"reached: {escape(name)}", _percent(ratio))
        table.add_row("return", f"{self.mean_return:.2f} ± {self.std_return:.2f}")
        table.add_row("time of successes, median", _seconds(self.median_time_s))
        table.add_row("time of successes, 90 %", _seconds(self.p90_time_s))
        for reason, number in self.end_reasons.items():
            table.add_row(f"ended: {escape(reason)}", str(number))
        if self.cut_short:
            first = self.cut_short[0]
            table.add_row("cut short", str(len(self.cut_short)))
            table.add_row("the first of them", f"seed {first.seed}: {escape(first.ended_by)}")
        if self.late_actions:
            table.add_row("late actions, both arms stopped", str(self.late_actions))
        if self.apart:
            limit = f"{1e3 * APART_M:g} mm or {math.degrees(APART_RAD):g}°"
            table.add_row(f"coupling error above {limit}: controllers stop", str(self.apart))
        if self.spreads:
            table.add_section()
            table.add_row("[dim]peaks of the episodes[/]", "[dim]largest · median · median at the end[/]")
        for name, spread in self.spreads.items():
            quantity, unit, factor = _for_persons(name)
            if unit == "s":  # the task's clock is no error
                continue
            values = (spread.largest, spread.median, spread.last)
            numbers = " · ".join(_number(None if each is None else factor * each) for each in values)
            table.add_row(f"{escape(quantity)}, {unit}", numbers)
        return table

    def as_dict(self) -> dict[str, Any]:
        """Return everything as it is written to files."""
        return {
            "env_id": self.env_id,
            "policy": self.policy,
            "kwargs": self.kwargs,
            "seed": self.seed,
            "stages": self.stages,
            "versions": self.versions,
            "summary": self.summary(),
            "episodes": [each.as_dict() for each in self.episodes],
        }

    def to_json(self, path: str | Path) -> None:
        """Write everything to a JSON file: all or nothing.

        Raises:
            DualUR10Error: The file cannot be written. An existing one is unchanged.
        """
        _write_json(path, self.as_dict())

    def to_csv(self, path: str | Path) -> None:
        """Write a row per episode to a CSV file: all or nothing. None is an empty cell.

        Raises:
            DualUR10Error: The file cannot be written. An existing one is unchanged.
        """
        text, names = io.StringIO(), self._names()
        rows = [each.as_dict() for each in self.episodes]
        plain = [key for key in rows[0] if key not in ("peak", "last")]
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*plain, *(f"{kind}/{name}" for name in names for kind in ("peak", "last"))])
        for row in rows:
            values = [row[kind].get(name) for name in names for kind in ("peak", "last")]
            writer.writerow([*(row[key] for key in plain), *values])
        write_text(path, text.getvalue())


def write_evaluations(path: str | Path, evaluations: Sequence[Evaluation]) -> None:
    """Write a list of evaluations to a JSON file, each as `Evaluation.to_json` writes it: all or nothing.

    Raises:
        DualUR10Error: The file cannot be written. An existing one is unchanged.
    """
    _write_json(path, [each.as_dict() for each in evaluations])


def _write_json(path: str | Path, data: Any) -> None:
    write_text(path, json.dumps(_plain(data), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    """Return `value` in types of JSON. A number that is not finite becomes its name, an unknown object its type.

    Equal evaluations give equal files: no address in memory is ever written.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
        return {"type": type(value).__name__, **_plain(fields)}
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return f"<{type(value).__name__}>"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.1f} %"


def _seconds(time_s: float | None) -> str:
    return "—" if time_s is None else f"{time_s:.2f} s"


_UNITS = {
    "_rad_s": ("°/s", math.degrees(1.0)),
    "_m_s": ("mm/s", 1e3),
    "_rad": ("°", math.degrees(1.0)),
    "_m": ("mm", 1e3),
    "_n": ("N", 1.0),
    "_s": ("s", 1.0),
}
"""Units in which persons read the numbers of `info`, and the factors to them, by the suffixes of their names."""


def _for_persons(name: str) -> tuple[str, str, float]:
    """Return a number's quantity, and the unit and factor by which a person reads it: `slip_m/left` in mm."""
    quantity, slash, arm = name.partition("/")
    suffix = next(each for each in _UNITS if quantity.endswith(each))
    return quantity.removesuffix(suffix) + slash + arm, *_UNITS[suffix]


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.3g}"
