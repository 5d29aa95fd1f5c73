"""SineTracking in the demonstration: cases, figures, plots and video."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from demo.case import SUCCESS, Case, CaseResult, DemoTask, figure_column
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.policies.evaluation.accuracy import accuracy, along_axis, correlation, errors, lag_s, skew_s
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, capital, figure, legend_right
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import TYPICAL_PERTURBATION
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS, JOINTS

SINE_ID = "DualUR10/SineTracking-v0"

ASYMMETRIC_CELL = CellConfig(left=ArmMount((-0.75, 0.6, 0.0)), right=ArmMount((-0.92, -0.45, 0.08)))
"""Cell in which accuracy is measured. In a symmetric cell both arms make the same errors, and the distance between them
is exact whatever the controller does."""

PERTURBED_CELL = replace(ASYMMETRIC_CELL, perturbation=TYPICAL_PERTURBATION)

LATENCY_TICKS = 5


def sine_case(
    name: str,
    title: str,
    cell: CellConfig = ASYMMETRIC_CELL,
    *,
    learn: bool = True,
    duration_s: float = 30.0,
    axis: str = "y",
    **keywords: Any,
) -> Case:
    """Return a case of SineTracking; y is the line between the flanges."""
    given = {"cell": cell, "axis": axis, "duration_s": duration_s, "randomize": False, **keywords}
    return Case(name, title, SINE_ID, given, learn)


CASES = (
    sine_case("nominal", "nominal"),
    sine_case("perturbed", "perturbed", PERTURBED_CELL),
    sine_case("perturbed_fixed", "perturbed, without learning", PERTURBED_CELL, learn=False),
    sine_case(
        "perturbed_late", f"perturbed, L = {LATENCY_TICKS} ticks", PERTURBED_CELL, action_latency_ticks=LATENCY_TICKS
    ),
    sine_case("single", "single arm, nominal", arms="left"),
    sine_case("single_perturbed", "single arm, perturbed", PERTURBED_CELL, arms="left"),
    sine_case("lagging", "nominal, lag not compensated", learn=False, compensate_lag=False),
)

_ACCURACY = (
    figure_column("flange RMS", "mm", "flange_rms_mm"),
    figure_column("flange max", "mm", "flange_max_mm"),
    figure_column("angle max", "°", "orientation_max_deg"),
    figure_column("vector max", "mm", "vector_max_mm"),
)
_RMS, _MAX, _ANGLE, _VECTOR = _ACCURACY

COLUMNS = (
    _MAX,
    _RMS,
    _ANGLE,
    figure_column("distance max", "mm", "distance_max_mm"),
    _VECTOR,
    figure_column("ripple max", "mm/s", "ripple_max_m_s", 1e3),
    figure_column("lag", "ms", "lag_s", 1e3),
    figure_column("skew", "ms", "skew_s", 1e3),
)


def figures(result: CaseResult) -> dict[str, float]:
    """Return accuracy, lag of the slower of the tracking arms, and skew between the arms (NaN if only one moves)."""
    lags = [value for value in lag_s(result.record).tolist() if not math.isnan(value)]
    return {
        **asdict(accuracy(result.record)),
        "lag_s": max(lags, default=math.nan),
        "skew_s": skew_s(result.record),
    }


def context(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Return plots and values for the template."""
    named = {result.case.name: result for result in results}
    limit_rad_s = max(SineTracking.limits.speed_rad_s)
    return {
        "named": named,
        "duration_s": named["nominal"].record.time_s[-1],
        "overview": overview(named),
        "flange_error": flange_error(named),
        "distance_and_vector": distance_and_vector(named),
        "lag": lag(named),
        "skew": skew(named),
        "joint_speeds": joint_speeds(named, limit_rad_s),
        "ripple": ripple(named),
    }


Results = Mapping[str, CaseResult]

# Okabe and Ito's colours, which colour-blind readers can tell apart.
RUN_COLORS = {
    "lagging": "#CC79A7",
    "perturbed_fixed": "#E69F00",
    "perturbed_late": "#56B4E9",
    "perturbed": "#0072B2",
}
JOINT_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#555555")
AXIS_COLORS = ("#D55E00", "#009E73", "#0072B2")


