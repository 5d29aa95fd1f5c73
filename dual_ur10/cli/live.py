"""The command `live`."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dual_ur10.cli.options import (
    POLICIES,
    VIRTUAL,
    CellName,
    EnvName,
    OneArm,
    Perturbed,
    PowerOn,
    Randomization,
    Seed,
    Settings,
    check_extras,
    console,
    errors,
    randomize,
)
from dual_ur10.cli.session import STOP_COMMANDED, close, keywords_on, make, power_on
from dual_ur10.envs.rendering.live.attendance import UNATTENDED_S
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.errors import SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.policies.baselines import BASELINES
from dual_ur10.policies.registry import check_name, keywords_for, names_for, wrong_types_named
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.envs.core.setup import EnvSetup
    from dual_ur10.envs.rendering.live.live_page import LivePage
    from dual_ur10.policies.operators.operator import Operator

PAGE = "page"
PAGE_EXTRA = "live", "the live page"
NOBODY = "none"

Port = Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the loopback interface; 0: any free one.")]
Cameras = Annotated[
    str,
    typer.Option(
        "--cameras",
        help="Cameras whose images are shown, with commas between: front, side, overhead, perspective, left/wrist, "
        "right/wrist, or one of the task's own; or none.",
    ),
]

NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Print the address of the page, and open no browser.")]


def live(
    env: EnvName,
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help=f"{POLICIES} Without it, the operator alone leads both arms.",
        ),
    ] = None,
    operator: Annotated[
        str,
        typer.Option(
            "--operator",
            metavar="DEVICE",
            help="page: the handles of the page lead arms. none: nobody takes an arm. Or another device with its "
            "arguments, as for rollout.",
        ),
    ] = PAGE,
    cell: CellName = None,
    command: Annotated[
        bool,
        typer.Option("--command", help="With --cell: let the page command both arms. It only watches without."),
    ] = False,
    unattended: Annotated[
        bool,
        typer.Option("--unattended", help="With a cell: let its arms move while no page is open, too."),
    ] = False,
    arm: OneArm = None,
    power: PowerOn = False,
    no_browser: NoBrowser = False,
    port: Port = PORT,
    cameras: Cameras = "front",
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after this time.")] = None,
    seed: Seed = 0,
    settings: Settings = None,
    randomization: Randomization = None,
    perturbed: Perturbed = False,
) -> None:
    """Watch and lead both arms in a page on this machine: in 3D, with plots, handles, and a button that stops both."""
    from dual_ur10.policies.operators.catalog import device_class
    from dual_ur10.policies.operators.page import open_page

    if operator.startswith(f"{PAGE}:"):
        raise SettingsError(f"--operator {operator}: the page of live takes --port and --cameras instead")
    if operator not in (PAGE, NOBODY):
        device_class(operator)  # an unknown name is refused before a page is started
    if command and cell is None:
        raise SettingsError("--command is for two controllers: name their cell file with --cell")
    watches = cell is not None and str(cell) not in ("echo", VIRTUAL) and not command
    if watches and (policy is not None or power):
        raise SettingsError("--policy and --power-on command the arms of a cell: add --command, or leave them out")
    if unattended and (watches or cell is None):
        raise SettingsError("--unattended is for a page that commands a cell: add --command, or leave it out")
    check_extras(PAGE_EXTRA, cell=cell, devices=[operator], moves=not watches)
    keywords = keywords_on(cell, env_id_of(env), settings, perturbed, arm)
    randomize(keywords, randomization)
    setup = setup_for(env, policy, keywords)
    buttons = () if watches else buttons_of(setup, takes=policy is not None and operator != NOBODY)
    policies = () if policy is None or setup.config.controllers else policies_of(env, [policy])
    handles = operator == PAGE and not watches
    page = open_page(
        setup, buttons, port=port, cameras=cameras, handles=handles, policies=policies, unattended=unattended
    )
    try:
        if watches:
            _watch(setup, page, seconds, browser=not no_browser)
        else:
            if power:
                power_on(cell)
            acting, browser = policies or (policy,), not no_browser
            lead(env, acting, operator, keywords, page, seed, seconds, browser=browser, unattended=unattended)
    except KeyboardInterrupt:
        if cell is None or watches:
            console.print("closed")
            return
        errors.print(f"interrupted: {STOP_COMMANDED}", highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        page.close()


def tell(page: LivePage, *, browser: bool) -> None:
    """Print the address of a page once it is ready, and open it in a browser if that is wanted and there is one."""
    console.print(f"the page is at {page.wait_until_ready()}", soft_wrap=True, highlight=False, markup=False)
    console.print("Whoever has this address may press its buttons. Ctrl-C ends it", style="dim")
    if browser:
        _open(page.url)


def _watch(setup: EnvSetup, page: LivePage, seconds: float | None, *, browser: bool) -> None:
    from dual_ur10.cli.status_view import StatusView
    from dual_ur10.cli.watch_session import WatchSession
    from dual_ur10.sim2real.cell_file.cell_file import CellFile
    from ur_core.kinematics.ur10 import ARMS
    from ur_core.processes.system import LOCAL

    file = setup.config.file
    if not isinstance(file, CellFile):
        raise SettingsError("--cell names no cell file: the page watches two controllers")
    with contextlib.ExitStack() as stack:
        arms = [
            stack.enter_context(StatusView(name, each, system=LOCAL))
            for name, each in zip(ARMS, file.arms, strict=True)
        ]
        tell(page, browser=browser)
        words = {"arms": f"{file.kind} cell, watched only", "cell": str(file.source)}
        WatchSession(arms, page, words).run(seconds)


def lead(
    env: str,
    policies: Sequence[str | None],
    operator: str,
    keywords: dict[str, Any],
    page: LivePage,
    seed: int,
    seconds: float | None,
    *,
    browser: bool,
    unattended: bool = False,
) -> None:
    """Step an environment and show it in a page, until the time is over, or Ctrl-C.

    Args:
        env: Id of the environment, or its short form.
        policies: Names of the policies between which the page switches; the first one acts. None: no policy.
        operator: Device of an operator; `NOBODY`: nobody takes an arm.
        keywords: Keywords of the environment.
        page: The page.
        seed: Seed of the first episode.
        seconds: Time after which it ends; None: never.
        browser: Open the page in a browser, if there is one.
        unattended: Arms of controllers do not wait until a page is open.

    Raises:
        DualUR10Error: A name or a value is not legal, or a device cannot be opened; see also `LiveSession.run`.
    """
    from dual_ur10.policies.operators.catalog import operator_with
    from dual_ur10.policies.operators.session import LiveSession

    first, *_ = policies
    device: Any = None
    mapping: Any = None

    def acting(name: str) -> tuple[Any, Any, Operator | None]:
        made, actor = make(env, name, keywords, seed)
        return made, actor, None if device is None else operator_with(device, made.unwrapped.core.setup, mapping)

    made, actor = make(env, first or "zero", keywords, seed)
    person = session = None
    try:
        setup = made.unwrapped.core.setup
        device, mapping = _device(operator, setup, page)
        person = None if device is None else operator_with(device, setup, mapping)
        names = [each for each in policies if each is not None]
        session = LiveSession(made, actor if first else None, person, page, seed, names, acting, _alarm)
        tell(page, browser=browser)
        if setup.config.controllers and not unattended:
            console.print(
                f"Both arms wait until it is open, and stop {UNATTENDED_S:g} s after it is closed", style="dim"
            )
            page.wait_until_open()
        session.run(seconds)
    finally:
        close(session.shown if session else made, session.operator if session else person)


def _alarm(text: str) -> None:
    errors.print(f"[bold red]error:[/] [red]{escape(text)}[/]", soft_wrap=True, highlight=False)


def _device(text: str, setup: EnvSetup, page: LivePage) -> tuple[Any, Any]:
    """Return the device of an operator and its mapping, or None for what there is none of."""
    from dual_ur10.policies.operators.catalog import make_device
    from dual_ur10.policies.operators.page import PageDevice

    if text == NOBODY:
        return None, None
    return (PageDevice(page), None) if text == PAGE else make_device(text, setup)


def _open(url: str) -> None:
    """Open a page in a browser with a window, if there is one: one in the terminal would hide what is printed there."""
    import webbrowser

    from ur_core.viewing.viewer import has_display

    with contextlib.suppress(webbrowser.Error):
        if has_display() and type(browser := webbrowser.get()) is not webbrowser.GenericBrowser:
            browser.open(url)


def setup_for(env: str, policy: str | None, keywords: dict[str, Any]) -> EnvSetup:
    """Return the environment in which a policy acts.

    Raises:
        DualUR10Error: A name or a value is not legal, or a checkpoint cannot be read.
    """
    from dual_ur10.envs.core.setup import EnvSetup

    env_id = env_id_of(env)
    if policy is not None:
        keywords = keywords_for(policy, env_id, keywords)
    with wrong_types_named(env_id):
        return EnvSetup.resolve(env_id, keywords)


def policies_of(env: str, given: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the policies between which a page switches: those given, then those of the environment.

    Raises:
        UnknownNameError: There is no such policy or environment.
        SettingsError: There are too many.
    """
    from dual_ur10.envs.rendering.live.buttons import POLICIES

    for each in given:
        check_name(each)
    names = tuple(dict.fromkeys((*given, *names_for(env), *BASELINES)))
    if len(names) > len(POLICIES):
        raise SettingsError(f"a page switches between at most {len(POLICIES)} policies, not {len(names)}: name fewer")
    return names


def buttons_of(setup: EnvSetup, *, takes: bool = False, stops: bool = True) -> tuple[str, ...]:
    """Return the names of the buttons of a page that commands.

    Args:
        setup: The environment.
        takes: There are a policy and an operator who may take arms from it.
        stops: With the one that stops both arms.
    """
    from dual_ur10.envs.rendering.live.buttons import SPEEDS, TAKES

    buttons: tuple[str, ...] = (*(("stop",) if stops else ()), "reset", "next_seed")
    if not setup.config.controllers:
        buttons += ("pause", "step", *SPEEDS)
    if setup.options.record is not None:
        buttons += ("record", "success", "discard")
    return (*buttons, *TAKES) if takes else buttons
