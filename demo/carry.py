"""SyncCarry in the demonstration: cases, figures, plots and video."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from demo.case import JOINT_SPEED, SUCCESS, Case, CaseResult, DemoTask, Key, figure_column
from dual_ur10.assets.props import BAR_LENGTH_M, BAR_MASS_KG
from dual_ur10.envs.tasks.sync_carry.path import MOVES
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.evaluation.film import Take
from dual_ur10.policies.evaluation.rollout import Trace
from dual_ur10.sim2real.analysis.plot_style import ARM_COLORS, INK, SOFT, capital, figure
from ur_core.kinematics.ur10 import ARMS

CARRY_ID = "DualUR10/SyncCarry-v0"

_OFF_TABLE_M = 0.05  # above its first height: a carried bar

CASES = (
    Case("rigid", "rigid grasp, nominal", CARRY_ID, {"grasp": "rigid"}),
    Case("friction", "friction grasp, nominal", CARRY_ID),
    Case("mild", "friction grasp, mild randomization", CARRY_ID, {"randomization": "mild"}),
)

_POSITION, _ANGLE = (
    figure_column("relative position", "mm", "relative_max_mm"),
    figure_column("relative angle", "°", "relative_max_deg"),
)
_FORCE, _SLIP, _BAR_RMS = (
    figure_column("internal force", "N", "squeeze_max_n"),
    figure_column("slip", "mm", "slip_max_mm"),
    figure_column("bar RMS", "mm", "bar_rms_mm"),
)

COLUMNS = (
    _POSITION,
    _ANGLE,
    _FORCE,
    figure_column("lateral", "N", "lateral_max_n"),
    _SLIP,
    figure_column("bar max", "mm", "bar_max_mm"),
    _BAR_RMS,
    figure_column("least load", "%", "least_load_share", 100),
    JOINT_SPEED,
    SUCCESS,
)


def figures(result: CaseResult) -> dict[str, float]:
    """Return figures of an episode from the beginning of the path on; see `figures_of`."""
    return figures_of(result.trace, rigid=result.case.keywords.get("grasp") == "rigid")


def figures_of(trace: Trace, *, rigid: bool) -> dict[str, float]:
    """Return figures of an episode from the beginning of the path on.

    `relative_max_mm`, `relative_max_deg`: largest error of the right flange's pose in the left one's frame.
    `squeeze_max_n`, `lateral_max_n`: largest internal force along the bar and across it. `slip_max_mm`: largest slip of
    a grip in its gripper; NaN for a rigid grasp. `bar_max_mm`, `bar_rms_mm`, `bar_max_deg`: error of the bar's pose.
    `least_load_share`: smallest ratio of the load that one arm carries while the bar is off the table.

    Args:
        trace: `info` over time.
        rigid: Whether the bar is welded to the grippers, so that it cannot slip.

    Raises:
        DualUR10Error: The episode ended before its path began.
    """
    begun = trace["clock_s"] > 0.0
    if not begun.any():
        raise DualUR10Error("the episode ended before its path began: it has no figures")

    def peak(name: str) -> float:
        return float(np.abs(trace[name][begun]).max())

    height = trace["object_m"][:, 2]
    carried = begun & (height > height[0] + _OFF_TABLE_M)
    return {
        "relative_max_mm": 1e3 * peak("relative_error_m"),
        "relative_max_deg": math.degrees(peak("relative_error_rad")),
        "squeeze_max_n": peak("squeeze_n"),
        "lateral_max_n": peak("lateral_n"),
        "slip_max_mm": math.nan if rigid else 1e3 * peak("slip_m"),
        "bar_max_mm": 1e3 * peak("object_error_m"),
        "bar_rms_mm": 1e3 * float(np.sqrt((trace["object_error_m"][begun] ** 2).mean())),
        "bar_max_deg": math.degrees(peak("object_error_rad")),
        "least_load_share": float(trace["load_share"][carried].min()) if carried.any() else math.nan,
    }


def context(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Return plots and values for the template."""
    shown = results[-1]
    error_mm = 1e3 * shown.trace["relative_error_m"][shown.trace["clock_s"] > 0.0]
    return {
        "bar": f"{BAR_LENGTH_M:g} m and {BAR_MASS_KG:g} kg",
        "duration_s": CarrySettings().duration_s,
        "first_mm": error_mm[0],
        "last_mm": error_mm[-1],
        "path": carry_path(shown),
        "relative_pose": relative_pose(shown),
        "inner_forces": inner_forces(shown),
        "load_and_slip": load_and_slip(shown),
    }


# Motions of the bar in the order of `MOVES`.
_MOVED = (
    "moved forward",
    "moved sideways",
    "lifted",
    "tilted",
    "rotated about its length",
    "rotated about the vertical",
)


def instants(duration_s: float) -> list[tuple[float, str]]:
    """Return time on the path and title of each key frame: the end of the first motion of each kind."""
    moves = MOVES[duration_s]
    ends = [(min(end for _, end, each, _ in moves if each == number), title) for number, title in enumerate(_MOVED)]
    return [(-math.inf, "the bar on the table"), *sorted(ends), (duration_s, "laid down")]


