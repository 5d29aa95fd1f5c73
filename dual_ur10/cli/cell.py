"""The commands `cell new`, `cell check`, `cell show` and `cell clear`; `cell calibrate` is in `calibrate`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.calibrate import calibrate
from dual_ur10.cli.options import ArmFamily, ArmModel, Left, Right, console, errors, example_of, family_of
from dual_ur10.errors import CellFileError, SettingsError, UnknownNameError
from dual_ur10.ids import env_id_of

FINDINGS = 2
"""Exit code of a file with errors."""

app = typer.Typer(help="Create, check, show and calibrate cell files, and clear latched stops.", no_args_is_help=True)

File = Annotated[Path, typer.Argument(metavar="FILE", help="A cell file, such as lab.toml.")]


@app.command(epilog=example_of("cell new lab.toml --left 192.168.1.10 --right 192.168.1.11"))
def new(
    file: File,
    kind: Annotated[str, typer.Option("--kind", help="real or emulated.")] = "real",
    left: Left = None,
    right: Right = None,
    family: ArmFamily = None,
    robot: ArmModel = None,
    task: Annotated[str | None, typer.Option("--task", help="Environment for which the cell is set up.")] = None,
) -> None:
    """Write a commented cell file to start from, slow enough for a first run. Files are never overwritten."""
    from dual_ur10.sim2real.cell_file.reference import starting_text, write_new

    if kind not in ("real", "emulated"):
        raise UnknownNameError("kind of cell", kind, ("real", "emulated"))
    task_id = None if task is None else env_id_of(task)
    controllers = family_of(family, robot)
    write_new(file, starting_text(kind, left, right, controllers, task_id, str(file), robot))  # type: ignore[arg-type]  # checked
    console.print(f"wrote [bold cyan]{escape(str(file))}[/]", highlight=False, soft_wrap=True)
    if kind == "real":
        console.print(
            "Measure the bases, and copy payload, TCP and calibration from the controllers. Then: "
            f"python -m dual_ur10 cell check {escape(str(file))}",
            style="dim",
            highlight=False,
            soft_wrap=True,
        )


@app.command(epilog=example_of("cell check lab.toml"))
def check(file: File) -> None:
    """Report all errors of a cell file, a line each. Connects to nothing."""
    from dual_ur10.sim2real.cell_file.cell_file import examine

    cell, findings = examine(file)
    if cell is not None:
        try:
            cell.config()
        except CellFileError as error:
            findings = [str(error).removeprefix(f"{file}: ")]
    for finding in findings:
        errors.print(f"[bold red]error:[/] [red]{escape(f'{file}: {finding}')}[/]", soft_wrap=True)
    if findings or cell is None:
        raise typer.Exit(FINDINGS)
    for note in cell.notes():
        console.print(f"[yellow]note:[/] {escape(note)}", highlight=False, soft_wrap=True)
    console.print(f"{escape(str(file))} is a legal {cell.kind} cell", highlight=False, soft_wrap=True)


@app.command(epilog=example_of("cell show lab.toml"))
def show(file: File) -> None:
    """Show all values of a cell file, defaults included."""
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file

    cell = load_cell_file(file)
    values = cell.mapping()
    left, right = _flat(values.pop("left")), _flat(values.pop("right"))
    whole = Table(header_style="bold")
    whole.add_column("cell", no_wrap=True)
    whole.add_column(escape(str(file)), overflow="fold")
    for name, value in (*_flat(values).items(), ("sha256", cell.sha256)):
        whole.add_row(escape(name), escape(value))
    arms = Table(header_style="bold")
    arms.add_column("arm", no_wrap=True)
    arms.add_column("left", overflow="fold")
    arms.add_column("right", overflow="fold")
    for name in [*left, *(each for each in right if each not in left)]:
        arms.add_row(escape(name), escape(left.get(name, "—")), escape(right.get(name, "—")))
    console.print(whole)
    console.print(arms)


@app.command(epilog=example_of("cell clear lab.toml"))
def clear(
    file: File,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask. Only for emulated cells.")] = False,
) -> None:
    """Clear a latched stop, once an operator has checked both arms, and report what still prevents a start."""
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
    from dual_ur10.sim2real.commissioning.doctor import check_file
    from dual_ur10.sim2real.commissioning.operator_prompts import ask_at_terminal
    from dual_ur10.sim2real.runtime.latch import Latch

    cell = load_cell_file(file)
    latch = Latch(cell)
    fault = latch.read()
    if fault is None:
        console.print(f"{escape(str(file))}: there is no fault", highlight=False, soft_wrap=True)
        return
    console.print(
        f"[bold red]stopped[/] at {fault.when_utc} UTC: {escape(fault.text)}", highlight=False, soft_wrap=True
    )
    if yes and cell.kind == "real":
        raise SettingsError("--yes is for emulated cells: an operator must check real arms and confirm at a terminal")
    if not yes and not ask_at_terminal("Have both arms been checked, and has the cause been removed?"):
        raise SettingsError("not confirmed: the latched stop remains")
    latch.clear()
    console.print("cleared: the next start checks both controllers again", highlight=False)
    for each in check_file(cell):
        if each.level == "fail":
            text = f"[yellow]it would be refused now:[/] {escape(each.message)}"
            console.print(text, highlight=False, soft_wrap=True)


def _flat(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Return values as texts, by their paths."""
    found: dict[str, str] = {}
    for name, value in values.items():
        here = f"{path}{name}"
        if isinstance(value, Mapping):
            found |= _flat(value, f"{here}.")
        elif isinstance(value, tuple) and value and isinstance(value[0], Mapping):
            for row, each in enumerate(value):
                found |= _flat(each, f"{here}[{row}].")
        else:
            found[here] = value if isinstance(value, str) else json.dumps(_short(value))
    return found


def _short(value: Any) -> Any:
    """Round numbers to nine digits."""
    if isinstance(value, tuple):
        return [_short(each) for each in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


app.command(epilog=example_of("cell calibrate lab.toml --data bases.json --suggest"))(calibrate)
