"""The demonstration: the three tasks by their scripted policies, as figures, a report and videos.

It ends on two emulated controllers, through `ur_rtde`, in real time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dual_ur10.cli.demo_report import films
from dual_ur10.cli.demo_report.film import FPS, Film
from dual_ur10.cli.demo_report.report import Findings, write_report
from dual_ur10.cli.demo_report.runs import RUNS, Result, Run, measure
from dual_ur10.cli.demo_report.runs_carry import CARRY_RUNS, CarryResult, CarryRun, measure_carry
from dual_ur10.cli.demo_report.runs_emulated import (
    CARRY,
    HANDOVER,
    PREPARING_S,
    EmulatedFailure,
    EmulatedResult,
    EmulatedRun,
    measure_emulated,
    sine_run,
)
from dual_ur10.cli.demo_report.runs_handover import HANDOVER_RUNS, HandoverResult, HandoverRun, measure_handovers
from dual_ur10.errors import DualUR10Error, MissingExtraError, RenderError

VIDEOS = {"sine": "sine_tracking.mp4", "carry": "sync_carry.mp4", "handover": "handover.mp4"}
"""Names of the videos by the task's short name."""

# In seconds on two cores without a GPU, so that the time left is estimated well.
_SINE_STEP, _CARRY_STEP, _RIGID_STEP, _HANDOVER_STEP = 0.0006, 0.004, 0.0015, 0.002
_FRAME, _SHADED_FRAME, _DRAWING = 0.07, 0.13, 4.0
_CARRY_STEPS, _HANDOVER_STEPS = 900, 300  # about

Progress = Callable[[str, float, float], None]
"""Told what is being done, how much of it is done, and how much there is in all."""

OnShare = Callable[[float], None]


@dataclass(frozen=True)
class Extent:
    """How much is shown.

    Attributes:
        sine_s: Length of the runs of SineTracking.
        sine_film_s: Length of its video.
        episodes: Of each run of Handover.
        carry_every, handover_every: Steps from one frame of a video to the next.
        emulated: What is run on emulated controllers, too.
    """

    sine_s: float = 30.0
    sine_film_s: float = 10.0
    episodes: int = 6
    carry_every: int = 4
    handover_every: int = 2
    emulated: tuple[EmulatedRun, ...] = (sine_run(20.0), CARRY, HANDOVER)


QUICK = Extent(
    sine_s=10.0,
    sine_film_s=1.2,
    episodes=2,
    carry_every=30,
    handover_every=10,
    emulated=(sine_run(2.0), HANDOVER),
)

RUNS_FOLDER = "runs"
"""Where recordings go, beside the report."""


@dataclass(frozen=True)
class _Job:
    text: str
    cost: float
    do: Callable[[OnShare], None]


def run_demo(out: Path, *, quick: bool = False, progress: Progress = lambda *_: None) -> Findings:
    """Run everything, and write `report.html`, the videos and the recordings.

    That something does not run on emulated controllers ends nothing else: the report says why.

    Args:
        out: Folder to write into; made if it does not exist.
        quick: Shorter episodes of SineTracking, fewer of Handover, videos with fewer frames, and no SyncCarry on
            emulated controllers.
        progress: Told how far it has got.

    Raises:
        MissingExtraError: matplotlib or imageio is not installed. Nothing has been run.
        DualUR10Error: `out` cannot be written to.
    """
    check_extra()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DualUR10Error(f"cannot write to {out}: {error}") from error
    extent = QUICK if quick else Extent()
    sine: list[Result] = []
    carry: list[CarryResult] = []
    handover: list[HandoverResult] = []
    shot: dict[str, Film] = {}
    reasons: list[str] = []
    emulated: list[EmulatedResult | EmulatedFailure] = []

    def film_job(name: str, cost: float, shoot: Callable[[Path, OnShare], Film]) -> _Job:
        def do(on_share: OnShare) -> None:
            if reasons:
                return
            try:
                shot[name] = shoot(out / VIDEOS[name], on_share)
            except RenderError as error:
                reasons.append(str(error))

        return _Job(f"drawing {VIDEOS[name]}", cost, do)

    jobs = [_sine_job(run, extent, sine) for run in RUNS]
    jobs += [_carry_job(run, carry) for run in CARRY_RUNS]
    jobs += [_handover_job(run, extent, handover) for run in HANDOVER_RUNS]
    jobs += [film_job(name, *film) for name, film in _films(extent).items()]

    # These last: they run in real time, and nothing else may then run beside them.
    jobs += [_emulated_job(run, out / RUNS_FOLDER, emulated) for run in extent.emulated]

    def findings() -> Findings:
        return Findings(sine, carry, handover, shot, "".join(reasons), emulated)

    jobs.append(_Job("writing the report", _DRAWING, lambda _: write_report(out / "report.html", findings())))
    _do(jobs, progress)
    return findings()


