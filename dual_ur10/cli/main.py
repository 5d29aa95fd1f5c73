"""The command line: `python -m dual_ur10`, or `dual-ur10`."""

from __future__ import annotations

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
from dual_ur10.cli.new_task import new_task
from dual_ur10.cli.options import console, errors
from dual_ur10.cli.records import compare, fit, replay
from dual_ur10.cli.rollout import rollout
from dual_ur10.cli.status import status
from dual_ur10.cli.teach import teach
from dual_ur10.cli.train import collect, convert, train
from dual_ur10.cli.view import view
from dual_ur10.errors import DualUR10Error
from dual_ur10.ids import __version__
from dual_ur10.sim2real.processes.interrupts import begin_program, end_interrupted

USAGE_ERROR = 2
"""Exit code of every error of this package."""


class _Commands(typer.core.TyperGroup):
    """Commands whose package errors, and Ctrl-C where a command does not handle it, end in one line each."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (DualUR10Error, gym.error.Error) as error:
            errors.print(f"[bold red]error:[/] [red]{escape(' '.join(str(error).split()))}[/]", soft_wrap=True)
            raise typer.Exit(USAGE_ERROR) from None
        except KeyboardInterrupt:
            end_interrupted()


app = typer.Typer(
    cls=_Commands,
    help="Two UR arms in MuJoCo, or on two controllers: run, measure, train and watch policies.",
    no_args_is_help=True,
    add_completion=False,
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


app.command("list")(list_environments)
_COMMANDS = (
    *(
        demo,
        rollout,
        follow,
        follow_points,
        follow_serial,
        teach,
        repeatability,
        view,
        evaluate,
        train,
        collect,
        new_task,
        convert,
    ),
    *(emulate, doctor, status, replay, compare, fit),
)
for command in _COMMANDS:
    app.command()(command)
app.add_typer(cell.app, name="cell")


def main() -> None:
    """Run the command line."""
    try:
        begin_program()
        app(prog_name="dual-ur10")
    except KeyboardInterrupt:  # between two commands
        end_interrupted()


if __name__ == "__main__":
    main()
