"""The command `ur-emulator`, and the options that it shares with `dual-ur10 emulate`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from ur_core.errors import MissingExtraError, SettingsError, URError
from ur_core.processes.interrupts import begin_program, end_interrupted
from ur_core.processes.system import LOCAL, System
from ur_emulator.world.plant import PlantOptions

if TYPE_CHECKING:
    from ur_emulator.emulator import Emulator

console = Console()
errors = Console(stderr=True)

USAGE_ERROR = 2
"""Exit code of every named error."""

Polyscope = Annotated[
    str | None,
    typer.Option(
        "--polyscope",
        help="PolyScope version of the controllers: 3.15, 5.12, 5.21, 5.22, 5.23, 5.25 or 5.26. Default: 3.15, or 5.12 "
        "of the e-Series.",
    ),
]
Plant = Annotated[
    str, typer.Option("--plant", help="Deviation of the arms from the nominal model: nominal, mild or wide.")
]
DhError = Annotated[float, typer.Option("--dh-error-mm", min=0.0, help="Largest error of the arms' kinematics, in mm.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the plant, a task's start, and random faults.")]
Programs = Annotated[
    str | None,
    typer.Option("--programs", help="Folder of programs (NAME.script) that the dashboard's load finds."),
]
Powered = Annotated[bool, typer.Option("--powered/--powered-off", help="Start with the arms powered on, or off.")]
View = Annotated[bool, typer.Option("--view", help="Show the arms in a browser on this machine.")]

_ROBOT = "ur5e"

CELLS = "ur_emulator.cells"
"""Group of the entry point of the function that reads cell files: path, hosts, seed and options to an `Emulator`."""


class _Command(typer.core.TyperCommand):
    """Command whose named errors end in one line."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except URError as error:
            errors.print(f"[bold red]error:[/] [red]{escape(' '.join(str(error).split()))}[/]", soft_wrap=True)
            raise typer.Exit(USAGE_ERROR) from None
        except KeyboardInterrupt:
            end_interrupted()


app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,  # any other error is a bug: show its traceback
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command(cls=_Command, epilog="Example: ur-emulator --robot ur5e")
def emulate(
    robot: Annotated[
        list[str] | None,
        typer.Option("--robot", help=f"Model of an arm. One controller for each time it is given. Default: {_ROBOT}."),
    ] = None,
    address: Annotated[
        list[str] | None,
        typer.Option(
            "--address",
            help="Loopback address of a controller, once for each. Default: 127.0.0.1, 127.0.0.2 and so on.",
        ),
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option(
            "--cell",
            metavar="FILE",
            help="Cell file of a real cell: its two controllers here, with its models, mounts, grippers, serial "
            "numbers and the scene of its task.",
        ),
    ] = None,
    polyscope: Polyscope = None,
    plant: Plant = PlantOptions.plant,
    dh_error: DhError = 0.0,
    seed: Seed = 0,
    programs: Programs = None,
    powered: Powered = True,
    view: View = False,
) -> None:
    """Run emulated UR controllers on this machine, each with its simulated arm, until Ctrl-C."""
    log_warnings()
    options = {
        "polyscope": polyscope,
        "plant": plant,
        "dh_error_m": dh_error / 1e3,
        "programs": programs,
        "powered": powered,
        "view": view,
    }
    if cell is not None and robot:
        raise SettingsError("--cell names the models: leave out --robot")
    robots = robot or [_ROBOT]
    count = len(robots) if cell is None else 2
    hosts = address or [f"127.0.0.{number}" for number in range(1, count + 1)]
    if len(hosts) != count or len(set(hosts)) != count:
        raise SettingsError(
            f"{count} controller{'s' * (count > 1)} with --address {', '.join(hosts)}: give each its own, or none"
        )
    serve(by_themselves(robots, hosts, seed, options) if cell is None else [_of_cell(cell, hosts, seed, options)])


def by_themselves(
    robots: Sequence[str], hosts: Sequence[str], seed: int, options: dict[str, Any], system: System = LOCAL
) -> list[Emulator]:
    """Return controllers that know nothing of each other and take turns.

    Args:
        robots: Model of each.
        hosts: Address of each.
        seed: Seed of the first; the others have the next ones.
        options: Other options, see `ur_emulator.emulator.EmulatorOptions`.
        system: Clock and network.
    """
    from ur_emulator.emulator import ControllerOptions, Emulator
    from ur_emulator.ports.sockets import Hub

    hub = Hub(seed, system=system)
    return [
        Emulator(ControllerOptions(robot=robot, host=host, seed=seed + number, **options), hub=hub, system=system)
        for number, (robot, host) in enumerate(zip(robots, hosts, strict=True))
    ]


def _of_cell(path: Path, hosts: Sequence[str], seed: int, options: dict[str, Any]) -> Emulator:
    """Return emulated controllers in place of those of a cell file, by what an installed package registers for that."""
    from importlib.metadata import entry_points

    points = tuple(entry_points(group=CELLS))
    if not points:
        raise MissingExtraError("dual-ur10", "emulator", "--cell")
    emulator: Emulator = points[0].load()(path, hosts, seed, options)
    return emulator


def log_warnings() -> None:
    """Print warnings of controllers, from their start on."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s: %(message)s")


def serve(emulators: Sequence[Emulator], *, title: str = "", notes: Sequence[str] = ()) -> None:
    """Print what emulated controllers listen on, and run them until Ctrl-C.

    Args:
        emulators: The controllers. They are closed.
        title: Lines in place of those of each controller; "" prints its ports.
        notes: Further lines.
    """
    from ur_emulator.emulator import run

    servers = [server for each in emulators for server in each.servers]
    try:
        for emulator in emulators:
            for server in emulator.servers if not title else ():
                ports = ", ".join(f"{name} {port.number}" for name, port in server.ports.items())
                model = server.controller.profile.model
                console.print(f"[bold cyan]{server.host}[/] {model}: {ports}", highlight=False, soft_wrap=True)
            host, description = emulator.servers[0].host, emulator.description()
            console.print(f"{title}fault injection {host}:{description['emulator']['port']}", highlight=False)
            for each in notes:
                console.print(each, highlight=False)
            if emulator.url:
                console.print(
                    f"the viewer is at [bold cyan]{emulator.url}[/] for browsers on this machine", soft_wrap=True
                )
        models = " and ".join(dict.fromkeys(server.controller.profile.model for server in servers))
        only = len(servers) == 1
        console.print(
            f"emulated {models} controller{'' if only else 's'}, not {'a real one' if only else 'real ones'}. "
            f"Ctrl-C ends {'it' if only else 'them'}",
            style="dim",
        )
        run(emulators)
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        for emulator in emulators:
            emulator.close()


def main() -> None:
    """Run the command line."""
    try:
        begin_program()
        app(prog_name="ur-emulator")
    except KeyboardInterrupt:  # before the command, or after it
        end_interrupted()
