"""The figures of Handover in the demonstration's report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, SOFT, figure

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.runs_handover import HandoverResult

STAGE_COLORS = ("#CFD8DC", "#56B4E9", "#0072B2", "#009E73", "#F0E442", "#E69F00", "#CC79A7")


def stages_over_time(results: Sequence[HandoverResult]) -> str:
    """When each stage was under way, a bar for each episode."""
    with figure(1, 1, 1.5 + 0.27 * len(results)) as (_, axes, address):
        axis = axes[0, 0]
        stages = results[0].stages
        for row, result in enumerate(results):
            begin = 0.0
            for stage, end in enumerate(result.passed_s):
                stop = result.time_s if math.isnan(end) else end
                axis.barh(row, stop - begin, left=begin, height=0.72, color=STAGE_COLORS[stage])
                begin = stop
            axis.barh(row, result.time_s - begin, left=begin, height=0.72, color="#FFFFFF", edgecolor=SOFT)
        handles = [axis.barh(0, 0.0, color=color) for color in STAGE_COLORS]
        handles.append(axis.barh(0, 0.0, color="#FFFFFF", edgecolor=SOFT))
        labels = [name.replace("_", " ") for name in stages]
        axis.legend(handles, [*labels, "at rest"], ncols=8, loc="upper left", columnspacing=1.1, handlelength=1.2)
        axis.set_yticks(range(len(results)), [f"{each.run.name}, seed {each.seed}, {each.giver}" for each in results])
        axis.set(xlabel="time (s)", ylim=(len(results) - 0.4, -1.7), xlim=(0, max(each.time_s for each in results)))
        axis.grid(axis="y", visible=False)
        axis.set_title("Stage under way, by episode (the arm named gives)")
    return address[0]


def one_handover(result: HandoverResult) -> str:
    """Height of the block, its distance to the target and its slip over time, in one episode."""
    with figure(1, 2, 3.4) as (_, axes, address):
        left, right = axes[0]
        time_s = result.period_s * np.arange(1, len(result.trace) + 1)
        left.plot(time_s, 1e3 * result.trace["object_m"][:, 2], color=INK, label="height of the block")
        left.plot(time_s, 1e3 * result.trace["object_error_m"], color="#009E73", label="distance to the target")
        left.set(xlabel="time (s)", ylabel="mm")
        left.set_title(f"Pose {result.run.name}, seed {result.seed} (dotted: a stage is passed)")
        most = 1e3 * result.trace["object_error_m"].max()
        left.set_ylim(0, 1.3 * most)
        for number, end in enumerate(result.passed_s, 1):
            if not math.isnan(end):
                left.axvline(end, ymax=1.05 / 1.3, color=SOFT, linestyle=":", linewidth=1.2)
                left.text(end, 1.06 * most, str(number), ha="center", va="bottom", fontsize=8)
        left.legend(ncols=2, loc="upper right")
        slip = 1e3 * result.trace["slip_m"]
        for arm, label in enumerate(ARMS):
            right.plot(time_s, slip[:, arm], color=ARM_COLORS[arm], label=f"{label} gripper")
        right.set(xlabel="time (s)", ylabel="slip (mm)", ylim=(0, max(0.01, 1.3 * slip.max())))
        right.set_title("Way of the block in the gripper that holds it")
        right.legend(ncols=2, loc="upper right")
        for axis in (left, right):
            axis.set_xlim(0, time_s[-1])
    return address[0]
