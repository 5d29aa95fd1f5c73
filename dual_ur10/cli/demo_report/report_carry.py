"""What the demonstration's report says of SyncCarry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dual_ur10.assets.props import BAR_LENGTH_M, BAR_MASS_KG
from dual_ur10.cli.demo_report import figures_carry
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.sim2real.analysis.page import image, lead, number, pictures, table, text, video

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.film import Film
    from dual_ur10.cli.demo_report.runs_carry import CarryResult

CARRY_HEADERS = (
    ("relative position", "mm"),
    ("relative angle", "°"),
    ("squeeze", "N"),
    ("lateral", "N"),
    ("slip", "mm"),
    ("bar max", "mm"),
    ("bar RMS", "mm"),
    ("least load", "%"),
    ("joint speed", "% of limit"),
    ("success", ""),
)
"""Columns of the table of SyncCarry, with their units."""


def figures_of_run(result: CarryResult) -> list[str]:
    """A result's cells of the table, in the order of `CARRY_HEADERS`."""
    found = result.figures
    values = (
        found.relative_max_mm,
        found.relative_max_deg,
        found.squeeze_max_n,
        found.lateral_max_n,
        found.slip_max_mm,
        found.bar_max_mm,
        found.bar_rms_mm,
        100 * found.least_load_share,
    )
    return [*map(number, values), f"{100 * found.speed_share:.0f}", "yes" if result.success else "no"]


def carry_section(results: Sequence[CarryResult], film: Film | None) -> str:
    """The section, as HTML."""
    shown = results[-1]
    ends_mm = 1e3 * shown.trace["relative_error_m"][shown.trace["clock_s"] > 0.0]
    return "\n".join(
        (
            "<h2 id='carry'>SyncCarry: both arms carry one bar</h2>",
            lead(
                f"DualUR10/SyncCarry-v0: a bar of {BAR_LENGTH_M:g} m and {BAR_MASS_KG:g} kg is taken by its ends, "
                f"lifted, moved, turned about three axes and put down, on a path of {CarrySettings().duration_s:g} s. "
                "The controllers are told what each arm carries. Both flanges must keep their distance and angle while "
                "they move on different curves."
            ),
            video(film),
            "<h3>Figures</h3>",
            table(
                "carry",
                CARRY_HEADERS,
                [(each.run.title, "weak" if each.run.nominal else "", figures_of_run(each)) for each in results],
            ),
            text(
                "Largest magnitudes from the begin of the path on, without the noise of measurement. Relative: pose "
                "of the right flange in the left one's frame, against what the bar's length demands. Squeeze and "
                "lateral: half the difference of the forces on both grippers, along the bar and across it. Slip: of a "
                "grip in its gripper since the path began; a bar that is welded cannot slip. Bar: its distance to its "
                "reference. Least load: smallest share that one arm carries while the bar is off the table. Grey rows "
                "are those of an exact model: an artefact."
            ),
            _key_frames(film),
            "<h3>The way of the bar</h3>",
            image(figures_carry.carry_path(shown), "Position of the bar and its error over time"),
            "<h3>Relative pose of the flanges</h3>",
            image(figures_carry.relative_pose(results), "Error of the relative pose over time, all runs"),
            text(
                "With mild randomization each episode has masses, joint friction, bases, servos, grip and bar of its "
                "own, and the bar's pose is measured with an error, so that the hands close a little beside or askew "
                f"of where they should: the error of position is {number(ends_mm[0])} mm when the path begins and "
                f"{number(ends_mm[-1])} mm at the end. The friction grasp of "
                "the nominal plant creeps: MuJoCo's friction is a constraint on velocities, so that hands and "
                "bar, which turn about different axes, drift apart by about dt·v² per second. The physics step of "
                "this grasp is therefore 1 ms, and the longer path turns more slowly."
            ),
            "<h3>Inner forces</h3>",
            image(figures_carry.inner_forces(results), "Squeeze and lateral force over time, all runs"),
            "<h3>Load share and slip</h3>",
            image(figures_carry.load_and_slip(results), "Share of the load of both arms, and slip, over time"),
            text(
                "Load: the upward forces of both grippers on the bar. Near the table it bears a part, and shares of "
                "small forces mean little."
            ),
        )
    )


def _key_frames(film: Film | None) -> str:
    return "" if film is None or not film.frames else "<h3>Key frames</h3>" + pictures(film.frames)