def overview(results: Results) -> str:
    """Plot the flange error of the worse arm in all runs of both arms, on a logarithmic scale."""
    with figure(1, 1, 3.8) as (_, axes, address):
        axis = axes[0, 0]
        for name, color in RUN_COLORS.items():
            result = results[name]
            error = 1e3 * errors(result.record).flange_m.max(axis=1)
            axis.semilogy(result.record.time_s, np.maximum(error, 1e-3), color=color, label=result.case.title)
        axis.set(xlabel="time (s)", ylabel="flange error (mm, log scale)", ylim=(1e-3, 60))
        axis.set_title("Flange error, the worse of both arms")
        axis.margins(x=0.01)
        legend_right(axis)
    return address[0]


def flange_error(results: Results) -> str:
    """Plot the flange error of each arm over time."""
    names = ("perturbed", "perturbed_fixed")
    with figure(len(names), 1, 4.6, sharex=True) as (_, axes, address):
        for axis, name in zip(axes[:, 0], names, strict=True):
            result = results[name]
            error = errors(result.record).flange_m
            for arm, label in enumerate(ARMS):
                axis.plot(result.record.time_s, 1e3 * error[:, arm], color=ARM_COLORS[arm], label=label, linewidth=1)
            axis.set_ylabel("flange error (mm)")
            axis.set_ylim(0, 1.2e3 * error.max())
            axis.margins(x=0.01)
            axis.set_title(f"{capital(result.case.title)}: at most {1e3 * error.max():.2g} mm")
            axis.legend(ncols=2, loc="upper right")
        axes[-1, 0].set_xlabel("time (s)")
    return address[0]


def distance_and_vector(results: Results) -> str:
    """Plot the distance between the flanges around its reference, and the error of the vector between them."""
    with figure(2, 2, 5.6, sharex=True) as (_, axes, address):
        for column, name in enumerate(("perturbed", "perturbed_fixed")):
            result = results[name]
            found, time_s = errors(result.record), result.record.time_s
            top, bottom = axes[:, column]
            top.plot(time_s, 1e3 * found.distance_m, color="#263238", linewidth=1)
            top.set_ylabel(f"distance − {1e3 * _distance_m(result):.0f} mm (mm)")
            top.set_title(capital(result.case.title))
            for axis, color, label in zip(range(3), AXIS_COLORS, "xyz", strict=True):
                bottom.plot(time_s, 1e3 * found.vector_m[:, axis], color=color, label=label, linewidth=1)
            size = 1e3 * np.linalg.norm(found.vector_m, axis=1)
            bottom.plot(time_s, size, color="#263238", linewidth=0.8, label="length")
            bottom.set(xlabel="time (s)", ylabel="error of the vector (mm)")
            bottom.legend(ncols=4, loc="upper right")
            for each, most in ((top, 1e3 * np.abs(found.distance_m).max()), (bottom, size.max())):
                each.set_ylim(-1.5 * max(most, 1e-6), 1.5 * max(most, 1e-6))
                each.margins(x=0.01)
    return address[0]


def joint_speeds(results: Results, limit_rad_s: float) -> str:
    """Plot joint speeds of both arms against the task's limit, in the perturbed run."""
    with figure(1, 2, 3.6, sharey=True) as (_, axes, address):
        record = results["perturbed"].record
        speed = np.gradient(record.q_rad, record.period_s, axis=0)
        for arm, axis in enumerate(axes[0]):
            for joint, name in enumerate(JOINTS):
                label = name.removesuffix("_joint").replace("_", " ")
                # The last wrist rotates as the pan does, to keep the tool's heading: dashes show both curves.
                line = (0, (4, 4)) if joint == 5 else "-"
                color = JOINT_COLORS[joint]
                axis.plot(record.time_s, speed[:, arm, joint], color=color, label=label, linestyle=line)
            for sign in (-1, 1):
                axis.axhline(sign * limit_rad_s, color="#b71c1c", linestyle="--", linewidth=1.1)
            axis.text(0.2, limit_rad_s, f"limit of the task {limit_rad_s:g} rad/s", color="#b71c1c", va="bottom")
            used = np.abs(speed[:, arm]).max() / limit_rad_s
            axis.set_title(f"{capital(ARMS[arm])} arm: at most {100 * used:.0f} % of the limit")
            axis.set(xlabel="time (s)", ylim=(-1.25 * limit_rad_s, 1.25 * limit_rad_s))
            axis.set_xlim(0, min(10.0, record.time_s[-1]))
        axes[0, 0].set_ylabel("joint speed (rad/s)")
        legend_right(axes[0, 1])
    return address[0]


