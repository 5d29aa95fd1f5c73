"""`python -m demo`: the demonstration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dual_ur10.cli import options
from dual_ur10.cli.main import one_line_errors
from dual_ur10.errors import MissingExtraError
from ur_core.processes.interrupts import begin_program

if TYPE_CHECKING:
    from dual_ur10.sim2real.analysis.page import PageTable


class _Command(typer.core.TyperCommand):
    """Command whose named errors end in one line."""

    def invoke(self, ctx: Any) -> Any:
        with one_line_errors():
            return super().invoke(ctx)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(cls=_Command)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for report.html and the videos.")] = Path("out"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter episodes, and shorter videos.")] = False,
) -> None:
    """Run scripted and learned policies of the three tasks, and write a report that begins with a video of each.

    The last runs use two emulated controllers, through ur_rtde, in real time: leave the machine alone meanwhile.
    """
    _check_extras()
    from demo import emulated
    from demo.report import TASKS
    from demo.run import run_demo
    from dual_ur10.sim2real.analysis.page import PageTable

    with options.progress_of(options.console) as progress:
        bar = progress.add_task("starting", total=None)

        def show(text: str, done: float, total: float) -> None:
            progress.update(bar, description=text, completed=done, total=total)

        found = run_demo(out, quick=quick, progress=show)
    for task in TASKS:
        title = f"{task.title}, worse arm of" if task.name == "sine" else task.title
        _print(title, task.table("", found.results.get(task.name, ()), task.page_only))
    for pair in found.pairs:
        task = pair.run.task
        sides = [(name, "", side) for name, side in pair.sides]
        _print(f"{task.title} on emulated controllers", PageTable.of("", task.emulated_columns, sides))
    if found.pairs:
        shown = [each for each in emulated.TIMING_COLUMNS if each.title not in emulated.PAGE_ONLY]
        rows = [(pair.run.task.title, "", pair) for pair in found.pairs]
        _print("Emulated, simulated", PageTable.of("", shown, rows))
    options.console.print(
        "Dim rows are those of an exact model: an artefact. No real arm was measured, and emulated is not real; L is 0 "
        "unless a row says so.",
        style="dim",
    )
    _say(f"report  {out / 'report.html'}")
    for film in found.films.values():
        _say(f"video   {film.path}")
    if found.missing:
        _say(f"[yellow]no video:[/] {escape(found.missing)}")
    warnings = [f"not on emulated controllers: {each.run.task.title}: {each.reason}" for each in found.failures]
    for warning in (*warnings, *(each for pair in found.pairs for each in emulated.remarks(pair))):
        _say(f"[yellow]{escape(warning)}[/]")
    if found.failures:
        _say(emulated.ON_FAILURE)


def _check_extras() -> None:
    """Check what the report needs. Without ur_rtde, which has no wheels for some machines, it says so and has the rest.

    Raises:
        MissingExtraError: A package is not installed.
    """
    needs = (
        ("plot", "the demonstration's report"),
        ("records", "reading its records"),
        ("emulator", "its emulated cell"),
    )
    try:
        options.check_extras(*needs)
    except MissingExtraError:
        options.check_extras(*needs, ("real", "moving their arms"))  # one request for all
        raise


def _say(text: str) -> None:
    options.console.print(text, soft_wrap=True, highlight=False)


def _print(title: str, shown: PageTable) -> None:
    """Print a table of the report; its weak rows are dim."""
    import rich.table

    table = rich.table.Table(box=None, header_style="bold", padding=(0, 0, 0, 1), pad_edge=False)
    table.add_column(f"\n\n{title}", min_width=18)
    for column in shown.columns:
        header = column.title.replace(" ", "\n") + f"\n[dim]{column.unit}[/]"
        table.add_column(header, justify="right", no_wrap=True)
    for row in shown.rows:
        table.add_row(row.title, *row.cells, style="dim" if row.kind == "weak" else "")
    options.console.print(table)
    options.console.print()


if __name__ == "__main__":
    begin_program()
    app(prog_name="python -m demo")
