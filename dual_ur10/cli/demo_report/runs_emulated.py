"""The scripted tasks once in simulation and once on two emulated controllers, through `ur_rtde`, and what came of both.

SineTracking is replayed there: the recorded actions of the simulated episode, whatever is measured. Where something is
to be gripped, the same policy acts on what it sees: it goes on where an object is, and where an action came too late.

Both are recorded, so that they can be compared again: `python -m dual_ur10 compare`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym

from dual_ur10 import policies
from dual_ur10.cli.demo_report.runs import SINE_ID
from dual_ur10.cli.demo_report.runs_carry import CARRY_ID
from dual_ur10.cli.demo_report.runs_handover import HANDOVER_ID
from dual_ur10.errors import DualUR10Error, MissingExtraError
from dual_ur10.policies.evaluation.rollout import Info, Record, Trace, rollout
from dual_ur10.policies.registry import provenance
from dual_ur10.sim2real.analysis.compare import Comparison, compare
from dual_ur10.sim2real.analysis.replay import RecordedPolicy, source_of
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.emulator.emulated_cell import EmulatedCell
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.latch import Latch

log = logging.getLogger(__name__)

PREPARING_S = 8.0
"""About what it takes to start an emulated cell, to connect to it, and to bring the arms to where a task begins."""

OnShare = Callable[[float], None]


@dataclass(frozen=True)
class EmulatedRun:
    """A task that is run twice: in simulation, and on two emulated controllers.

    Attributes:
        name: Short name.
        title: For people.
        env_id: Of the environment.
        duration_s: About how long an episode is.
        keywords: Of the environment.
        seed: Of both episodes.
        replayed: Whether the emulated cell gets the actions that were recorded in simulation; else the policy acts
            there, too.
    """

    name: str
    title: str
    env_id: str
    duration_s: float
    keywords: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    replayed: bool = False


def sine_run(duration_s: float) -> EmulatedRun:
    """The sine, for so long."""
    keywords = {"duration_s": duration_s, "randomize": False}
    return EmulatedRun("sine", "SineTracking", SINE_ID, duration_s, keywords, replayed=True)


CARRY = EmulatedRun("carry", "SyncCarry", CARRY_ID, 36.0)
HANDOVER = EmulatedRun("handover", "Handover", HANDOVER_ID, 12.0)


@dataclass(frozen=True)
class Side:
    """One episode.

    Attributes:
        record: What was measured.
        trace: `info` over time.
        folder: Of its recording.
        late_actions: How often an action came too late, so that both arms came to rest and went on from there.
    """

    record: Record
    trace: Trace
    folder: Path
    late_actions: int = 0


@dataclass(frozen=True)
class EmulatedResult:
    """What came of both.

    Attributes:
        run: How it was run.
        simulated, emulated: Both episodes.
        comparison: Of their recordings: A is the simulated one.
        load: Mean number of programs that wanted to run on this machine within the minute up to the end.
    """

    run: EmulatedRun
    simulated: Side
    emulated: Side
    comparison: Comparison
    load: float


@dataclass(frozen=True)
class EmulatedFailure:
    """Why there is nothing to show of a task on emulated controllers.

    Attributes:
        run: How it was to be run.
        reason: What went wrong.
        log: End of what the emulated cell logged; "" if there is none.
    """

    run: EmulatedRun
    reason: str
    log: str = ""


def measure_emulated(
    run: EmulatedRun, folder: Path, on_share: OnShare = lambda _: None
) -> EmulatedResult | EmulatedFailure:
    """Run one episode in simulation and one on an emulated cell, and compare them. That takes real time.

    What goes wrong here says more of the machine than of the tasks: it is told, and ends nothing else.

    Args:
        run: How.
        folder: Where both recordings go, and the cell's file and log; made if it does not exist.
        on_share: Told which share of it is behind at least.
    """
    text = ""
    try:
        _check_client()
        folder.mkdir(parents=True, exist_ok=True)
        with _emulated_cell(run, folder) as (path, cell):
            try:
                return _both(run, path, folder, on_share)
            except (DualUR10Error, OSError):
                text = cell.log_tail()
                raise
    except (DualUR10Error, OSError, ImportError) as error:
        log.warning("%s on emulated controllers: %s", run.title, error)
        return EmulatedFailure(run, f"{type(error).__name__}: {error}", text)


def _check_client() -> None:
    """Make sure that what moves arms is installed.

    Raises:
        MissingExtraError: It is not.
    """
    if importlib.util.find_spec("rtde_control") is None:
        raise MissingExtraError("ur_rtde", "real", "running the tasks on emulated controllers")


@contextlib.contextmanager
def _emulated_cell(run: EmulatedRun, folder: Path) -> Iterator[tuple[Path, EmulatedCell]]:
    """An emulated cell and its file. A fault of it ends with it: it will never be started again."""
    path = folder / f"{run.name}.toml"
    with EmulatedCell(task=run.env_id, plant="nominal", cell=str(path), log=folder / f"{run.name}-cell.log") as cell:
        latch = Latch(load_cell_file(path))
        try:
            yield path, cell
        finally:
            latch.clear()


def _both(run: EmulatedRun, path: Path, folder: Path, on_share: OnShare) -> EmulatedResult:
    config = load_cell_file(path).config()
    # The same cell, simulated. Both are given twice the latency that controllers need: on a machine that runs
    # controllers, arms and policy at once, an action would often be late.
    alike = replace(config, kind="mujoco", file=None)
    latency = {"action_latency_ticks": 2 * config.latency_ticks}
    whole_s = PREPARING_S + run.duration_s
    simulated = _episode(run, folder, None, lambda _: None, cell=alike, **latency)
    on_share(PREPARING_S / 2 / whole_s)
    played = simulated.folder if run.replayed else None
    emulated = _episode(
        run, folder, played, lambda time_s: on_share((PREPARING_S + time_s) / whole_s), cell=str(path), **latency
    )
    load = os.getloadavg()[0]
    found = compare(read_run(simulated.folder), read_run(emulated.folder))
    return EmulatedResult(run, simulated, emulated, found, load)


def _episode(
    run: EmulatedRun, folder: Path, played: Path | None, on_time: Callable[[float], None], **cell: Any
) -> Side:
    """Run one, by the scripted policy or with the actions of a recording, and record it."""
    before = set(folder.glob("*/"))
    told = provenance("scripted", run.env_id) if played is None else source_of(played, 0)
    keywords = {"record": str(folder), "record_about": told, **run.keywords, **cell}
    env: Any = gym.make(run.env_id, disable_env_checker=True, **keywords)
    try:
        policy: policies.Policy
        if played is None:
            policy = policies.load("scripted", run.env_id, **run.keywords, **cell)
        else:
            policy = RecordedPolicy(read_run(played))
        trace = Trace()
        period_s = env.unwrapped.core.timing.period_s

        def keep(info: Info) -> None:
            trace(info)
            on_time(len(trace) * period_s)

        record = rollout(env, policy, seed=run.seed, on_step=keep)
        late = env.unwrapped.core.late_actions
    finally:
        env.close()
    (made,) = set(folder.glob("*/")) - before
    return Side(record, trace, made, late)
