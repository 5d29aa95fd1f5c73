"""Options that several commands share, and the values that they stand for."""

from __future__ import annotations

import ast
import importlib.util
import json
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dual_ur10 import policies
from dual_ur10.errors import MissingExtraError, SettingsError, UnknownNameError, nearest_name
from dual_ur10.ids import env_id_of
from dual_ur10.policies.registry import check_name, keywords_for, wrong_types_named
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS
from ur_core.kinematics.robots import robot_model
from ur_core.processes.machine_load import too_busy

if TYPE_CHECKING:
    from dual_ur10.policies.operators.operator import Operator

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
POLICIES = "scripted, learned, learned-two-agents, random or zero; the folder of a checkpoint; or module:Class."
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


def _is_file(cell: str) -> bool:
    """Return True if the value of --cell names a cell file."""
    return "/" in cell or cell.endswith(".toml")


def on_virtual(cell: Path | None, task: str | None) -> Any:
    """Return the virtual cell that `--cell virtual` stands for, which ends with the command; another value unchanged.

    Args:
        cell: Value of the option.
        task: Id of the environment; None: none.

    Raises:
        MissingExtraError: The extra `virtual` is not installed.
        UnknownNameError: It is "virtual", misspelled.
    """
    if cell is None:
        return None
    if (name := str(cell)) != VIRTUAL:
        if not _is_file(name) and name not in CELL_KINDS and nearest_name(name, [VIRTUAL]):
            raise UnknownNameError("cell", name, [VIRTUAL, "echo"], "the path of a cell file, such as lab.toml")
        return name
    from dual_ur10.testing import VirtualCell

    made = VirtualCell(task=task)
    at_end.callback(made.close)
    return made


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


def asks(cell: object) -> bool:
    """Return True if a cell, the value of --cell, may ask the operator at the terminal before it moves."""
    return cell is not None and str(cell) != VIRTUAL


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
    "live": {"viser": "viser"},
    "plot": {"matplotlib": "matplotlib", "imageio-ffmpeg": "imageio_ffmpeg", "jinja2": "jinja2"},
    "real": {"ur_rtde": "rtde_control", "PyYAML": "yaml", "scipy": "scipy"},
    "records": {"mcap": "mcap", "mcap-ros2-support": "mcap_ros2", "scipy": "scipy", "tomlkit": "tomlkit"},
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
    elif moves and cell is not None and _is_file(str(cell)):
        wanted["real"] = "moving UR arms"
    missing: list[MissingExtraError] = []
    for extra, purpose in wanted.items():
        packages = (name for name, module in PACKAGES[extra].items() if importlib.util.find_spec(module) is None)
        if package := next(packages, None):
            missing = [MissingExtraError(package, extra, purpose, missing)]
    if missing:
        raise missing[0]


