"""The demonstration: SineTracking by the scripted policy, nominal and perturbed, as figures, a report and a video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10 import ENV_IDS
from dual_ur10.errors import DualUR10Error, MissingExtraError, RenderError
from dual_ur10.policies.accuracy import accuracy, lag_s, skew_s
from dual_ur10.policies.rollout import Info, rollout
from dual_ur10.policies.sine_tracking import SineTrackingPolicy
from dual_ur10.report import write_report
from dual_ur10.runs import RUNS, Result, Run

ENV_ID = ENV_IDS[0]

_STEP_COST, _FRAME_COST, _DRAWING_COST = 1.0, 90.0, 4000.0  # in steps, so that the time left is estimated well
_FPS, _WIDTH, _HEIGHT = 25, 960, 540
_INK, _PAPER = (38, 50, 56), (255, 255, 255)


Progress = Callable[[str, float, float], None]
"""Told what is being done, how much of it is done, and how much there is in all."""


def run_demo(out: Path, *, quick: bool = False, progress: Progress = lambda *_: None) -> tuple[list[Result], str]:
    """Run everything, and write `report.html` and `sine_tracking.mp4`.

    Args:
        out: Folder to write into; made if it does not exist.
        quick: Episodes of 10 s instead of 30 s, and a video of 5 s instead of 10 s.
        progress: Told how far it has got.

    Returns:
        The results, in the order of `RUNS`, and why there is no video ("" if there is one).

    Raises:
        MissingExtraError: matplotlib or imageio is not installed. Nothing has been run.
        DualUR10Error: `out` cannot be written to.
    """
    check_extra()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DualUR10Error(f"cannot write to {out}: {error}") from error
    duration_s, video_s = (10.0, 5.0) if quick else (30.0, 10.0)
    steps, frames = round(duration_s * 25), round(video_s * _FPS)
    total = len(RUNS) * steps * _STEP_COST + frames * _FRAME_COST + _DRAWING_COST
    done = 0.0

    def advance(text: str, cost: float) -> None:
        nonlocal done
        done += cost
        progress(text, done, total)

    def step_of(run: Run) -> Callable[[Info], None]:
        return lambda _: advance(f"running: {run.title}", _STEP_COST)

    results = [measure(run, duration_s, step_of(run)) for run in RUNS]
    missing = ""
    try:
        record_video(out / "sine_tracking.mp4", video_s, lambda: advance("drawing the video", _FRAME_COST))
    except RenderError as error:
        missing = str(error)
    advance("writing the report", 0.0)
    write_report(out / "report.html", results, None if missing else out / "sine_tracking.mp4", missing)
    advance("done", total - done)
    return results, missing


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


def make(run: Run, duration_s: float, **keywords: Any) -> tuple[Any, SineTrackingPolicy]:
    """Environment and policy of a run."""
    env = gym.make(
        ENV_ID,
        cell=run.cell,
        axis=run.axis,
        duration_s=duration_s,
        randomize=False,
        arms=run.arms,
        compensate_lag=run.compensate_lag,
        action_latency_ticks=run.latency_ticks,
        **keywords,
    )
    mounts = (run.cell.left, run.cell.right)
    return env, SineTrackingPolicy(env.unwrapped.core.timing, mounts=mounts, learn=run.learn)  # type: ignore[attr-defined]


def measure(run: Run, duration_s: float, on_step: Callable[[Info], None] | None = None) -> Result:
    """Run one episode and compute its figures.

    Raises:
        DualUR10Error: The episode was cut short: its figures would mean nothing.
    """
    env, policy = make(run, duration_s)
    try:
        record = rollout(env, policy, seed=0, on_step=on_step)
    finally:
        env.close()
    if record.ended_by:
        raise DualUR10Error(f"the run '{run.title}' ended after {record.time_s[-1]:g} s: {record.ended_by}")
    lag = lag_s(record)
    return Result(
        run=run,
        record=record,
        accuracy=accuracy(record),
        lag_s=float(lag[~np.isnan(lag)].max()),
        skew_s=skew_s(record),
    )


def record_video(path: Path, duration_s: float, on_frame: Callable[[], None] = lambda: None) -> None:
    """Draw the perturbed run, in real time.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
    """
    import imageio.v2 as imageio

    run = RUNS[1]
    env, policy = make(run, duration_s, render_mode="rgb_array", width=_WIDTH, height=_HEIGHT, shadows=True)
    frames: list[Any] = []

    def draw(info: Info) -> None:
        error_mm = 1e3 * np.asarray(info["flange_error_m"])
        text = (
            f"SineTracking, {run.title} plant     t = {len(frames) / _FPS + 1 / _FPS:5.2f} s     "
            f"flange error  left {error_mm[0]:.2f} mm   right {error_mm[1]:.2f} mm"
        )
        frames.append(_captioned(env.render(), text))
        on_frame()

    try:
        rollout(env, policy, seed=0, on_step=draw)
    finally:
        env.close()
    with imageio.get_writer(
        path, fps=_FPS, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    ) as writer:
        for frame in frames:
            writer.append_data(frame)  # type: ignore[attr-defined]


def _captioned(image: Any, text: str) -> Any:
    """The image with a line of text at its foot."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, _HEIGHT - 34, _WIDTH, _HEIGHT), fill=_INK)
    draw.text((16, _HEIGHT - 17), text, fill=_PAPER, font=ImageFont.load_default(17), anchor="lm")
    return np.asarray(picture)
