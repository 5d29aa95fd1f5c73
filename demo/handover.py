"""Handover in the demonstration: cases, figures, plots and video."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from demo.case import JOINT_SPEED, SUCCESS, Case, CaseResult, DemoTask, Key, figure_column
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.policies.evaluation.film import Take
from dual_ur10.sim2real.analysis.page import Column
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, SOFT, capital, figure
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

HANDOVER_ID = "DualUR10/Handover-v0"

NOISE = {"object_noise_m": 0.002, "object_noise_rad": 0.01745}
"""Measurement error of the block's pose where it is not exact: σ along and about each axis, constant in an episode."""

CASES = (
    Case("known", "pose known exactly", HANDOVER_ID, {"giver": "random"}),
    Case(
        "noisy",
        f"pose known to {1e3 * NOISE['object_noise_m']:g} mm, {math.degrees(NOISE['object_noise_rad']):.2g}°",
        HANDOVER_ID,
        {"giver": "random", "randomization": NOISE},
    ),
    Case(
        "learned",
        "learned policy, wide randomization",
        HANDOVER_ID,
        {"randomization": "wide"},  # the left arm gives: what it was trained for
        policy="learned",
    ),
)

_PLACED: tuple[Column[CaseResult], ...] = (
    Column[CaseResult]("time", "s", lambda result: f"{result.record.time_s[-1]:.2f}"),
    figure_column("placing error", "mm", "place_mm"),
    figure_column("placing angle", "°", "place_deg"),
    figure_column("slip", "mm", "slip_max_mm"),
)

COLUMNS = (Column[CaseResult]("gives", "", lambda result: str(result.figures["giver"])), SUCCESS, *_PLACED, JOINT_SPEED)


def figures(result: CaseResult) -> dict[str, Any]:
    """Return figures of an episode.

    `giver`: name of the arm that gives. `passed_s`: time at which each stage was passed, see `passed_s`. `place_mm`,
    `place_deg`: distance of the block to its target at the end, and angle between their long axes. `slip_max_mm`:
    largest slip of a grip in the gripper that held it.
    """
    trace = result.trace
    return {
        "giver": ARMS[int(trace["giver"][0])],
        "passed_s": passed_s(trace["stage"], len(Handover.stages), result.record.period_s),
        "place_mm": 1e3 * float(trace["object_error_m"][-1]),
        "place_deg": math.degrees(float(trace["object_error_rad"][-1])),
        "slip_max_mm": 1e3 * float(trace["slip_m"].max()),
    }


def passed_s(stage: Array, stages: int, period_s: float) -> tuple[float, ...]:
    """Return the time at which each stage was passed; NaN where it never was.

    Args:
        stage: (k,) number of stages passed at the end of each step.
        stages: Number of stages.
        period_s: Time of a step.
    """
    first = [np.flatnonzero(stage > k)[:1] for k in range(stages)]
    return tuple(period_s * (float(each[0]) + 1.0) if len(each) else math.nan for each in first)