@contextmanager
def interrupts_noted() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets, instead of raising, within the block."""
    event = threading.Event()
    before = signal.signal(signal.SIGINT, lambda *_: event.set())
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


STOP_COMMANDED = "both arms were commanded to stop: check them"
"""Message on the arms of a cell after Ctrl-C."""


def print_whole(table: Table) -> None:
    """Print a table, fitted to a terminal. In a file or pipe no cell is wrapped, so that a search finds its text."""
    if console.is_terminal:
        console.print(table)
        return
    width = Measurement.get(console, console.options.update(width=10_000), table).maximum
    Console(file=console.file, width=width).print(table)


def late_text(count: int) -> str:
    """Return a suffix with the number of actions that missed their deadline; "" if none did."""
    if not count:
        return ""
    return f", {count} late action{'' if count == 1 else 's'}"


BELOW = 1
"""Exit code when too few episodes succeed."""


def check_min_success(rate: float | None) -> None:
    """Check the value of --min-success.

    Raises:
        SettingsError: It is no rate.
    """
    if rate is not None and not 0.0 <= rate <= 1.0:
        raise SettingsError(f"--min-success is {rate:g}: it must be a rate from 0 to 1, such as 0.95")


def conclude(successes: int, episodes: int, late: int, min_success: float | None) -> None:
    """Print a last line if no episode succeeded or too few did; exit with code `BELOW` below the required rate.

    Args:
        successes: Number of successful episodes.
        episodes: Number of episodes.
        late: Number of actions that missed their deadline.
        min_success: Required rate; None: none.
    """
    rate = successes / episodes
    below = min_success is not None and rate < min_success
    if successes and not below:
        return
    text = f"{'too few successes' if successes else 'nothing succeeded'}: {successes} of {episodes}"
    if below:
        text += f" are a rate of {rate:.4g}, required {min_success:g} or more"
    if late:
        text += (
            f"; {late} late action{'' if late == 1 else 's'} stopped both arms, which is no decision of the policy: "
            f"{too_busy('or the policy computes too long')}"
        )
    errors.print(f"[bold red]{escape(text)}[/]", soft_wrap=True, highlight=False)
    if below:
        raise typer.Exit(BELOW)


def power_on(cell: Path | None) -> None:
    """Power the arms of a cell on and release their brakes, once an operator at the terminal confirms it.

    Raises:
        SettingsError: No cell is named.
        StartError: The operator has not confirmed it.
        DualUR10Error: An arm cannot be powered on.
    """
    if cell is None:
        raise SettingsError("--power-on is for two controllers: name their cell file with --cell")
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
    from dual_ur10.sim2real.commissioning import power
    from dual_ur10.sim2real.commissioning.operator_prompts import prompt_for

    file = load_cell_file(cell)
    power.power_on(file, prompt_for(file))


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


def check_leader(policy: str, operator: str | None) -> None:
    """Refuse --policy beside --operator.

    Raises:
        SettingsError: Both are given.
    """
    if operator is not None and policy != "scripted":
        raise SettingsError(f"--policy {policy} and --operator {operator} do not go together: leave one out")


def make_operator(
    operator: str, env_id: str, keywords: dict[str, Any], *, keys: bool = False, buttons: Sequence[str] = ()
) -> Operator:
    """Return the operator of an environment, in the time of day.

    Raises:
        DualUR10Error: The device cannot be opened, or a value is not legal.
    """
    from dual_ur10.policies.operators.catalog import load_operator

    with wrong_types_named(env_id):
        return load_operator(operator, env_id, keywords, paced=True, keys=keys, buttons=buttons)


def make(
    env: str,
    policy: str,
    keywords: dict[str, Any],
    seed: int,
    operator: str | None = None,
    takeover: str | None = None,
    *,
    keys: bool = False,
) -> tuple[Any, Any]:
    """Return environment and policy, or the operator, whose device is to be closed; or a policy with a takeover.

    Args:
        env: Id of the environment, or its short form.
        policy: Name of the policy.
        keywords: Keywords of the environment.
        seed: Seed of random actions.
        operator: Device of an operator in place of the policy.
        takeover: Device of a person who may take over.
        keys: The keys of the terminal are buttons of an operator, too; a page has the buttons of episodes.

    Raises:
        DualUR10Error: A name or a value is not legal, or a device cannot be opened.
    """
    from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES

    env_id = env_id_of(env)
    check_leader(policy, operator)
    buttons = EPISODES if keys else ()
    if takeover is not None:
        return _make_takeover(env_id, policy, keywords, seed, operator, takeover, (*TAKES, *buttons))
    if operator is None:
        return policies.make(policy, env_id, seed=seed, **keywords)
    person, made = make_operator(operator, env_id, keywords, keys=keys, buttons=buttons), None
    try:
        made, _ = policies.make(person, env_id, **keywords)
        return shown(made, person), person
    except BaseException:
        if made is not None:
            made.close()
        person.close()
        raise


def _make_takeover(
    env_id: str,
    policy: str,
    keywords: dict[str, Any],
    seed: int,
    operator: str | None,
    device: str,
    buttons: Sequence[str],
) -> tuple[Any, Any]:
    """Return environment and policy with a person who may take over."""
    from dual_ur10.policies.operators.takeover import Takeover

    if operator is not None:
        raise SettingsError("--operator leads from the beginning, --takeover takes over from a policy: leave one out")
    check_name(policy)
    keywords = keywords_for(policy, env_id, keywords)
    person, made = make_operator(device, env_id, keywords, keys=True, buttons=buttons), None
    try:
        made, actor = make(env_id, policy, keywords, seed)
        actor = Takeover(actor, person, tell=lambda text: console.print(escape(text), highlight=False))
        return shown(made, person), actor
    except BaseException:
        if made is not None:
            made.close()
        person.close()
        raise


def shown(made: Any, person: Operator) -> Any:
    """Return an environment, shown by the page of its operator, once a browser has opened it; or as it is."""
    from dual_ur10.envs.rendering.live.shown import Shown
    from dual_ur10.policies.operators.page import PageDevice

    if not isinstance(person.device, PageDevice):
        return made
    page = person.device.page
    console.print(f"open the page to begin: {page.url}", soft_wrap=True, highlight=False, markup=False)
    page.wait_until_open()
    return Shown(made, page)


def close(made: Any, actor: Any) -> None:
    """Close an environment, and the device of an operator."""
    try:
        made.close()
    finally:
        if hasattr(actor, "device"):
            actor.close()
