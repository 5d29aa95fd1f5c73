"""The command `emulate`."""

from __future__ import annotations

from typing import Annotated

import typer

from dual_ur10.cli.options import ArmFamily, Left, Right, Settings, keywords_of
from ur_emulator.cli import DhError, Plant, Polyscope, Powered, Programs, Seed, View, log_warnings, serve
from ur_emulator.world.plant import PlantOptions


def emulate(
    left: Left = None,
    right: Right = None,
    family: ArmFamily = None,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            help="Model of both arms, such as ur5e, of those that `list` names; or of left and right: ur5e,ur10e. "
            "Default: ur10, or ur10e of the e-Series.",
        ),
    ] = None,
    polyscope: Polyscope = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            help="Environment whose scene and start are simulated. Default: two arms of any model at home on a table, "
            "with nothing to handle.",
        ),
    ] = None,
    settings: Settings = None,
    tool: Annotated[
        str | None,
        typer.Option(
            "--tool",
            help="Gripper of both arms, such as generic_140, or of left and right: generic_140,robotiq_2f85; "
            "module:NAME for one of your own. Default: those of the task.",
        ),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option("--cell", help="Write a cell file, for programs that connect."),
    ] = None,
    plant: Plant = PlantOptions.plant,
    dh_error: DhError = 0.0,
    seed: Seed = 0,
    programs: Programs = None,
    powered: Powered = True,
    view: View = False,
) -> None:
    """Run two emulated UR controllers on this machine, with simulated arms behind them, until Ctrl-C."""
    from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions

    log_warnings()
    options = CellOptions(
        left=left,
        right=right,
        family=family,
        robot=_of_each(robot),
        polyscope=polyscope,
        task=task,
        settings=keywords_of(settings, perturbed=False),
        tools=_of_each(tool),
        plant=plant,
        seed=seed,
        dh_error_m=dh_error / 1e3,
        powered=powered,
        view=view,
        cell=cell,
        programs=programs,
    )
    emulator = CellEmulator(options)
    hosts = [server.host for server in emulator.servers]
    title = f"left  [bold cyan]{hosts[0]}[/]\nright [bold cyan]{hosts[1]}[/]\n"
    serve([emulator], title=title, notes=[] if cell is None else [f"cell file {cell}"])


def _of_each(value: str | None) -> str | list[str] | None:
    return value.split(",") if value is not None and "," in value else value
