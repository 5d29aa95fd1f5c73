"""What the demonstration's films show of each task."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dual_ur10.cli.demo_report.film import HEIGHT, WIDTH, Film, Script, shoot
from dual_ur10.cli.demo_report.runs import RUNS, make
from dual_ur10.cli.demo_report.runs_carry import CARRY_RUNS, make_carry
from dual_ur10.cli.demo_report.runs_handover import HANDOVER_RUNS, make_handover
from dual_ur10.envs.tasks.sync_carry.path import MOVES
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.policies.evaluation.rollout import Info

SINE_RUN, CARRY_RUN, HANDOVER_RUN = RUNS[1], CARRY_RUNS[-1], HANDOVER_RUNS[-1]
"""The runs that are filmed: none of them on the nominal plant with everything known."""

# What each of the six numbers of the carried bar's pose does, in the order of `MOVES`.
_MOVED = ("moved forward", "moved sideways", "lifted", "tilted", "turned about its length", "turned about the vertical")

_IMAGES = {"render_mode": "rgb_array", "width": WIDTH, "height": HEIGHT}

OnStep = Callable[[int], None]


def film_sine(path: Path, duration_s: float, on_step: OnStep = lambda _: None) -> Film:
    """The sine, in real time.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
    """
    env, policy = make(SINE_RUN, duration_s, shadows=True, **_IMAGES)

    def caption(time_s: float, info: Info) -> str:
        error_mm = 1e3 * np.asarray(info["flange_error_m"])
        return (
            f"SineTracking, {SINE_RUN.title} plant     t = {time_s:5.2f} s     "
            f"flange error  left {error_mm[0]:.2f} mm   right {error_mm[1]:.2f} mm"
        )

    return shoot(path, env, policy, Script(f"SineTracking, {SINE_RUN.title} plant.", caption), on_step=on_step)


def film_carry(path: Path, every: int, on_step: OnStep = lambda _: None) -> Film:
    """The carried bar.

    Args:
        path: Of the video.
        every: Steps from one frame to the next.
        on_step: Told of the number of steps after each.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
    """
    env, policy = make_carry(CARRY_RUN, **_IMAGES)
    due = carry_instants(env.unwrapped.task.settings.duration_s)

    def caption(time_s: float, info: Info) -> str:
        begin = f"SyncCarry, {CARRY_RUN.title}     t = {time_s:4.1f} s     "
        if info["clock_s"] <= 0.0:
            return begin + "grasping"
        return (
            f"{begin}flanges to each other {1e3 * info['relative_error_m']:.2f} mm, "
            f"{math.degrees(info['relative_error_rad']):.2f}°   squeeze {abs(info['squeeze_n']):.1f} N"
        )

    def keys(time_s: float, info: Info) -> tuple[str, str] | None:
        if not due or info["clock_s"] < due[0][0] - 1e-9:
            return None
        title = due.pop(0)[1]
        position = ", ".join(f"{value:.2f}" for value in info["object_m"]).replace("-", "−")
        return title, f"t = {time_s:.1f} s, bar at {position}\u00a0m"

    script = Script(f"SyncCarry, {CARRY_RUN.title}.", caption, every, keys)
    return shoot(path, env, policy, script, seed=CARRY_RUN.seed, on_step=on_step)


def carry_instants(duration_s: float) -> list[tuple[float, str]]:
    """Times on the path at which to look at the bar, and what has just been done: the first move of each kind."""
    moves = MOVES[duration_s]
    ends = [(min(end for _, end, each, _ in moves if each == number), title) for number, title in enumerate(_MOVED)]
    return [(-math.inf, "the bar on the table"), *sorted(ends), (duration_s, "laid down")]


def film_handover(path: Path, every: int, on_step: OnStep = lambda _: None) -> Film:
    """The block that changes hands.

    Args:
        path: Of the video.
        every: Steps from one frame to the next.
        on_step: Told of the number of steps after each.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
    """
    env, policy = make_handover(HANDOVER_RUN, camera="front", **_IMAGES)
    stages = env.unwrapped.task.stages
    shown = -1

    def caption(time_s: float, info: Info) -> str:
        stage, giver = int(info["stage"]), ARMS[int(info["giver"])]
        doing = f"stage {stage + 1} of {len(stages)}: {_words(stages[stage])}" if stage < len(stages) else "placed"
        return f"Handover, the {giver} arm gives, {HANDOVER_RUN.title}     t = {time_s:4.1f} s     {doing}"

    def keys(time_s: float, info: Info) -> tuple[str, str] | None:
        nonlocal shown
        stage = int(info["stage"])
        if stage == shown:
            return None
        shown = stage
        title = "begin" if stage == 0 else f"{stage}. {_words(stages[stage - 1])}"
        away = 1e3 * info["object_error_m"]
        return title, f"t = {time_s:.1f} s, {away:.{0 if away > 20 else 1}f} mm to the target"

    return shoot(path, env, policy, Script(f"Handover, {HANDOVER_RUN.title}.", caption, every, keys), on_step=on_step)


def _words(name: str) -> str:
    return name.replace("_", " ")
