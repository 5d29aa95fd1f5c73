"""The command `fit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import Partial, RunPath, console
from dual_ur10.files import check_target

if TYPE_CHECKING:
    from dual_ur10.sim2real.analysis.fit import Estimate


def fit(
    run: RunPath,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE", help="Write lookahead and latency of both arms into this cell file."),
    ] = None,
    episode: Annotated[
        int | None, typer.Option("--episode", "-e", min=0, help="Number of the episode; by default the longest.")
    ] = None,
    allow_partial: Partial = False,
) -> None:
    """Estimate lookahead and latency of each arm from a recorded run in which both arms move."""
    from dual_ur10.sim2real.analysis.cell_update import write_back
    from dual_ur10.sim2real.analysis.fit import fit as fitted
    from dual_ur10.sim2real.analysis.fit import remark
    from dual_ur10.sim2real.recording.reader import read_run

    if write is not None:
        check_target(write)
    recorded = read_run(run, allow_partial=allow_partial)
    found = fitted(recorded, episode)
    table = Table(header_style="bold")
    table.add_column("")
    for header in ("lookahead\n[dim]ms[/]", "latency\n[dim]ms[/]", "unexplained RMS\n[dim]µrad[/]"):
        table.add_column(header, justify="right")
    reasons = []
    for arm, each in zip(("left", "right"), found, strict=True):
        for what, estimate in (("controller alone", each.law), ("controller and arm", each.arm)):
            table.add_row(f"{arm}, {what}", *_figures(estimate))
            reason = estimate.reason or remark(estimate, recorded.header.tick_s)
            if reason:
                reasons.append(f"{arm}, {what}: {reason}")
    console.print(table)
    for reason in reasons:
        console.print(f"[yellow]note:[/] {escape(reason)}", highlight=False, soft_wrap=True)
    if write is not None:
        kept = write_back(write, recorded.header, found)
        console.print(f"wrote {write}; as it was: {kept}", soft_wrap=True, highlight=False, markup=False)


def _figures(estimate: Estimate) -> list[str]:
    if estimate.reason:
        return ["—"] * 3
    return [
        f"{1e3 * estimate.lookahead_s:.3f} ± {1e3 * estimate.lookahead_sigma_s:.3f}",
        f"{1e3 * estimate.latency_s:.3f} ± {1e3 * estimate.latency_sigma_s:.3f}",
        f"{1e6 * estimate.rms_rad:.1f}",
    ]