def context(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Return plots and values for the template."""
    cut = [f"Seed {each.seed}, {each.case.title}: {each.record.ended_by}." for each in results if each.record.ended_by]
    return {
        "summary": summary(results),
        "cut_short": " ".join(cut),
        "stages": stages_over_time([each for each in results if not each.case.nominal]),
        "one": one_handover(results[-1]),
    }


def summary(results: Sequence[CaseResult]) -> str:
    """Return successes and median time of each case, as a sentence."""
    parts = []
    for title in dict.fromkeys(each.case.title for each in results):
        episodes = [each for each in results if each.case.title == title]
        times = [float(each.record.time_s[-1]) for each in episodes if each.record.success]
        took = f", median {median(times):.1f} s" if times else ""
        parts.append(f"{title}: {len(times)} of {len(episodes)} succeed{took}")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def keys(shown: Take) -> list[Key]:
    """Return a key frame for the begin and for each stage passed."""
    found: list[Key] = []
    last = -1
    for number, info in enumerate(shown.infos):
        stage = int(info["stage"])
        if stage == last:
            continue
        last = stage
        title = "begin" if stage == 0 else f"{stage}. {Handover.stages[stage - 1].replace('_', ' ')}"
        away = 1e3 * float(info["object_error_m"])
        text = f"t = {number * shown.period_s:.1f} s, {away:.{0 if away > 20 else 1}f} mm to the target"
        found.append((number, title, text))
    return found


STAGE_COLORS = ("#CFD8DC", "#56B4E9", "#0072B2", "#009E73", "#F0E442", "#E69F00", "#CC79A7")


def stages_over_time(results: Sequence[CaseResult]) -> str:
    """Plot the stages over time, a bar for each episode."""
    with figure(1, 1, 1.5 + 0.27 * len(results)) as (_, axes, address):
        axis = axes[0, 0]
        stages = Handover.stages
        for row, result in enumerate(results):
            begin = 0.0
            for stage, end in enumerate(result.figures["passed_s"]):
                stop = result.record.time_s[-1] if math.isnan(end) else end
                axis.barh(row, stop - begin, left=begin, height=0.72, color=STAGE_COLORS[stage])
                begin = stop
            axis.barh(row, result.record.time_s[-1] - begin, left=begin, height=0.72, color="#FFFFFF", edgecolor=SOFT)
        handles = [axis.barh(0, 0.0, color=color) for color in STAGE_COLORS]
        handles.append(axis.barh(0, 0.0, color="#FFFFFF", edgecolor=SOFT))
        labels = [name.replace("_", " ") for name in stages]
        axis.legend(handles, [*labels, "at rest"], ncols=8, loc="upper left", columnspacing=1.1, handlelength=1.2)
        axis.set_yticks(
            range(len(results)), [f"{each.case.name}, seed {each.seed}, {each.figures['giver']}" for each in results]
        )
        axis.set(
            xlabel="time (s)",
            ylim=(len(results) - 0.4, -1.7),
            xlim=(0, max(each.record.time_s[-1] for each in results)),
        )
        axis.grid(axis="y", visible=False)
        axis.set_title("Stage under way, by episode (the arm named gives)")
    return address[0]


def one_handover(result: CaseResult) -> str:
    """Plot height of the block, its distance to the target and its slip over time, in one episode."""
    with figure(1, 2, 3.4) as (_, axes, address):
        left, right = axes[0]
        time_s = result.record.time_s
        left.plot(time_s, 1e3 * result.trace["object_m"][:, 2], color=INK, label="height of the block")
        left.plot(time_s, 1e3 * result.trace["object_error_m"], color="#009E73", label="distance to the target")
        left.set(xlabel="time (s)", ylabel="mm")
        left.set_title(f"{capital(result.case.title)}, seed {result.seed} (dotted: a stage is passed)")
        most = 1e3 * result.trace["object_error_m"].max()
        left.set_ylim(0, 1.3 * most)
        for number, end in enumerate(result.figures["passed_s"], 1):
            if not math.isnan(end):
                left.axvline(end, ymax=1.05 / 1.3, color=SOFT, linestyle=":", linewidth=1.2)
                left.text(end, 1.06 * most, str(number), ha="center", va="bottom", fontsize=8)
        left.legend(ncols=2, loc="upper right")
        slip = 1e3 * result.trace["slip_m"]
        for arm, label in enumerate(ARMS):
            right.plot(time_s, slip[:, arm], color=ARM_COLORS[arm], label=f"{label} gripper")
        right.set(xlabel="time (s)", ylabel="slip (mm)", ylim=(0, max(0.01, 1.3 * slip.max())))
        right.set_title("Slip of the block in the gripper that holds it")
        right.legend(ncols=2, loc="upper right")
        for axis in (left, right):
            axis.set_xlim(0, time_s[-1])
    return address[0]


TASK = DemoTask(
    name="handover",
    title="Handover",
    cases=CASES,
    columns=COLUMNS,
    emulated_columns=(SUCCESS, *_PLACED),
    figures=figures,
    context=context,
    filmed=CASES[-1],
    keys=keys,
    video="handover.mp4",
    step_s=0.002,
    steps=300,
    many=True,
)
