"""The command `emulate`."""

from __future__ import annotations

import logging
from typing import Annotated

import typer

from dual_ur10.cli.options import ArmFamily, Left, Right, console


def emulate(
    left: Left = None,
    right: Right = None,
    family: ArmFamily = None,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            help="Model of both arms, such as ur5e, or of left and right: ur5e,ur10e. Default: ur10, or ur10e of the "
            "e-Series.",
        ),
    ] = None,
    polyscope: Annotated[
        str | None,
        typer.Option(
            "--polyscope",
            help="PolyScope version of the controllers, such as 5.26. Default: 3.15, or 5.12 of the e-Series.",
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            help="Environment whose scene and start are simulated. Default: two arms of any model at home on a table, "
            "with nothing to handle.",
        ),
    ] = None,
    cell: Annotated[
        str | None,
        typer.Option("--cell", help="Write a cell file, for programs that connect."),
    ] = None,
    plant: Annotated[
        str, typer.Option("--plant", help="Deviation of the arms from the nominal model: nominal, mild or wide.")
    ] = "mild",
    dh_error: Annotated[
        float, typer.Option("--dh-error-mm", min=0.0, help="Largest error of the arms' kinematics, in mm.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the plant, a task's start, and random faults.")] = 0,
    programs: Annotated[
        str | None,
        typer.Option("--programs", help="Folder of programs (NAME.script) that the dashboard's load finds."),
    ] = None,
    powered: Annotated[
        bool, typer.Option("--powered/--powered-off", help="Start with the arms powered on, or off.")
    ] = True,
    view: Annotated[bool, typer.Option("--view", help="Show the cell in a browser on this machine.")] = False,
) -> None:
    """Run two emulated UR controllers on this machine, with simulated arms behind them, until Ctrl-C."""
    from ur_emulator.emulator import Emulator, EmulatorOptions

    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s: %(message)s")
    options = EmulatorOptions(
        left=left,
        right=right,
        family=family,
        robot=None if robot is None else robot if "," not in robot else robot.split(","),
        polyscope=polyscope,
        task=task,
        plant=plant,
        seed=seed,
        dh_error_m=dh_error / 1e3,
        powered=powered,
        view=view,
        cell=cell,
        programs=programs,
    )
    emulator = Emulator(options)
    try:
        hosts = [server.host for server in emulator.servers]
        console.print(f"left  [bold cyan]{hosts[0]}[/]\nright [bold cyan]{hosts[1]}[/]", highlight=False)
        port = emulator.description()["emulator"]["port"]
        console.print(f"fault injection {hosts[0]}:{port}" + (f"\ncell file {cell}" if cell else ""), highlight=False)
        if emulator.url:
            console.print(f"the viewer is at [bold cyan]{emulator.url}[/] for browsers on this machine", soft_wrap=True)
        models = " and ".join(dict.fromkeys(server.controller.profile.model for server in emulator.servers))
        console.print(f"emulated {models} controllers, not real ones. Ctrl-C ends them", style="dim")
        emulator.run()
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        emulator.close()
