"""The command line: `python -m dual_ur10`, or `dual-ur10`."""

from __future__ import annotations

import contextlib
import logging
import traceback
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Final

import gymnasium as gym
import typer
from rich.markup import escape

from dual_ur10.cli.options import at_end, console, errors, example_of
from dual_ur10.errors import DualUR10Error
from dual_ur10.ids import __version__
from ur_core.processes.interrupts import begin_program, end_interrupted

USAGE_ERROR = 2
"""Exit code of every error of this package, and of a policy's exception that made a latched stop."""

_STOPPED: Final = "both arms were stopped"

_COMMANDS: Final[dict[str, dict[str, str]]] = {
    "Simulate": {
        "list": "list:list_environments",
        "view Handover --policy learned": "view:view",
        "live Handover --policy scripted": "live:live",
        "video Handover --policy learned --cameras front,left/wrist,right/wrist -o handover.mp4": "video:video",
        "rollout Handover --episodes 3 --randomization mild": "rollout:rollout",
        "evaluate SineTracking --policy learned --randomization mild --json sine.json": "evaluate:evaluate",
        "check-configuration BoxLift --cell cell.toml": "check_configuration:check_configuration",
        "new-task OpenDrawer": "new_task:new_task",
        "audit Handover": "audit:audit",
    },
    "Learn": {
        "train SineTracking --algo ppo --out sine": "train:train",
        "collect SyncCarry --episodes 200 --randomization mild": "collect:collect",
        "serve sine --port 8000": "serve:serve",
        "convert model.zip SineTracking --out sine --trust-pickle": "convert:convert",
    },
    "Controllers, emulated or real": {
        "emulate --cell cell.toml --view": "emulate:emulate",
        "doctor --cell cell.toml": "doctor:doctor",
        "status --cell cell.toml": "status:status",
        "follow --to home --cell cell.toml": "follow:follow",
        "follow-points points.csv --cell cell.toml --rate 10": "follow:follow_points",
        "follow-serial points.csv --port /dev/ttyACM0 --at-start": "follow:follow_serial",
        "teach points.csv --cell cell.toml": "teach:teach",
        "repeatability --paths 5 --perturbed": "doctor:repeatability",
        "cell": "cell:app",
    },
    "Records": {
        "replay runs/RUN": "records:replay",
        "compare runs/RUN_A runs/RUN_B": "records:compare",
        "fit runs/RUN --write cell.toml": "records:fit",
        "export lerobot runs/RUN --out carry": "exchange:exporter",
        "import lerobot carry": "exchange:importer",
    },
}
"""Examples of the commands, and "module:function" of each, by the panel of the help that lists them."""


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """End named errors in a line on stderr and exit code 2, and Ctrl-C as every program of this package does."""
    try:
        yield
    except (DualUR10Error, gym.error.Error) as error:
        errors.print(f"[bold red]error:[/] [red]{escape(' '.join(str(error).split()))}[/]", soft_wrap=True)
        raise typer.Exit(USAGE_ERROR) from None
    except KeyboardInterrupt:
        end_interrupted()
    except Exception as error:
        if any(_STOPPED in note for note in getattr(error, "__notes__", ())):
            traceback.print_exception(error)  # its last line is the note, which says how to go on
        elif isinstance(error, OSError) and error.filename is not None:  # the name of a file is too long, say
            named = escape(f"{error.strerror}: {str(error.filename)!r:.120}")
            errors.print(f"[bold red]error:[/] [red]{named}[/]", soft_wrap=True)
        else:
            raise
        raise typer.Exit(USAGE_ERROR) from None


class _Plain:
    """Mixin of commands with whole summaries, and help that shows no type beside flags, which take no value."""

    def get_short_help_str(self, limit: int = 1000) -> str:
        return str(super().get_short_help_str(limit))  # type: ignore[misc]  # of Typer's command

    def get_params(self, ctx: Any) -> list[Any]:
        found: list[Any] = super().get_params(ctx)  # type: ignore[misc]  # the same
        for each in found:
            if getattr(each, "is_bool_flag", False):
                each.metavar = ""
        return found


class _Command(_Plain, typer.core.TyperCommand):
    """One command."""


class _Group(_Plain, typer.core.TyperGroup):
    """Commands of one noun."""


class _Loaded(Mapping[str, Any]):
    """Commands by name, each imported on first use: to import all of them takes longer than to answer a typo."""

    _WHERE: Final = {
        example.split()[0]: (panel, example, path)
        for panel, commands in _COMMANDS.items()
        for example, path in commands.items()
    }

    @staticmethod
    @cache
    def _load(name: str) -> Any:
        panel, example, path = _Loaded._WHERE[name]
        module, _, attribute = path.partition(":")
        found = getattr(import_module(f"dual_ur10.cli.{module}"), attribute)
        holder = typer.Typer(add_completion=False, rich_markup_mode="rich")
        if isinstance(found, typer.Typer):
            for each in found.registered_commands:
                each.cls = _Command
            holder.add_typer(found, cls=_Group, name=name, rich_help_panel=panel)
            return typer.main.get_group(holder).commands[name]
        holder.command(name, cls=_Command, rich_help_panel=panel, epilog=example_of(example))(found)
        return typer.main.get_command(holder)

    def __getitem__(self, name: str) -> Any:
        return self._load(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._WHERE)

    def __len__(self) -> int:
        return len(self._WHERE)


class _Commands(_Group):
    """Commands whose package errors, and Ctrl-C where a command does not handle it, end in one line each."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = _Loaded()  # type: ignore[assignment]  # nothing is added later

    def invoke(self, ctx: Any) -> Any:
        with one_line_errors(), at_end:
            return super().invoke(ctx)


class _RunPrinter(logging.Handler):
    """Prints where a run is recorded, for whichever command records it."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(record.getMessage(), highlight=False, soft_wrap=True, markup=False)


_RECORDING = logging.getLogger("dual_ur10.sim2real.recording.run_folder")
_SHOWN = _RunPrinter()

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


def main() -> None:
    """Run the command line."""
    try:
        begin_program()
        app(prog_name="dual-ur10")
    except KeyboardInterrupt:  # between two commands
        end_interrupted()


if __name__ == "__main__":
    main()
