"""The figures of SyncCarry in the demonstration's report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, SOFT, capital, figure

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.runs_carry import CarryResult

COLORS = {"rigid": "#009E73", "friction": "#0072B2", "mild": "#D55E00"}
_AXES = (("x", "#D55E00"), ("y", "#009E73"), ("z", "#0072B2"))


def carry_path(result: CarryResult) -> str:
    """Where the bar is, and how far from its reference, over time."""
    with figure(1, 2, 3.2, width_ratios=(1.15, 1)) as (_, axes, address):
        left, right = axes[0]
        position = result.trace["object_m"]
        for k, (name, color) in enumerate(_AXES):
            left.plot(result.time_s, 1e3 * position[:, k], color=color, label=name)
        left.set(xlabel="time (s)", ylabel="middle of the bar (mm)")
        left.set_title("The way of the bar")
        error = 1e3 * result.trace["object_error_m"]
        begun = result.trace["clock_s"] > 0.0
        right.plot(result.time_s[begun], error[begun], color=INK)
        right.set(xlabel="time (s)", ylabel="distance to the reference (mm)", ylim=(0, 1.25 * error[begun].max()))
        right.set_title(f"{capital(result.run.title)}: at most {error[begun].max():.2g} mm")
        _headroom(left)
        left.legend(ncols=3, loc="upper right")
        for axis in (left, right):
            _mark_begin(axis, result)
            axis.set_xlim(0, result.time_s[-1])
    return address[0]


def relative_pose(results: Sequence[CarryResult]) -> str:
    """Error of the right flange's pose in the left one's frame, in all runs, on logarithmic scales."""
    with figure(1, 2, 3.6) as (_, axes, address):
        for axis, name, scale, unit, title in (
            (axes[0, 0], "relative_error_m", 1e3, "mm", "Position of one flange in the other's frame"),
            (axes[0, 1], "relative_error_rad", np.degrees(1.0), "°", "Orientation of one flange in the other's frame"),
        ):
            for result in results:
                clock = result.trace["clock_s"]
                shown = clock > 0.0
                error = np.maximum(scale * result.trace[name][shown], 1e-6)
                axis.semilogy(clock[shown], error, color=COLORS[result.run.name], label=result.run.title)
            axis.set(xlabel="time on the path (s)", ylabel=f"error ({unit}, log scale)")
            axis.set_title(title)
            _headroom(axis, 30.0)
            axis.legend(ncols=2, loc="upper left", columnspacing=1.0)
            axis.margins(x=0.01)
    return address[0]


def inner_forces(results: Sequence[CarryResult]) -> str:
    """What the arms do against each other, along the bar and across it."""
    with figure(1, 2, 3.4) as (_, axes, address):
        for axis, name, title in (
            (axes[0, 0], "squeeze_n", "Along the bar: positive if they press towards each other"),
            (axes[0, 1], "lateral_n", "Across the bar"),
        ):
            for result in results:
                clock = result.trace["clock_s"]
                shown = clock > 0.0
                axis.plot(
                    clock[shown],
                    result.trace[name][shown],
                    color=COLORS[result.run.name],
                    label=result.run.title,
                    linewidth=1,
                )
            axis.axhline(0, color=SOFT, linewidth=0.8)
            axis.set(xlabel="time on the path (s)", ylabel="force (N)")
            axis.set_title(title)
            _headroom(axis)
            axis.legend(ncols=2, loc="upper left", columnspacing=1.0)
            axis.margins(x=0.01)
    return address[0]


def load_and_slip(results: Sequence[CarryResult]) -> str:
    """How the arms share the load of the last run, and how far the bar slips in the grippers."""
    with figure(1, 2, 3.4) as (_, axes, address):
        left, right = axes[0]
        result = results[-1]
        clock = result.trace["clock_s"]
        shown = clock > 0.0
        for arm, label in enumerate(ARMS):
            share = 100 * result.trace["load_share"][shown, arm]
            left.plot(clock[shown], share, color=ARM_COLORS[arm], label=label, linewidth=1)
        left.axhline(50, color=SOFT, linewidth=0.8)
        left.set(xlabel="time on the path (s)", ylabel="share of the load (%)", ylim=(0, 110))
        left.set_title(f"{capital(result.run.title)}: who carries")
        left.legend(ncols=2, loc="upper right")
        for result in results:
            if not result.run.rigid:
                clock = result.trace["clock_s"]
                shown = clock > 0.0
                slip = 1e3 * result.trace["slip_m"][shown].max(axis=1)
                right.plot(clock[shown], slip, color=COLORS[result.run.name], label=result.run.title)
        right.set(xlabel="time on the path (s)", ylabel="slip in the worse gripper (mm)")
        right.set_ylim(bottom=0)
        right.set_title("Slip since the path began")
        _headroom(right)
        right.legend(loc="upper left")
        for axis in (left, right):
            axis.margins(x=0.01)
    return address[0]


def _headroom(axis: Any, factor: float = 1.3) -> None:
    """Room for a legend above the curves."""
    low, high = axis.get_ylim()
    axis.set_ylim(low, high * factor if axis.get_yscale() == "log" else low + (high - low) * factor)


def _mark_begin(axis: Any, result: CarryResult) -> None:
    """A line where the path begins."""
    begin = float(result.time_s[np.argmax(result.trace["clock_s"] > 0.0)])
    axis.axvline(begin, color=SOFT, linestyle="--", linewidth=1)
