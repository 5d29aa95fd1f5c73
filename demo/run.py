"""Run of the demonstration: cases, videos and emulated controllers, one after the other, and the report at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from demo.case import Case, CaseResult, DemoTask, Key, make
from demo.emulated import (
    CARRY,
    HANDOVER,
    PREPARING_S,
    EmulatedFailure,
    EmulatedPair,
    EmulatedRun,
    measure_emulated,
    sine_run,
)
from demo.film import EpisodeVideo, shoot
from demo.report import TASKS, Findings, write_report
from dual_ur10.errors import DualUR10Error, RenderError
from dual_ur10.policies.evaluation.film import Take, take

# In seconds on two cores without a GPU, for the estimate of the time left.
_FRAME_S, _DRAWING_S = 0.05, 4.0

_RATE_HZ, _FPS = 25, 25  # of policies and videos

Progress = Callable[[str, float, float], None]
"""Called with a description of the work, how much is done, and how much there is in all."""

OnRatio = Callable[[float], None]


@dataclass(frozen=True)
class Extent:
    """Size of the demonstration.

    Attributes:
        duration_s: Length of an episode, where the task lets it be chosen.
        film_s: The same of an episode that is filmed.
        episodes: Episodes of each case of a task that has many.
        speed: Speed of a video over that of its episode, by the task's short name and "emulated"; 1 elsewhere.
        emulated: Runs on emulated controllers.
    """

    duration_s: float = 30.0
    film_s: float = 10.0
    episodes: int = 6
    speed: Mapping[str, float] = field(default_factory=lambda: {"carry": 4.0, "handover": 2.0, "emulated": 2.0})
    emulated: tuple[EmulatedRun, ...] = (sine_run(20.0), CARRY, HANDOVER)


QUICK = Extent(
    duration_s=10.0,
    film_s=1.2,
    episodes=2,
    speed={"carry": 30.0, "handover": 10.0, "emulated": 10.0},
    emulated=(sine_run(2.0), HANDOVER),
)

RUNS_FOLDER = "runs"
"""Folder of the recordings, beside the report."""


@dataclass(frozen=True)
class _Job:
    text: str
    cost_s: float
    do: Callable[[OnRatio], None]


def run_demo(out: Path, *, quick: bool = False, progress: Progress = lambda *_: None) -> Findings:
    """Run everything, and write `report.html`, the videos and the recordings.

    A failure on emulated controllers ends nothing else: the report gives its reason.

    Args:
        out: Folder to write into; made if it does not exist.
        quick: Shorter episodes of SineTracking, fewer of Handover, videos with fewer frames, and no SyncCarry on
            emulated controllers.
        progress: Called as the work proceeds.

    Raises:
        DualUR10Error: `out` cannot be written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DualUR10Error(f"cannot write to {out}: {error}") from error
    extent = QUICK if quick else Extent()
    results: dict[str, list[CaseResult]] = {task.name: [] for task in TASKS}
    films: dict[str, EpisodeVideo] = {}
    missing: list[str] = []
    pairs: list[EmulatedPair] = []
    failures: list[EmulatedFailure] = []

    def measuring(task: DemoTask, case: Case) -> _Job:
        seeds = range(extent.episodes if task.many else 1)
        case, steps = sized(task, case, extent.duration_s)
        total = len(seeds) * steps

        def do(on_ratio: OnRatio) -> None:
            results[task.name] += task.measure(case, seeds, lambda done: on_ratio(done / total))

        return _Job(f"{task.title}: {case.title}", total * task.step_s, do)

    def filming(task: DemoTask) -> _Job:
        case, steps = sized(task, task.filmed, extent.film_s)

        def do(on_ratio: OnRatio) -> None:
            if missing:
                return
            env, policy = make(case)
            with contextlib.closing(env):
                shown = take(env, policy, seed=0)
            title = f"{task.title}, {case.title}"
            draw(task.name, task.video, shown, title, f"{title}.", task.keys(shown), on_ratio)

        frames = steps / extent.speed.get(task.name, 1.0) * _FPS / _RATE_HZ
        return _Job(f"drawing {task.video}", steps * task.step_s + frames * _FRAME_S, do)

    def filming_emulated() -> _Job:
        def do(on_ratio: OnRatio) -> None:
            if missing or not pairs:
                return
            pair = pairs[-1]  # that of Handover, if it did not fail
            title = f"{pair.run.task.title} on two emulated controllers"
            text = f"{title}, scripted policy: as the controllers and the tracker reported the poses."
            draw("emulated", "emulated.mp4", pair.shown, title, text, (), on_ratio)

        steps = max((run.duration_s for run in extent.emulated), default=0.0) * _RATE_HZ
        return _Job("drawing emulated.mp4", steps / extent.speed.get("emulated", 1.0) * _FRAME_S, do)

    def draw(name: str, file: str, shown: Take, title: str, text: str, keys: Sequence[Key], on_ratio: OnRatio) -> None:
        speed = extent.speed.get(name, 1.0)
        try:
            films[name] = shoot(out / file, shown, title, text, speed=speed, keys=keys, on_ratio=on_ratio)
        except RenderError as error:
            missing.append(str(error))

    def emulating(run: EmulatedRun) -> _Job:
        def do(on_ratio: OnRatio) -> None:
            found = measure_emulated(run, out / RUNS_FOLDER, on_ratio)
            if isinstance(found, EmulatedFailure):
                failures.append(found)
            else:
                pairs.append(found)

        return _Job(f"{run.task.title} on emulated controllers", PREPARING_S + run.duration_s, do)

    def findings() -> Findings:
        return Findings(results, films, "".join(missing), pairs, failures)

    jobs = [measuring(task, case) for task in TASKS for case in task.cases]
    jobs += map(filming, TASKS)
    # In real time: nothing else may run beside them.
    jobs += map(emulating, extent.emulated)
    jobs.append(filming_emulated())
    jobs.append(_Job("writing the report", _DRAWING_S, lambda _: write_report(out / "report.html", findings())))
    _do(jobs, progress)
    return findings()


def sized(task: DemoTask, case: Case, duration_s: float) -> tuple[Case, int]:
    """Return a case with episodes of this length, if the task lets it be chosen, and their approximate steps."""
    return (case, task.steps) if task.steps else (case.given(duration_s=duration_s), round(duration_s * _RATE_HZ))


def _do(jobs: list[_Job], progress: Progress) -> None:
    """Do the jobs one after the other."""
    total, done = sum(job.cost_s for job in jobs), 0.0

    def ratio_of(job: _Job, before: float) -> OnRatio:
        return lambda ratio: progress(job.text, before + min(ratio, 1.0) * job.cost_s, total)

    for job in jobs:
        progress(job.text, done, total)
        job.do(ratio_of(job, done))
        done += job.cost_s
    progress("done", total, total)
