"""What the commands share: their arguments, and what these stand for."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress, ProgressColumn

from dual_ur10.errors import SettingsError

console = Console()
errors = Console(stderr=True)

EnvName = Annotated[
    str, typer.Argument(metavar="ENV", help="An id, such as DualUR10/SineTracking-v0; SineTracking will do.")
]
PolicyName = Annotated[
    str, typer.Option("--policy", "-p", help="scripted, learned, random or zero, or the folder of a checkpoint.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="A keyword of the environment, such as amplitude_m=0.05. May be repeated."
    ),
]
Perturbed = Annotated[
    bool, typer.Option("--perturbed", help="A plant that differs from what the controller believes of it.")
]
CellFileName = Annotated[
    Path | None, typer.Option("--cell", metavar="FILE", help="A cell file: on two controllers instead of in MuJoCo.")
]
OneArm = Annotated[
    str | None, typer.Option("--arm", help="left or right: this arm moves, the other stays where it is. With --cell.")
]
PowerOn = Annotated[
    bool, typer.Option("--power-on", help="Power the arms on and release their brakes first, if somebody confirms it.")
]
Record = Annotated[
    Path, typer.Option("--record", metavar="FOLDER", help="A folder with the record of this run is made in it.")
]
NoRecord = Annotated[bool, typer.Option("--no-record", help="Do not record.")]
RUNS = Path("runs")
"""Where runs are recorded if nothing else is said."""

Seed = Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode; the next ones count on.")]


def keywords_of(
    settings: list[str] | None, perturbed: bool, cell: Path | None = None, arm: str | None = None
) -> dict[str, Any]:
    """Keywords of the environment from `KEY=VALUE` texts; values are Python literals or JSON, or else text.

    Raises:
        SettingsError: A text has no "=", a key is given twice, or two options do not go together.
    """
    keywords: dict[str, Any] = {}
    if perturbed and cell is not None:
        raise SettingsError("--perturbed is of simulated cells, and --cell names two controllers: leave one out")
    if arm is not None and cell is None:
        raise SettingsError("--arm is of two controllers: name their cell file with --cell")
    if cell is not None:
        keywords["cell"] = str(cell)
    if arm is not None:
        keywords["arm"] = arm
    if perturbed:
        from dual_ur10.sim2real.config.cell import TYPICAL_PERTURBATION, CellConfig

        keywords["cell"] = CellConfig(perturbation=TYPICAL_PERTURBATION)
    for text in settings or ():
        key, sign, value = text.partition("=")
        key = key.strip()
        if not sign or not key.isidentifier():
            raise SettingsError(f"--set {text!r}: write it as KEY=VALUE, such as --set amplitude_m=0.05")
        if key in keywords:
            raise SettingsError(f"{key} is set twice" + (f": an option sets {key}" if key in ("cell", "arm") else ""))
        keywords[key] = _value(value)
    return keywords


def randomize(keywords: dict[str, Any], preset: str | None) -> None:
    """Put what --randomization says into the keywords of the environment.

    Raises:
        SettingsError: They say it already.
    """
    if preset is None:
        return
    if "randomization" in keywords:
        raise SettingsError("randomization is set twice: --randomization sets it")
    keywords["randomization"] = preset


def record_in(keywords: dict[str, Any], folder: Path, about: dict[str, Any]) -> None:
    """Let an environment record its run in a folder, unless --set names another, and say what is known of the run."""
    keywords.setdefault("record", str(folder))
    keywords.setdefault("record_about", about)


def progress_of(console: Console, cell: Path | None, *columns: ProgressColumn) -> Progress:
    """A bar for work that takes a while. None where arms move: it would be drawn over what a person is asked."""
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal or cell is not None)


TOLD_TO_REST = "both arms were told to come to rest: look at them"
"""What to say of the arms of a cell where somebody has interrupted."""


def late_text(count: int) -> str:
    """What to append where actions came too late."""
    if not count:
        return ""
    return f", {count} late action{'' if count == 1 else 's'}"


def power_on(cell: Path | None) -> None:
    """Power the arms of a cell on and release their brakes, if somebody at the terminal confirms it.

    Raises:
        SettingsError: No cell is named.
        StartError: Nobody is there to confirm it.
        DualUR10Error: An arm cannot be powered on.
    """
    if cell is None:
        raise SettingsError("--power-on is of two controllers: name their cell file with --cell")
    from dual_ur10.sim2real.commissioning import power
    from dual_ur10.sim2real.commissioning.operator_prompts import prompt_for
    from dual_ur10.sim2real.config.cell_file import load_cell_file

    file = load_cell_file(cell)
    power.power_on(file, prompt_for(file))


def _value(text: str) -> Any:
    for parse in (ast.literal_eval, lambda each: json.loads(each, parse_constant=_no_constant)):
        try:
            return parse(text.strip())
        except (ValueError, SyntaxError):
            continue
    return text


def _no_constant(name: str) -> None:
    """NaN and Infinity are not JSON, though Python reads them."""
    raise ValueError(name)
