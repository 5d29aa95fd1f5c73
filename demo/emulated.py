"""Tasks of the demonstration in simulation and on two emulated controllers, through `ur_rtde`.

SineTracking is replayed on the controllers: the recorded actions of the simulated episode, whatever is measured. Where
a gripper has to close on an object, the same policy acts on what it observes there.

Both episodes are recorded, so that they can be compared again: `python -m dual_ur10 compare`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from demo import carry, handover, sine
from demo.case import Case, CaseResult, DemoTask, episode
from dual_ur10 import policies
from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.errors import DualUR10Error, MissingExtraError
from dual_ur10.policies.evaluation.film import Take
from dual_ur10.policies.evaluation.rollout import Info
from dual_ur10.policies.registry import provenance
from dual_ur10.sim2real.analysis.compare import Comparison, compare
from dual_ur10.sim2real.analysis.page import Column
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, figure
from dual_ur10.sim2real.analysis.replay import RecordedPolicy, source_of
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.latch import Latch
from ur_core.kinematics.ur10 import ARMS

log = logging.getLogger(__name__)

PREPARING_S = 8.0
"""Approximate time to start an emulated cell, connect to it, and move the arms to the start of a task."""

ON_FAILURE = (
    "A busy machine keeps emulated controllers, or what moves their arms, waiting: both arms are then stopped, "
    "as real ones would be. Run the demonstration again when the machine is quiet. There is nothing to clear: each "
    "emulated cell ended with its run."
)
"""Advice after a failure."""

OnRatio = Callable[[float], None]


@dataclass(frozen=True)
class EmulatedRun:
    """A task that is run twice: in simulation, and on two emulated controllers.

    Attributes:
        task: The task.
        duration_s: Approximate length of an episode.
        case: The case; its title is that of the task.
    """

    task: DemoTask
    duration_s: float
    case: Case


def sine_run(duration_s: float) -> EmulatedRun:
    """Return the run of SineTracking, of this length."""
    keywords = {"duration_s": duration_s, "randomize": False}
    return EmulatedRun(sine.TASK, duration_s, Case("sine", "SineTracking", sine.SINE_ID, keywords))


CARRY = EmulatedRun(carry.TASK, 36.0, Case("carry", "SyncCarry", carry.CARRY_ID))
HANDOVER = EmulatedRun(handover.TASK, 12.0, Case("handover", "Handover", handover.HANDOVER_ID))


@dataclass(frozen=True)
class EmulatedPair:
    """Both episodes of a run.

    Attributes:
        run: The run.
        simulated, emulated: The episodes.
        comparison: Comparison of their recordings: A is the simulated one.
        load: Mean number of programs that wanted to run on this machine within the minute up to the end.
        shown: Poses of the emulated episode.
    """

    run: EmulatedRun
    simulated: CaseResult
    emulated: CaseResult
    comparison: Comparison
    load: float
    shown: Take

    @property
    def sides(self) -> tuple[tuple[str, CaseResult], tuple[str, CaseResult]]:
        """Both episodes with their names."""
        return ("simulated", self.simulated), ("emulated", self.emulated)


@dataclass(frozen=True)
class EmulatedFailure:
    """Failure of a run on emulated controllers.

    Attributes:
        run: The run.
        reason: Error that ended it.
        log: End of the emulated cell's log; "" if there is none.
    """

    run: EmulatedRun
    reason: str
    log: str = ""


def measure_emulated(
    run: EmulatedRun, folder: Path, on_ratio: OnRatio = lambda _: None
) -> EmulatedPair | EmulatedFailure:
    """Run one episode in simulation and one on an emulated cell, in real time, and compare them.

    A failure says more about the machine than about the task: it is returned, not raised.

    Args:
        run: The run.
        folder: Folder of both recordings and of the cell's file and log; made if it does not exist.
        on_ratio: Called with the ratio of the work that is done at least.
    """
    text = ""
    try:
        if importlib.util.find_spec("rtde_control") is None:
            raise MissingExtraError("ur_rtde", "real", "running the tasks on emulated controllers")
        folder.mkdir(parents=True, exist_ok=True)
        with _emulated_cell(run, folder) as (cell, log_tail):
            try:
                return _both(run, cell, folder, on_ratio)
            except (DualUR10Error, OSError):
                text = log_tail()
                raise
    except (DualUR10Error, OSError, ImportError) as error:
        log.warning("%s on emulated controllers: %s", run.task.title, error)
        return EmulatedFailure(run, f"{type(error).__name__}: {error}", text)


@contextlib.contextmanager
def _emulated_cell(run: EmulatedRun, folder: Path) -> Iterator[tuple[Any, Callable[[], str]]]:
    """Yield the keyword `cell` of an emulated cell, and a function that returns the end of its log.

    Its latched stop ends with it: the cell will never be started again.
    """
    name = run.task.name
    path = folder / f"{name}.toml"
    with EmulatedCell(task=run.case.env_id, plant="nominal", cell=str(path), log=folder / f"{name}-cell.log") as cell:
        latch = Latch(load_cell_file(path))
        try:
            yield str(path), cell.log_tail
        finally:
            latch.clear()


def _both(run: EmulatedRun, cell: Any, folder: Path, on_ratio: OnRatio) -> EmulatedPair:
    config = resolve_cell(cell)
    # Both cells get twice the latency that controllers need: on a machine that runs controllers, arms and policy at
    # once, many actions would otherwise miss their deadline.
    latency = {"action_latency_ticks": 2 * config.latency_ticks}
    whole_s = PREPARING_S + run.duration_s
    in_simulation = run.case.given(cell=replace(config, kind="mujoco", file=None), **latency)
    simulated, _ = _episode(run.task, in_simulation, folder, None, lambda _: None)
    on_ratio(PREPARING_S / 2 / whole_s)
    on_controllers = run.case.given(cell=cell, **latency)
    emulated, shown = _episode(
        run.task,
        on_controllers,
        folder,
        simulated.folder if run.task.replayed else None,
        lambda time_s: on_ratio((PREPARING_S + time_s) / whole_s),
    )
    load = os.getloadavg()[0]
    folders = [each.folder for each in (simulated, emulated) if each.folder is not None]
    found = compare(*map(read_run, folders))
    return EmulatedPair(run, simulated, emulated, found, load, shown)


def _episode(
    task: DemoTask, case: Case, folder: Path, played: Path | None, on_time: Callable[[float], None]
) -> tuple[CaseResult, Take]:
    """Run and record an episode, by the scripted policy or with the actions of a recording; return its poses, too."""
    before = set(folder.glob("*/"))
    origin = provenance("scripted", case.env_id) if played is None else source_of(played, 0)
    keywords = {"record": str(folder), "record_about": origin, **case.keywords}
    env: Any = gym.make(case.env_id, disable_env_checker=True, **keywords)
    try:
        policy: policies.Policy
        if played is None:
            policy = policies.load("scripted", case.env_id, **case.keywords)
        else:
            policy = RecordedPolicy(read_run(played))
        shown = Take(env.unwrapped.core)

        def keep(info: Info) -> None:
            shown(info)
            on_time(len(shown.infos) * shown.period_s)

        result = episode(case, env, policy, 0, keep)
    finally:
        env.close()
    (made,) = set(folder.glob("*/")) - before
    with contextlib.suppress(DualUR10Error):  # an episode that ended too early has no figures
        result = replace(result, figures=task.figures(result))
    return replace(result, folder=made), shown


def _late_ratio(pair: EmulatedPair, limit: int) -> float:
    """Percentage of sends of the worse arm that were later than `LATE_S[limit]`."""
    return 100 * max(each.late.ratios[limit] for each in pair.comparison.timing[1].arms)


def _worst(values: Sequence[float]) -> float:
    """Return the known value of the largest magnitude; NaN if none is known."""
    return max((each for each in values if not math.isnan(each)), key=abs, default=math.nan)


TIMING_COLUMNS: tuple[Column[EmulatedPair], ...] = (
    Column("path RMS", "mm", lambda pair: 1e3 * max(each.found.flange_m.rms for each in pair.comparison.arms)),
    Column("path max", "mm", lambda pair: 1e3 * max(each.found.flange_m.most for each in pair.comparison.arms)),
    Column(
        "path max, lag off",
        "mm",
        lambda pair: (
            1e3 * _worst([math.nan if each.free is None else each.free.flange_m.most for each in pair.comparison.arms])
        ),
    ),
    Column("lag", "ms", lambda pair: 1e3 * _worst([each.lag.value for each in pair.comparison.arms])),
    Column(
        "equal targets",
        "",
        lambda pair: (
            f"{sum(each.sent.equal for each in pair.comparison.arms)} of "
            f"{sum(each.sent.compared for each in pair.comparison.arms)}"
        ),
    ),
    Column(
        "targets apart",
        "mrad",
        lambda pair: 1e3 * max(each.sent.most_rad for each in pair.comparison.arms),
    ),
    Column("skew p99", "ms", lambda pair: 1e3 * pair.comparison.timing[1].skew_s.p99),
    Column("late > 2 ms", "%", lambda pair: _late_ratio(pair, 0)),
    Column("late > 8 ms", "%", lambda pair: _late_ratio(pair, 1)),
    Column("late actions", "", lambda pair: str(pair.emulated.late_actions)),
    Column("load", "", lambda pair: f"{pair.load:.1f}"),
)
"""Columns of the table of both recordings side by side: figures of the worse arm."""

PAGE_ONLY = ("path max, lag off", "targets apart", "load")
"""Columns for which a terminal is too narrow."""


def remarks(pair: EmulatedPair) -> list[str]:
    """Return explanations of a run's figures: an episode that ended early, actions that missed their deadline."""
    title = pair.run.task.title
    found = [
        f"{title}, {name}: ended after {side.record.time_s[-1]:.2f} s, because {side.record.ended_by}."
        for name, side in pair.sides
        if side.record.ended_by
    ]
    if late := pair.emulated.late_actions:
        found.append(
            f"{title}, emulated: {late} action{' was' if late == 1 else 's were'} too late, and each time both arms "
            "stopped and went on from there: this machine was busy. Run it again when it is quiet."
        )
    return found


