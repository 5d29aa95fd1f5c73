"""The command `demo`: the three tasks in a report and videos."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dual_ur10.cli.options import console

# A terminal is narrower than a page.
_LEFT_OUT = ("lateral", "bar RMS", "least load")  # of SyncCarry
_LEFT_OUT_EMULATED = ("path max, lag off", "targets apart", "load")


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for report.html and the videos.")] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter episodes, and shorter videos.")] = False,
) -> None:
    """Run the scripted policies of the three tasks, and write a report and a video of each.

    It ends on two emulated controllers, through ur_rtde, in real time: a machine that does nothing else then shows them
    best.
    """
    from dual_ur10.cli.demo_report.demo import run_demo

    columns = (TextColumn("{task.description:40}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)

        def show(text: str, done: float, total: float) -> None:
            progress.update(task, description=text, completed=done, total=total)

        found = run_demo(out, quick=quick, progress=show)
    from dual_ur10.cli.demo_report.report_carry import CARRY_HEADERS, figures_of_run
    from dual_ur10.cli.demo_report.report_emulated import (
        ON_FAILURE,
        TASK_HEADERS,
        TIMING_HEADERS,
        figures_of_task,
        figures_of_timing,
        remarks,
    )
    from dual_ur10.cli.demo_report.report_handover import HANDOVER_HEADERS, figures_of_episode
    from dual_ur10.cli.demo_report.report_sine import HEADERS, figures_of
    from dual_ur10.cli.demo_report.runs_emulated import EmulatedFailure, EmulatedResult

    _show(
        "SineTracking, worse arm of",
        HEADERS,
        [(each.run.title, "nominal" in each.run.title, figures_of(each)) for each in found.sine],
    )
    shown = [k for k, (name, _) in enumerate(CARRY_HEADERS) if name not in _LEFT_OUT]
    _show(
        "SyncCarry",
        [CARRY_HEADERS[k] for k in shown],
        [(each.run.title, each.run.nominal, [figures_of_run(each)[k] for k in shown]) for each in found.carry],
    )
    _show(
        "Handover",
        HANDOVER_HEADERS,
        [
            (f"{each.run.title}, seed {each.seed}", each.run.nominal, figures_of_episode(each))
            for each in found.handover
        ],
    )
    beside = [each for each in found.emulated if isinstance(each, EmulatedResult)]
    for each in beside:
        name = each.run.name
        sides = (("simulated", each.simulated), ("emulated", each.emulated))
        _show(
            f"{each.run.title} on emulated controllers",
            TASK_HEADERS[name],
            [(title, False, figures_of_task(name, side)) for title, side in sides],
        )
    if beside:
        shown = [k for k, (name, _) in enumerate(TIMING_HEADERS) if name not in _LEFT_OUT_EMULATED]
        _show(
            "Emulated, simulated",
            [TIMING_HEADERS[k] for k in shown],
            [(each.run.title, False, [figures_of_timing(each)[k] for k in shown]) for each in beside],
        )
    console.print(
        "Dim rows are those of an exact model: an artefact. No real arm was measured, and emulated is not real; L is 0 "
        "unless a row says so.",
        style="dim",
    )
    console.print(f"report  {out / 'report.html'}", soft_wrap=True, highlight=False)
    for film in found.films.values():
        console.print(f"video   {film.path}", soft_wrap=True, highlight=False)
    if found.missing:
        console.print(f"[yellow]no video:[/] {escape(found.missing)}", soft_wrap=True, highlight=False)
    failures = [each for each in found.emulated if isinstance(each, EmulatedFailure)]
    warnings = [f"not on emulated controllers: {each.run.title}: {each.reason}" for each in failures]
    for warning in (*warnings, *(each for result in beside for each in remarks(result))):
        console.print(f"[yellow]{escape(warning)}[/]", soft_wrap=True, highlight=False)
    if failures:
        console.print(ON_FAILURE, soft_wrap=True, highlight=False)


def _show(title: str, headers: Sequence[tuple[str, str]], rows: Iterable[tuple[str, bool, Sequence[str]]]) -> None:
    """Print a table; rows are a title, whether it is dim, and cells."""
    table = Table(box=None, header_style="bold", padding=(0, 0, 0, 1), pad_edge=False)
    table.add_column(f"\n\n{title}", min_width=18)
    for name, unit in headers:
        table.add_column(name.replace(" ", "\n") + f"\n[dim]{unit}[/]", justify="right", no_wrap=True)
    for name, dim, cells in rows:
        table.add_row(name, *cells, style="dim" if dim else "")
    console.print(table)
    console.print()
