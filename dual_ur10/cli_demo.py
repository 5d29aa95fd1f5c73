"""The command `demo`: the three tasks in a report and videos."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dual_ur10.cli_options import console

_LEFT_OUT = ("lateral", "bar RMS", "least load")  # of SyncCarry: a terminal is narrower than a page


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for report.html and the videos.")] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter episodes, and shorter videos.")] = False,
) -> None:
    """Run the scripted policies of the three tasks, and write a report and a video of each."""
    from dual_ur10.demo import run_demo

    columns = (TextColumn("{task.description:40}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)

        def show(text: str, done: float, total: float) -> None:
            progress.update(task, description=text, completed=done, total=total)

        found = run_demo(out, quick=quick, progress=show)
    from dual_ur10.report_carry import CARRY_HEADERS, figures_of_run
    from dual_ur10.report_handover import HANDOVER_HEADERS, figures_of_episode
    from dual_ur10.report_sine import HEADERS, figures_of

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
    console.print(
        "Dim rows are those of an exact model: an artefact. No real arm was measured; L is 0 unless a row says so.",
        style="dim",
    )
    console.print(f"report  {out / 'report.html'}", soft_wrap=True, highlight=False)
    for film in found.films.values():
        console.print(f"video   {film.path}", soft_wrap=True, highlight=False)
    if found.missing:
        console.print(f"[yellow]no video:[/] {escape(found.missing)}", soft_wrap=True, highlight=False)


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