def _do(jobs: list[_Job], progress: Progress) -> None:
    """Do one after the other, and tell how far it is."""
    total, done = sum(job.cost for job in jobs), 0.0
    for job in jobs:
        progress(job.text, done, total)
        job.do(_teller(job, done, total, progress))
        done += job.cost
    progress("done", total, total)


def _teller(job: _Job, done: float, total: float, progress: Progress) -> OnShare:
    return lambda share: progress(job.text, done + min(share, 1.0) * job.cost, total)


def _sine_job(run: Run, extent: Extent, found: list[Result]) -> _Job:
    steps, count = round(extent.sine_s * FPS), iter(range(1, 1_000_000))

    def do(on_share: OnShare) -> None:
        found.append(measure(run, extent.sine_s, lambda _: on_share(next(count) / steps)))

    return _Job(f"SineTracking: {run.title}", steps * _SINE_STEP, do)


def _carry_job(run: CarryRun, found: list[CarryResult]) -> _Job:
    cost = _CARRY_STEPS * (_RIGID_STEP if run.rigid else _CARRY_STEP)
    return _Job(f"SyncCarry: {run.title}", cost, lambda on_share: found.append(measure_carry(run, on_share)))


def _handover_job(run: HandoverRun, extent: Extent, found: list[HandoverResult]) -> _Job:
    cost = extent.episodes * _HANDOVER_STEPS * _HANDOVER_STEP
    return _Job(
        f"Handover: {run.title}", cost, lambda share: found.extend(measure_handovers(run, extent.episodes, share))
    )


def _emulated_job(run: EmulatedRun, folder: Path, found: list[EmulatedResult | EmulatedFailure]) -> _Job:
    return _Job(
        f"{run.title} on emulated controllers",
        PREPARING_S + run.duration_s,
        lambda share: found.append(measure_emulated(run, folder, share)),
    )


def _films(extent: Extent) -> dict[str, tuple[float, Callable[[Path, OnShare], Film]]]:
    """What each film costs, and what draws it."""
    sine_steps = round(extent.sine_film_s * FPS)
    lengths = {"sine": sine_steps, "carry": _CARRY_STEPS, "handover": _HANDOVER_STEPS}

    def told(name: str, on_share: OnShare) -> Callable[[int], None]:
        return lambda step: on_share(step / lengths[name])

    return {
        "sine": (
            sine_steps * _SHADED_FRAME,
            lambda path, share: films.film_sine(path, extent.sine_film_s, told("sine", share)),
        ),
        "carry": (
            _CARRY_STEPS * (_CARRY_STEP + _FRAME / extent.carry_every),
            lambda path, share: films.film_carry(path, extent.carry_every, told("carry", share)),
        ),
        "handover": (
            _HANDOVER_STEPS * (_HANDOVER_STEP + _FRAME / extent.handover_every),
            lambda path, share: films.film_handover(path, extent.handover_every, told("handover", share)),
        ),
    }


def check_extra() -> None:
    """Make sure that what draws is installed.

    Raises:
        MissingExtraError: It is not.
    """
    for package in ("matplotlib", "imageio", "imageio_ffmpeg"):
        try:
            __import__(package)
        except ImportError:
            raise MissingExtraError(package.replace("_", "-"), "plot", "the demonstration's report") from None