def reasons(failures: Sequence[EmulatedFailure]) -> list[dict[str, str]]:
    """Return each reason once, with the titles of its tasks and the end of the first one's log."""
    by_reason: dict[str, list[EmulatedFailure]] = {}
    for each in failures:
        by_reason.setdefault(each.reason, []).append(each)
    return [
        {"titles": ", ".join(each.run.task.title for each in those), "reason": reason, "log": those[0].log[-600:]}
        for reason, those in by_reason.items()
    ]


def side_by_side(pair: EmulatedPair) -> str:
    """Plot the distance between simulated and emulated flange, of each arm."""
    with figure(1, 1, 2.6) as (_, axes, address):
        axis = axes[0, 0]
        for each in pair.comparison.pairs:
            apart = 1e3 * np.linalg.norm(each.flange_m[0] - each.flange_m[1], axis=2)
            for arm, name in enumerate(ARMS):
                axis.plot(each.time_s, apart[:, arm], color=ARM_COLORS[arm], label=name, linewidth=1)
        axis.set(xlabel="time on the task's clock (s)", ylabel="mm")
        axis.set_ylim(bottom=0.0, top=1.25 * axis.get_ylim()[1])
        axis.set_title(f"{pair.run.task.title}: distance between simulated and emulated flange")
        axis.legend(ncols=2, loc="upper right")
        axis.margins(x=0.01)
    return address[0]