def keys(shown: Take) -> list[Key]:
    """Return the key frames: the bar on the table, and the end of its first motion of each kind."""
    clocks = [float(info.get("clock_s", -math.inf)) for info in shown.infos]
    found = []
    for due_s, title in instants(CarrySettings().duration_s):
        number = next((k for k, clock_s in enumerate(clocks) if clock_s >= due_s - 1e-9), None)
        if number is None:
            break  # the episode ended before
        position = ", ".join(f"{value:.2f}" for value in shown.infos[number]["object_m"]).replace("-", "−")
        found.append((number, title, f"t = {number * shown.period_s:.1f} s, bar at {position}\u00a0m"))
    return found


_AXES = (("x", "#D55E00"), ("y", "#009E73"), ("z", "#0072B2"))


def carry_path(result: CaseResult) -> str:
    """Plot position of the bar, and its distance to its reference, over time."""
    with figure(1, 2, 3.2, width_ratios=(1.15, 1)) as (_, axes, address):
        left, right = axes[0]
        position = result.trace["object_m"]
        for k, (name, color) in enumerate(_AXES):
            left.plot(result.record.time_s, 1e3 * position[:, k], color=color, label=name)
        left.set(xlabel="time (s)", ylabel="middle of the bar (mm)")
        left.set_title("Path of the bar")
        error = 1e3 * result.trace["object_error_m"]
        begun = result.trace["clock_s"] > 0.0
        right.plot(result.record.time_s[begun], error[begun], color=INK)
        right.set(xlabel="time (s)", ylabel="distance to the reference (mm)", ylim=(0, 1.25 * error[begun].max()))
        right.set_title(f"{capital(result.case.title)}: at most {error[begun].max():.2g} mm")
        _headroom(left)
        left.legend(ncols=3, loc="upper right")
        for axis in (left, right):
            _mark_begin(axis, result)
            axis.set_xlim(0, result.record.time_s[-1])
    return address[0]


def relative_pose(result: CaseResult) -> str:
    """Plot the error of the right flange's pose in the left one's frame."""
    return _over_path(
        result,
        (
            ("relative_error_m", 1e3, "error (mm)", "Position of one flange in the other's frame"),
            ("relative_error_rad", np.degrees(1.0), "error (°)", "Orientation of one flange in the other's frame"),
        ),
    )


def inner_forces(result: CaseResult) -> str:
    """Plot the internal forces along the bar and across it."""
    return _over_path(
        result,
        (
            ("squeeze_n", 1.0, "force (N)", "Along the bar: positive if they press towards each other"),
            ("lateral_n", 1.0, "force (N)", "Across the bar"),
        ),
    )


def load_and_slip(result: CaseResult) -> str:
    """Plot the load ratio of both arms, and the slip of the bar in both grippers."""
    return _over_path(
        result,
        (
            ("load_share", 100.0, "load (%)", "Load of each arm"),
            ("slip_m", 1e3, "slip (mm)", "Slip in each gripper since the path began"),
        ),
    )


def _over_path(result: CaseResult, plots: Sequence[tuple[str, float, str, str]]) -> str:
    """Plot values over the time on the path: name in `info`, scale, axis and title of each."""
    clock = result.trace["clock_s"]
    shown = clock > 0.0
    with figure(1, len(plots), 3.2) as (_, axes, address):
        for axis, (name, scale, label, title) in zip(axes[0], plots, strict=True):
            values = scale * result.trace[name][shown]
            both = values.ndim == 2
            for arm in range(2) if both else ():
                axis.plot(clock[shown], values[:, arm], color=ARM_COLORS[arm], label=ARMS[arm], linewidth=1)
            if both:
                axis.legend(ncols=2, loc="upper right")
            else:
                axis.plot(clock[shown], values, color=INK, linewidth=1)
            axis.axhline(0.0, color=SOFT, linewidth=0.8)
            axis.set(xlabel="time on the path (s)", ylabel=label)
            axis.set_title(title)
            _headroom(axis)
            axis.margins(x=0.01)
    return address[0]


def _headroom(axis: Any) -> None:
    """Make room for a legend above the curves."""
    low, high = axis.get_ylim()
    axis.set_ylim(low, low + (high - low) * 1.3)


def _mark_begin(axis: Any, result: CaseResult) -> None:
    """Mark the beginning of the path."""
    begin = float(result.record.time_s[np.argmax(result.trace["clock_s"] > 0.0)])
    axis.axvline(begin, color=SOFT, linestyle="--", linewidth=1)


TASK = DemoTask(
    name="carry",
    title="SyncCarry",
    cases=CASES,
    columns=COLUMNS,
    emulated_columns=(SUCCESS, _POSITION, _ANGLE, _FORCE, _SLIP, _BAR_RMS),
    figures=figures,
    context=context,
    filmed=CASES[-1],
    keys=keys,
    video="sync_carry.mp4",
    step_s=0.004,
    steps=900,
    page_only=("lateral", "bar RMS", "least load"),
)
