"""Options that several commands share, and the values that they stand for."""

from __future__ import annotations

import ast
import importlib.util
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dual_ur10.errors import MissingExtraError, SettingsError
from ur_core.kinematics.robots import robot_model

console = Console()
errors = Console(stderr=True)

at_end = ExitStack()
"""Functions that are called at the end of a command."""


VIRTUAL = "virtual"
"""Value of --cell for two emulated controllers on a virtual clock."""

RUNS = Path("runs")
"""Default folder of recorded runs."""

EnvName = Annotated[
    str,
    typer.Argument(
        metavar="ENV", help="An id, such as DualUR10/SineTracking-v0, or its short form SineTracking; `list` names all."
    ),
]
POLICIES = (
    "scripted, learned, learned-two-agents, random or zero; the folder of a checkpoint; module:Class; or "
    "remote:ws://HOST:PORT, a policy server."
)
"""Forms of --policy."""

PolicyName = Annotated[
    str,
    typer.Option(
        "--policy",
        "-p",
        help=POLICIES,
    ),
]
OperatorName = Annotated[
    str | None,
    typer.Option(
        "--operator",
        metavar="DEVICE",
        help="A person leads the arms instead of a policy, with a device and its arguments, such as "
        "spacemouse:left=/dev/hidraw3,right=/dev/hidraw4; keyboard, gamepad, spacemouse, leader, page, or "
        "module:Class.",
    ),
]
TakeoverName = Annotated[
    str | None,
    typer.Option(
        "--takeover",
        metavar="DEVICE",
        help="A person takes one arm or both from the policy at any time, and hands them back, with a device as for "
        "--operator: keys 1, 2, 3 take the left arm, the right one, both; 0 hands back.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A keyword of the environment, such as amplitude_m=0.05. May be repeated. An unknown one is answered with "
        "all of them.",
    ),
]
Perturbed = Annotated[bool, typer.Option("--perturbed", help="A plant that differs from the nominal model.")]
Randomization = Annotated[
    str | None,
    typer.Option("--randomization", metavar="PRESET", help="Randomization of each episode: none, mild or wide."),
]
CellName = Annotated[
    Path | None,
    typer.Option(
        "--cell",
        metavar="FILE",
        help="A cell file: run on its two controllers, not in MuJoCo. Or virtual: on two emulated controllers and a "
        "virtual clock, faster than real time. Or echo: a dry run.",
    ),
]
OneArm = Annotated[
    str | None, typer.Option("--arm", help="left or right: only this arm moves, the other holds. Needs --cell.")
]
PowerOn = Annotated[
    bool, typer.Option("--power-on", help="First power the arms on and release their brakes. Real arms need your yes.")
]
Record = Annotated[
    Path, typer.Option("--record", metavar="FOLDER", help="Record the run, in a new folder inside this one.")
]
NoRecord = Annotated[bool, typer.Option("--no-record", help="Do not record.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="A recorded run: its folder or its file.")]
Partial = Annotated[
    bool, typer.Option("--allow-partial", help="Read the intact part of a run that was cut off, for example by a kill.")
]
Seed = Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode; the next ones count up.")]
MinSuccess = Annotated[
    float | None,
    typer.Option(
        "--min-success",
        metavar="RATE",
        help="Exit with code 1 below this success rate, such as 1: all succeed. Without it the code is 0 even if none "
        "does.",
    ),
]
Left = Annotated[str | None, typer.Option("--left", help="IPv4 address of the left controller.")]
Right = Annotated[str | None, typer.Option("--right", help="IPv4 address of the right controller.")]
ArmFamily = Annotated[
    str | None, typer.Option("--family", help="cb3 (125 Hz) or e-series (500 Hz). Default: that of the robot, or cb3.")
]
ArmModel = Annotated[
    str | None,
    typer.Option(
        "--robot",
        help="Model of both arms, such as ur5e, of those that `list` names. Default: ur10, or ur10e of the e-Series.",
    ),
]


def example_of(arguments: str) -> str:
    """Return the last line of a command's help."""
    return f"Example: dual-ur10 {arguments}"


def is_file(cell: str) -> bool:
    """Return True if the value of --cell names a cell file."""
    return "/" in cell or cell.endswith(".toml")


def keywords_of(
    settings: list[str] | None, perturbed: bool, cell: Any = None, arm: str | None = None
) -> dict[str, Any]:
    """Return keywords of the environment from `KEY=VALUE` texts; values are Python literals or JSON, else text.

    Raises:
        SettingsError: A text has no "=", a key is given twice, or two options do not go together.
    """
    keywords: dict[str, Any] = {}
    if perturbed and cell is not None:
        raise SettingsError("--perturbed is for simulation, --cell for two controllers: leave one out")
    if arm is not None and cell is None:
        raise SettingsError("--arm is for two controllers: name their cell file with --cell")
    if cell is not None:
        keywords["cell"] = str(cell) if isinstance(cell, Path) else cell
    if arm is not None:
        keywords["arm"] = arm
    if perturbed:
        from dual_ur10.sim2real.cell.cell_config import CellConfig
        from dual_ur10.sim2real.cell.perturbation import TYPICAL_PERTURBATION

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
    """Add --randomization to the keywords of the environment.

    Raises:
        SettingsError: The keywords have it already.
    """
    if preset is None:
        return
    if "randomization" in keywords:
        raise SettingsError("randomization is set twice: --randomization sets it")
    keywords["randomization"] = preset


def record_in(keywords: dict[str, Any], folder: Path, about: dict[str, Any]) -> None:
    """Add the folder of the recording, unless --set names another, and the policy's provenance to the keywords."""
    keywords.setdefault("record", str(folder))
    keywords.setdefault("record_about", about)


def progress_of(console: Console, asked: bool = False, left: bool = True) -> Progress:
    """Return a progress bar with the time left, on a terminal alone.

    Args:
        console: Where it is shown.
        asked: Questions to the operator come meanwhile: it is off, as it would be drawn over them.
        left: The time left is that at the present rate; False: its description has it.
    """
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    remaining = (TimeRemainingColumn(),) if left else ()
    return Progress(*columns, *remaining, console=console, transient=True, disable=not console.is_terminal or asked)


PACKAGES: Final[Mapping[str, Mapping[str, str]]] = {
    "calibration": {"OpenCV": "cv2", "PyYAML": "yaml", "scipy": "scipy", "tomlkit": "tomlkit"},
    "data": {"Minari": "minari"},
    "dm": {"dm-env": "dm_env", "dm-control": "dm_control"},
    "emulator": {"ur-emulator": "ur_emulator"},
    "lerobot": {"pyarrow": "pyarrow", "PyAV": "av", "mcap": "mcap", "mcap-ros2-support": "mcap_ros2"},
    "live": {"viser": "viser"},
    "plot": {"matplotlib": "matplotlib", "imageio-ffmpeg": "imageio_ffmpeg", "jinja2": "jinja2"},
    "real": {"ur_rtde": "rtde_control", "PyYAML": "yaml", "scipy": "scipy"},
    "records": {"mcap": "mcap", "mcap-ros2-support": "mcap_ros2", "scipy": "scipy", "tomlkit": "tomlkit"},
    "remote": {"websockets": "websockets", "msgspec": "msgspec"},
    "serial": {"pyserial": "serial"},
    "teleop": {"PySDL2": "sdl2", "pyserial": "serial"},
    "train": {"stable-baselines3": "stable_baselines3", "torch": "torch"},
    "virtual": {"ur-emulator": "ur_emulator", "greenlet": "greenlet", "ur_rtde": "rtde_control"},
}
"""Modules by which packages are found, by extra and package."""


def check_extras(
    *needs: tuple[str, str], cell: object = None, devices: Sequence[str | None] = (), moves: bool = True
) -> None:
    """Ask for all extras that a command needs and that are not installed, at once and before it begins.

    Args:
        *needs: Extras with nouns for what needs them, such as ("live", "the live page").
        cell: Value of --cell.
        devices: Values of --operator and --takeover.
        moves: The cell's arms may move.

    Raises:
        MissingExtraError: One is not installed.
        SettingsError: An argument of a device has another form.
    """
    wanted = dict(needs)
    for device in filter(None, devices):
        from dual_ur10.policies.operators.catalog import extra_of

        wanted |= dict(filter(None, [extra_of(device)]))
    if str(cell) == VIRTUAL:
        wanted["virtual"] = "a virtual cell"
    elif moves and cell is not None and is_file(str(cell)):
        wanted["real"] = "moving UR arms"
    missing: list[MissingExtraError] = []
    for extra, purpose in wanted.items():
        packages = (name for name, module in PACKAGES[extra].items() if importlib.util.find_spec(module) is None)
        if package := next(packages, None):
            missing = [MissingExtraError(package, extra, purpose, missing)]
    if missing:
        raise missing[0]


def print_whole(table: Table) -> None:
    """Print a table, fitted to a terminal. In a file or pipe no cell is wrapped, so that a search finds its text."""
    if console.is_terminal:
        console.print(table)
        return
    width = Measurement.get(console, console.options.update(width=10_000), table).maximum
    Console(file=console.file, width=width).print(table)


def family_of(family: str | None, robot: str | None) -> str:
    """Return the family of controllers that is named, or that of a named robot, or that of the UR10.

    Raises:
        UnknownNameError: There is no such robot.
    """
    if family is not None:
        return family
    return robot_model(robot or "ur10").family


def _value(text: str) -> Any:
    for parse in (ast.literal_eval, lambda each: json.loads(each, parse_constant=_no_constant)):
        try:
            return parse(text.strip())
        except (ValueError, SyntaxError):
            continue
    return text


def _no_constant(name: str) -> None:
    """Refuse NaN and Infinity, which Python reads although they are not JSON."""
    raise ValueError(name)
