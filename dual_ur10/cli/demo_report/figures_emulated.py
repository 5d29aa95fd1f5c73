"""The figures of the emulated controllers in the demonstration's report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.policies.evaluation.accuracy import errors
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, figure
from dual_ur10.types import Array

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.runs_emulated import EmulatedResult, Side

SIMULATED_COLOR, EMULATED_COLOR = INK, "#009E73"

_LEAST_MM = 1e-4

TASK_ERRORS = {
    "sine": "flange error of the worse arm",
    "carry": "error of the pose between the flanges",
    "handover": "distance of the block to its target",
}
"""What is drawn of each task, by its short name."""


def task_error_mm(name: str, side: Side) -> Array:
    """(k,) the task's error over time; see `TASK_ERRORS`."""
    if name == "sine":
        error = errors(side.record).flange_m.max(axis=1)
    elif name == "carry":
        error = np.where(side.trace["clock_s"] > 0.0, np.abs(side.trace["relative_error_m"]), np.nan)
    else:
        error = side.trace["object_error_m"]
    result: Array = 1e3 * error
    return result


def side_by_side(result: EmulatedResult) -> str:
    """The task's error on both cells, and the way between the flanges of both."""
    with figure(1, 2, 3.0) as (_, axes, address):
        left, right = axes[0]
        for side, color, label in (
            (result.simulated, SIMULATED_COLOR, "simulated"),
            (result.emulated, EMULATED_COLOR, "emulated"),
        ):
            error = np.maximum(task_error_mm(result.run.name, side), _LEAST_MM)
            left.semilogy(side.record.time_s, error, color=color, label=label, linewidth=1)
        left.set(xlabel="time (s)", ylabel="mm, log scale")
        left.set_ylim(top=6 * left.get_ylim()[1])  # room for the legend
        left.set_title(f"{result.run.title}: {TASK_ERRORS[result.run.name]}")
        left.legend(ncols=2, loc="upper right")
        for pair in result.comparison.pairs:
            apart = 1e3 * np.linalg.norm(pair.flange_m[0] - pair.flange_m[1], axis=2)
            for arm, name in enumerate(ARMS):
                right.plot(pair.time_s, apart[:, arm], color=ARM_COLORS[arm], label=name, linewidth=1)
        right.set(xlabel="time on the task's clock (s)", ylabel="mm")
        right.set_ylim(bottom=0.0, top=1.25 * right.get_ylim()[1])
        right.set_title("Way between the simulated flange and the emulated one")
        right.legend(ncols=2, loc="upper right")
        for axis in (left, right):
            axis.margins(x=0.01)
    return address[0]
