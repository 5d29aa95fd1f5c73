"""The command `compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import Partial, console
from dual_ur10.files import check_target


def compare(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="A recorded run: its folder or its file.")],
    run_b: Annotated[Path, typer.Argument(metavar="RUN_B", help="Another of the same task.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The report, one HTML file.")] = Path(
        "compare.html"
    ),
    allow_partial: Partial = False,
) -> None:
    """Compare two recorded runs of a task, and write a report of their differences."""
    from dual_ur10.sim2real.analysis.compare import compare as compared
    from dual_ur10.sim2real.analysis.report import check_extra, write_report
    from dual_ur10.sim2real.recording.reader import read_run

    check_target(out)
    check_extra()
    found = compared(*(read_run(path, allow_partial=allow_partial) for path in (run_a, run_b)))
    write_report(out, found, (_name(run_a), _name(run_b)))
    table = Table(header_style="bold")
    for header in ("arm", "flange RMS\n[dim]mm[/]", "max\n[dim]mm[/]", "lag of B\n[dim]ms[/]"):
        table.add_column(header, justify="left" if header == "arm" else "right")
    for header in ("RMS, lag off\n[dim]mm[/]", "max, lag off\n[dim]mm[/]", "equal targets"):
        table.add_column(header, justify="right")
    for arm, each in zip(("left", "right"), found.arms, strict=True):
        free = None if each.free is None else each.free.flange_m
        table.add_row(
            arm,
            *(f"{1e3 * value:.4f}" for value in (each.found.flange_m.rms, each.found.flange_m.most)),
            "—" if each.lag.reason else f"{1e3 * each.lag.value:.3f}",
            *(["—", "—"] if free is None else [f"{1e3 * value:.4f}" for value in (free.rms, free.most)]),
            f"{each.sent.equal} of {each.sent.compared}",
        )
    console.print(table)
    for arm, each in zip(("left", "right"), found.arms, strict=True):
        if each.lag.reason:
            console.print(f"[yellow]note:[/] {arm}: no lag: {escape(each.lag.reason)}", highlight=False, soft_wrap=True)
    for note in found.notes:
        console.print(f"[yellow]note:[/] {escape(note)}", highlight=False, soft_wrap=True)
    console.print(f"report  {out}", soft_wrap=True, highlight=False, markup=False)


def _name(path: Path) -> str:
    """Return the name of a run: that of its folder."""
    resolved = path.resolve()
    return resolved.parent.name if resolved.is_file() else resolved.name
