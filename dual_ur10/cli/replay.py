"""The command `replay`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from dual_ur10.cli.options import (
    RUNS,
    STOP_COMMANDED,
    CellFileName,
    NoRecord,
    OneArm,
    Partial,
    PowerOn,
    Record,
    RunPath,
    console,
    errors,
    keywords_of,
    late_text,
    power_on,
    progress_of,
    record_in,
)
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED

DIFFERENT = 1
"""Exit code when a replay differs from the recording."""


def replay(
    run: RunPath,
    cell: CellFileName = None,
    episode: Annotated[int, typer.Option("--episode", "-e", min=0, help="Number of the episode in the run.")] = 0,
    arm: OneArm = None,
    power: PowerOn = False,
    allow_partial: Partial = False,
    record: Record = RUNS,
    no_record: NoRecord = False,
) -> None:
    """Replay the actions of a recorded episode through the same adapter and gate.

    A simulated run that is simulated again must be the same in every bit, else the exit code is 1. On arms, the
    targets that the gate releases are compared.
    """
    from dual_ur10.sim2real.analysis.replay import replay as play
    from dual_ur10.sim2real.analysis.replay import source_of
    from dual_ur10.sim2real.recording.reader import read_run

    keywords = keywords_of(None, perturbed=False, cell=cell, arm=arm)
    keywords.pop("cell", None)
    recorded = read_run(run, allow_partial=allow_partial)
    if not no_record:
        record_in(keywords, record, source_of(run, episode))
    if power:
        power_on(cell)
    try:
        with progress_of(
            console, cell is not None, TextColumn("playing"), BarColumn(), MofNCompleteColumn()
        ) as progress:
            bar = progress.add_task("playing")
            found = play(
                recorded,
                cell,
                episode=episode,
                keywords=keywords,
                on_step=lambda done, total: progress.update(bar, completed=done, total=total),
            )
    except KeyboardInterrupt:
        if cell is None:
            raise
        errors.print(f"interrupted; {STOP_COMMANDED}", highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    ticks = found.targets_rad.shape[0] * found.targets_rad.shape[1]
    ended = f", ended by {escape(found.ended_by)}" if found.ended_by else ""
    console.print(
        f"{found.steps} of {found.recorded} steps, {found.equal_targets} of {ticks} ticks with the recorded targets "
        f"in every bit{ended}{late_text(found.late_actions)}",
        highlight=False,
        soft_wrap=True,
    )
    if found.is_exact:
        console.print("the replay is as recorded", style="green", highlight=False)
        return
    errors.print(f"[bold red]different:[/] [red]{escape(found.difference)}[/]", soft_wrap=True, highlight=False)
    raise typer.Exit(DIFFERENT)
