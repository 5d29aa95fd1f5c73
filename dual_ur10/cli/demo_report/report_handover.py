"""What the demonstration's report says of Handover."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from statistics import median
from typing import TYPE_CHECKING

from dual_ur10.cli.demo_report import figures_handover
from dual_ur10.sim2real.analysis.page import image, lead, number, pictures, table, text, video

if TYPE_CHECKING:
    from dual_ur10.cli.demo_report.film import Film
    from dual_ur10.cli.demo_report.runs_handover import HandoverResult

HANDOVER_HEADERS = (
    ("gives", ""),
    ("success", ""),
    ("time", "s"),
    ("placing error", "mm"),
    ("placing angle", "°"),
    ("slip", "mm"),
    ("joint speed", "% of limit"),
)
"""Columns of the table of Handover, with their units."""


def figures_of_episode(result: HandoverResult) -> list[str]:
    """An episode's cells of the table, in the order of `HANDOVER_HEADERS`."""
    return [
        result.giver,
        "yes" if result.success else "no",
        f"{result.time_s:.2f}",
        *map(number, (result.place_mm, result.place_deg, result.slip_max_mm)),
        f"{100 * result.speed_share:.0f}",
    ]


def by_run(results: Sequence[HandoverResult]) -> list[list[HandoverResult]]:
    """The episodes of each run, in the order of the runs."""
    return [[each for each in results if each.run.name == name] for name in dict.fromkeys(r.run.name for r in results)]


def handover_section(results: Sequence[HandoverResult], film: Film | None) -> str:
    """The section, as HTML."""
    rows = [
        (f"{each.run.title}, seed {each.seed}", "weak" if each.run.nominal else "", figures_of_episode(each))
        for each in results
    ]
    cut = [f"Seed {each.seed}, {each.run.title}: {each.ended_by}." for each in results if each.ended_by]
    return "\n".join(
        (
            "<h2 id='handover'>Handover: a block from hand to hand</h2>",
            lead(
                "DualUR10/Handover-v0: one arm picks a block up and hands it to the other, in the air; that one lays "
                "it on its target. Block, target and the arm that gives are drawn for each episode. "
                + _summary(results)
            ),
            video(film),
            "<h3>Stages over time</h3>",
            image(figures_handover.stages_over_time(results), "Stages of all episodes over time"),
            "<h3>Episodes</h3>",
            table("handover", HANDOVER_HEADERS, rows),
            text(
                "Time: until the block has lain on its target for half a second, or the episode was over. Placing "
                "error: between the middles of block and target; angle: between their long axes. Slip: of the block "
                "in a gripper from its first touch on, so that its way between the closing fingers counts. "
                "How well a pose is known: standard deviation along and about each axis. "
                "In grey rows the plant and the block's pose are known exactly: an "
                f"artefact. {escape(' '.join(cut))} Rates over hundreds of episodes: "
                "<code>python benchmarks/handover.py</code>."
            ),
            _key_frames(film),
            "<h3>One episode</h3>",
            image(figures_handover.one_handover(results[-1]), "Height, distance to the target and slip over time"),
        )
    )


def _summary(results: Sequence[HandoverResult]) -> str:
    parts = []
    for episodes in by_run(results):
        times = [each.time_s for each in episodes if each.success]
        took = f", median {median(times):.1f} s" if times else ""
        parts.append(f"{escape(episodes[0].run.title)}: {len(times)} of {len(episodes)} succeed{took}")
    summary = "; ".join(parts)
    return f"{summary[:1].upper()}{summary[1:]}."


def _key_frames(film: Film | None) -> str:
    return "" if film is None or not film.frames else "<h3>Key frames</h3>" + pictures(film.frames)
