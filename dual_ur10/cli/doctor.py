"""Commands that examine a cell: `doctor` and `repeatability`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import (
    ArmFamily,
    ArmModel,
    CellName,
    Left,
    Perturbed,
    PowerOn,
    Right,
    check_extras,
    console,
    family_of,
    keywords_of,
    print_whole,
    progress_of,
)
from dual_ur10.cli.session import on_virtual, power_on
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile, load_cell_file
from ur_core.kinematics.ur10 import ARMS, Family

if TYPE_CHECKING:
    from dual_ur10.sim2real.commissioning.findings import Finding

_MARKS = {"ok": "[green]ok[/]", "warn": "[yellow]warn[/]", "fail": "[bold red]fail[/]"}


def doctor(
    cell: Annotated[
        Path | None, typer.Option("--cell", metavar="FILE", help="A cell file; or name both addresses.")
    ] = None,
    left: Left = None,
    right: Right = None,
    family: ArmFamily = None,
    robot: ArmModel = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the checks as an array of JSON, and no table.")
    ] = False,
    pictures: Annotated[
        Path | None,
        typer.Option("--pictures", metavar="FOLDER", help="Folder for a picture of each camera of the cell file."),
    ] = None,
) -> None:
    """Check this machine and two UR controllers, and report problems with their remedies. Exit code 1 if a check fails.

    Nothing moves. Without a cell file and without addresses this machine alone is checked.
    """
    from dual_ur10.sim2real.commissioning.doctor import check_cell, check_file
    from dual_ur10.sim2real.commissioning.findings import ExpectedArm, any_fails
    from dual_ur10.sim2real.commissioning.installation import mujoco_finding

    findings = [mujoco_finding()]
    if cell is not None and left is None and right is None:
        file = load_cell_file(cell)
        findings += [*check_file(file), *_cameras(file, pictures)]
    elif cell is None and left is not None and right is not None:
        controllers = cast(Family, family_of(family, robot))
        findings += check_cell(*(ExpectedArm(host=host, family=controllers, model=robot) for host in (left, right)))
    elif cell is not None or left is not None or right is not None:
        raise SettingsError("name either a cell file with --cell, or both addresses with --left and --right")
    if as_json:
        typer.echo(json.dumps([_row(each) for each in findings], indent=1))
    else:
        _print(findings)
    if any_fails(findings):
        raise typer.Exit(1)


def _cameras(file: CellFile, pictures: Path | None) -> list[Finding]:
    """Check the cameras of a cell file, and write a picture of each."""
    from dual_ur10.sim2real.cameras.png import png
    from dual_ur10.sim2real.cameras.video_record import file_name
    from dual_ur10.sim2real.commissioning.camera_check import check_cameras

    if not file.camera:
        return []
    checked = check_cameras(file)
    if pictures is not None:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
            for entry, each in zip(file.camera, checked, strict=True):
                if each.picture is not None:
                    (pictures / f"{file_name(entry.name)}.png").write_bytes(png(each.picture.image))
        except OSError as error:
            raise SettingsError(f"pictures cannot be written to {pictures}: {error}. Name another folder") from error
    return [each.finding for each in checked]


def _row(each: Finding) -> dict[str, str]:
    return {
        "arm": each.arm,
        "check": each.name,
        "status": each.level,
        "found": each.found,
        "expected": each.expected,
        "remedy": each.remedy,
    }


def _print(findings: Sequence[Finding]) -> None:
    """Print the problems, worst first, with their remedies, and then what is in order in a line each."""
    problems = sorted((each for each in findings if each.level != "ok"), key=lambda each: each.level)  # fail, warn
    in_order = [each for each in findings if each.level == "ok"]
    for rows, texts in ((problems, ("found", "expected", "remedy")), (in_order, ("found",))):
        if not rows:
            continue
        table = Table(header_style="bold")
        for header in ("arm", "check", "", *texts):
            table.add_column(header, overflow="fold")
        for each in rows:
            cells = (escape(getattr(each, text)) for text in texts)
            table.add_row(each.arm, escape(each.name), _MARKS[each.level], *cells)
        print_whole(table)
    counts = {level: sum(each.level == level for each in findings) for level in _MARKS}
    warnings = f"{counts['warn']} warning{'' if counts['warn'] == 1 else 's'}"
    console.print(f"{counts['ok']} ok, {warnings}, {counts['fail']} failed", highlight=False)


def repeatability(
    paths: Annotated[int, typer.Option("--paths", min=2, help="Random paths away and back.")] = 20,
    cell: CellName = None,
    settle: Annotated[
        float, typer.Option("--settle", metavar="S", min=0.0, max=60.0, help="Rest before each measurement.")
    ] = 1.0,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the random paths.")] = 0,
    perturbed: Perturbed = False,
    power: PowerOn = False,
) -> None:
    """Measure how well both arms return to the home configuration, after random collision-free paths.

    Flange positions come from the joints' encoders by forward kinematics: they show no bending and no wrong kinematics.
    On two controllers the arms first move home slowly, once you confirm it, and then at the speeds of the cell.
    """
    import numpy as np

    from dual_ur10.follower import home_of, make_follower
    from dual_ur10.sim2real.trajectory.repeatability import UR10_M, returns, spread_of

    check_extras(cell=cell)
    keywords = keywords_of(None, perturbed, on_virtual(cell, None))
    if power:
        power_on(cell)
    chosen = keywords.get("cell", "mujoco")
    with make_follower(chosen) as executor:
        executor.start(home_of(chosen))
        with progress_of(console) as progress:  # the questions to the operator were asked at the start
            measured = returns(executor, paths, np.random.default_rng(seed), settle)
            found = list(progress.track(measured, paths, description="returning home"))
    only_ur10 = set(executor.gate.limits.robots) == {"ur10"}  # whose data sheet is known here
    spread = spread_of(np.stack([executor.flanges_m(q_rad) for q_rad in found]))
    table = Table(header_style="bold")
    for header in ("arm", "ISO 9283\n[dim]mm[/]", "largest\n[dim]mm[/]", *["UR10, data sheet\n[dim]mm[/]"] * only_ur10):
        table.add_column(header, justify="left" if header == "arm" else "right")
    for row, arm in enumerate(ARMS):
        values = (spread.iso_9283_m[row], spread.largest_m[row])
        table.add_row(arm, *(f"{1e3 * each:.5f}" for each in values), *[f"±{1e3 * UR10_M:g}"] * only_ur10)
    console.print(table)
    console.print(f"{paths} returns, {settle:g} s after each, from encoders and forward kinematics", highlight=False)
