"""Plots of a comparison, as `data:` URIs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.sim2real.analysis.compare import Comparison, Pair
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, SOFT, capital, figure, legend_right
from dual_ur10.sim2real.analysis.series import lengths
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

_JOINT_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#555555")
_AXIS_COLORS: Final = ("#D55E00", "#009E73", "#0072B2")
_FREE: Final = "#009E73"
_MOST_POINTS: Final = 3000  # of a line


def flange_error(found: Comparison) -> str:
    """Plot the distance between the flanges of both runs over time, with and without the lag."""
    pair = _shown(found)
    with figure(2, 1, 5.4, sharex=True) as (_, axes, address):
        for arm, axis in enumerate(axes[:, 0]):
            away = 1e3 * lengths(pair.flange_m[0, :, arm] - pair.flange_m[1, :, arm])
            free = 1e3 * lengths(pair.flange_m[0, :, arm] - pair.free_m[:, arm])
            axis.plot(pair.time_s, away, color=ARM_COLORS[arm], label="as it is", linewidth=1)
            if found.arms[arm].free is not None:
                axis.plot(pair.time_s, free, color=_FREE, label="lag taken off", linewidth=1)
            axis.set_ylabel("flange A to flange B (mm)")
            axis.set_title(f"{capital(ARMS[arm])} arm")
            axis.legend(ncols=2, loc="upper right")
            _make_room([axis])
        axes[-1, 0].set_xlabel("time of the task (s)")
    return address[0]


def flange_vector(found: Comparison) -> str:
    """Plot the vector from B's flange to A's along the axes of the cell, lag taken off."""
    pair = _shown(found)
    return _lines(pair, 1e3 * (pair.flange_m[0] - pair.free_m), "xyz", _AXIS_COLORS, "mm")


def joint_errors(found: Comparison) -> str:
    """Plot the differences of the joints, lag taken off."""
    pair = _shown(found)
    names = [name.removesuffix("_joint").replace("_", " ") for name in JOINTS]
    return _lines(pair, 1e3 * (pair.q_rad[0] - pair.free_rad), names, _JOINT_COLORS, "mrad")


def _lines(pair: Pair, values: Array, names: Sequence[str], colors: Sequence[str], unit: str) -> str:
    """Plot (k, 2, d) differences, an axis per arm and a line per name."""
    with figure(1, 2, 3.4, sharey=True) as (_, axes, address):
        for arm, axis in enumerate(axes[0]):
            for k, (name, color) in enumerate(zip(names, colors, strict=True)):
                axis.plot(pair.time_s, values[:, arm, k], color=color, label=name, linewidth=1)
            axis.set_xlabel("time of the task (s)")
            axis.set_title(f"{capital(ARMS[arm])} arm")
        axes[0, 0].set_ylabel(f"A minus B, lag taken off ({unit})")
        legend_right(axes[0, 1])
    return address[0]


def paths(found: Comparison) -> str:
    """Plot the distance of each flange of both runs from its start."""
    pair = _shown(found)
    with figure(1, 2, 3.2, sharey=True) as (_, axes, address):
        for arm, axis in enumerate(axes[0]):
            for run, (name, color, width) in enumerate((("A", SOFT, 3.5), ("B", ARM_COLORS[arm], 1.2))):
                moved = pair.flange_m[run, :, arm] - pair.flange_m[run, :1, arm]
                axis.plot(pair.time_s, 1e3 * lengths(moved), color=color, label=f"run {name}", linewidth=width)
            axis.set_xlabel("time of the task (s)")
            axis.set_title(f"{capital(ARMS[arm])} arm")
            axis.legend(ncols=2, loc="upper right")
        axes[0, 0].set_ylabel("away from the start (mm)")
        _make_room(axes[0])
    return address[0]


def skew(found: Comparison) -> str:
    """Plot the histogram of the time between the sendings of the same target to both arms."""
    with figure(1, 2, 3.0) as (_, axes, address):
        for axis, name, timing in zip(axes[0], "AB", found.timing, strict=True):
            values = 1e3 * timing.skews_s
            if values.size:
                axis.hist(values, bins=61, color=ARM_COLORS[0], log=bool(np.ptp(values) > 0))
            else:
                axis.text(0.5, 0.5, timing.skew_reason, ha="center", color=INK, transform=axis.transAxes)
            axis.set(xlabel="left arm sent after the right one (ms)", ylabel="targets")
            axis.set_title(f"Run {name}")
    return address[0]


def _make_room(axes: Sequence[Any]) -> None:
    """Show all lines of axes with a common scale of lengths, below their legend."""
    most = max(float(np.nanmax(line.get_ydata())) for axis in axes for line in axis.get_lines())
    axes[0].set_ylim(0, 1.25 * max(most, 1e-9))
    for axis in axes:
        axis.margins(x=0.01)


def _shown(found: Comparison) -> Pair:
    """Return the first episode, thinned to the points that can be seen."""
    pair = found.pairs[0]
    every = max(1, -(-len(pair.time_s) // _MOST_POINTS))
    return Pair(
        pair.number,
        pair.time_s[::every],
        pair.q_rad[:, ::every],
        pair.free_rad[::every],
        pair.flange_m[:, ::every],
        pair.free_m[::every],
    )
