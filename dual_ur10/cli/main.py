"""The command line: `python -m dual_ur10`, or `dual-ur10`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Annotated, Any

import gymnasium as gym
import typer
from rich.markup import escape

from dual_ur10.cli import cell
from dual_ur10.cli.demo import demo
from dual_ur10.cli.doctor import doctor, repeatability
from dual_ur10.cli.emulate import emulate
from dual_ur10.cli.evaluate import evaluate
from dual_ur10.cli.follow import follow, follow_points, follow_serial
from dual_ur10.cli.list import list_environments
from dual_ur10.cli.live import live
from dual_ur10.cli.new_task import new_task
from dual_ur10.cli.options import at_end, console, errors, example_of
from dual_ur10.cli.records import compare, fit, replay
from dual_ur10.cli.rollout import rollout
from dual_ur10.cli.status import status
from dual_ur10.cli.teach import teach
from dual_ur10.cli.train import collect, convert, train
from dual_ur10.cli.video import video
from dual_ur10.cli.view import view
from dual_ur10.errors import DualUR10Error
from dual_ur10.ids import __version__
from dual_ur10.sim2real.processes.interrupts import begin_program, end_interrupted
from dual_ur10.sim2real.recording import run_folder

USAGE_ERROR = 2
"""Exit code of every error of this package."""


class _Commands(typer.core.TyperGroup):
    """Commands whose package errors, and Ctrl-C where a command does not handle it, end in one line each."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with at_end:
                return super().invoke(ctx)
        except (DualUR10Error, gym.error.Error) as error:
            errors.print(f"[bold red]error:[/] [red]{escape(' '.join(str(error).split()))}[/]", soft_wrap=True)
            raise typer.Exit(USAGE_ERROR) from None
        except KeyboardInterrupt:
            end_interrupted()


class _Shown(logging.Handler):
    """Prints where a run is recorded, for whichever command records it."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(record.getMessage(), highlight=False, soft_wrap=True, markup=False)


_RECORDING = logging.getLogger(run_folder.__name__)
_SHOWN = _Shown()

app = typer.Typer(
    cls=_Commands,
    help="Two UR arms in MuJoCo, or on two controllers: run, measure, train and watch policies.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,  # any other error is a bug: show its traceback
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _options(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        console.print(__version__, highlight=False)
        raise typer.Exit
    _RECORDING.addHandler(_SHOWN)
    ctx.call_on_close(lambda: _RECORDING.removeHandler(_SHOWN))  # what records later in this process shows nothing
    _RECORDING.setLevel(logging.INFO)


_COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "Simulate": {
        "list": list_environments,
        "demo --quick": demo,
        "view Handover --policy learned": view,
        "live Handover --policy scripted": live,
        "video Handover --policy learned --cameras front,left/wrist,right/wrist -o handover.mp4": video,
        "rollout Handover --episodes 3 --set randomization=mild": rollout,
        "evaluate SineTracking --policy learned --randomization mild --json sine.json": evaluate,
        "new-task PegInsertion": new_task,
    },
    "Learn": {
        "train SineTracking --algo ppo --out sine": train,
        "collect SyncCarry --episodes 200 --randomization mild": collect,
        "convert model.zip SineTracking --out sine --trust-pickle": convert,
    },
    "Controllers, emulated or real": {
        "emulate --cell cell.toml --view": emulate,
        "doctor cell.toml": doctor,
        "status cell.toml": status,
        "follow --to home --cell cell.toml": follow,
        "follow-points points.csv --cell cell.toml --rate 10": follow_points,
        "follow-serial points.csv --port /dev/ttyACM0 --at-start": follow_serial,
        "teach points.csv --cell cell.toml": teach,
        "repeatability --paths 5 --perturbed": repeatability,
    },
    "Records": {
        "replay runs/RUN": replay,
        "compare runs/RUN_A runs/RUN_B": compare,
        "fit runs/RUN --write cell.toml": fit,
    },
}
"""Commands by the panel of the help that lists them, each with an example."""

for panel, commands in _COMMANDS.items():
    for example, command in commands.items():
        app.command(example.split()[0], rich_help_panel=panel, epilog=example_of(example))(command)
app.add_typer(cell.app, name="cell", rich_help_panel="Controllers, emulated or real")


def main() -> None:
    """Run the command line."""
    try:
        begin_program()
        app(prog_name="dual-ur10")
    except KeyboardInterrupt:  # between two commands
        end_interrupted()


if __name__ == "__main__":
    main()