def skew(results: Results) -> str:
    """Plot the time skew between the arms, by cross-correlation of their displacements."""
    with figure(1, 2, 3.4, width_ratios=(1, 1.25)) as (_, axes, address):
        left, right = axes[0]
        record = results["perturbed"].record
        position, _ = along_axis(record)
        lags, values = correlation(position[:, 0], position[:, 1])
        left.plot(1e3 * lags * record.period_s, values, "o-", color=RUN_COLORS["perturbed"], markersize=4)
        left.axvline(0, color="#90a4ae", linewidth=1)
        left.set(xlabel="left arm moved by (ms)", ylabel="correlation with the right arm")
        left.set_title("Perturbed: cross-correlation of both arms")
        names = [name for name in RUN_COLORS if name != "lagging"]
        skews = [1e6 * results[name].figures["skew_s"] for name in names]
        bars = right.barh(
            [results[name].case.title for name in names], skews, color=[RUN_COLORS[name] for name in names], height=0.55
        )
        right.bar_label(bars, [f"{value:+.1f} µs".replace("-", "−") for value in skews], padding=4)
        right.axvline(0, color="#90a4ae", linewidth=1)
        reach = 1.5 * max(map(abs, skews))
        right.set(xlabel="left arm behind the right one (µs)", xlim=(-reach, 0.5 * reach))
        right.set_title("Skew: where the correlation peaks")
    return address[0]


def ripple(results: Results) -> str:
    """Plot the difference of each flange's speed to that of its reference."""
    with figure(1, 2, 3.2) as (_, axes, address):
        for axis, name in zip(axes[0], ("perturbed", "perturbed_fixed"), strict=True):
            result = results[name]
            speed = errors(result.record).speed_m_s
            for arm, label in enumerate(ARMS):
                axis.plot(result.record.time_s, 1e3 * speed[:, arm], color=ARM_COLORS[arm], label=label, linewidth=1)
            axis.set(xlabel="time (s)", ylabel="speed − reference (mm/s)")
            axis.set_title(f"{capital(result.case.title)}: largest {1e3 * np.abs(speed).max():.2g} mm/s")
            axis.legend(ncols=2, loc="upper right")
    return address[0]


def lag(results: Results) -> str:
    """Plot one period of the sine with and without compensation of the lag of `servoj`."""
    with figure(1, 2, 3.4) as (_, axes, address):
        left, right = axes[0]
        time_s = results["perturbed"].record.time_s
        shown = (time_s >= 4.0) & (time_s <= 6.0)
        _, reference = along_axis(results["perturbed"].record)
        left.plot(
            time_s[shown], 1e3 * reference[shown, 0], color="#263238", linewidth=3.5, alpha=0.35, label="reference"
        )
        for name, label in (("lagging", "not compensated"), ("perturbed", "compensated")):
            result = results[name]
            position, reference = along_axis(result.record)
            text = f"{label}: lag {1e3 * result.figures['lag_s']:.2f} ms"
            left.plot(time_s[shown], 1e3 * position[shown, 0], color=RUN_COLORS[name], label=text)
            behind = 1e3 * (position - reference)[:, 0]
            right.plot(time_s, behind, color=RUN_COLORS[name], label=label)
        left.set(xlabel="time (s)", ylabel="left flange along the axis (mm)")
        left.set_ylim(-115, 190)
        left.set_title("One period")
        left.legend(loc="upper right")
        right.set(xlabel="time (s)", ylabel="behind the reference (mm)")
        right.set_ylim(-13, 17)
        right.set_title("Error along the axis, caused by the lag")
        right.legend(ncols=2, loc="upper right")
    return address[0]


def _distance_m(result: CaseResult) -> float:
    reference = result.record.reference_m
    return 0.0 if reference is None else float(np.linalg.norm(reference[0, 0] - reference[0, 1]))


TASK = DemoTask(
    name="sine",
    title="SineTracking",
    cases=CASES,
    columns=COLUMNS,
    emulated_columns=(SUCCESS, *_ACCURACY),
    figures=figures,
    context=context,
    filmed=CASES[1],
    video="sine_tracking.mp4",
    step_s=0.0006,
    replayed=True,
)
