"""The command `live`."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dual_ur10.cli.options import (
    STOP_COMMANDED,
    CellFileName,
    EnvName,
    OneArm,
    Perturbed,
    PowerOn,
    Seed,
    Settings,
    close,
    console,
    errors,
    keywords_of,
    make,
    power_on,
)
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.envs.core.setup import EnvSetup
    from dual_ur10.envs.rendering.live.live_page import LivePage
    from dual_ur10.policies.operators.operator import Operator

PAGE = "page"
NOBODY = "none"


def live(
    env: EnvName,
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="scripted, learned, random or zero; the folder of a checkpoint; or module:Class. Without it, the "
            "operator alone leads both arms.",
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
    cell: CellFileName = None,
    command: Annotated[
        bool,
        typer.Option("--command", help="With --cell: let the page command both arms. It only watches without."),
    ] = False,
    arm: OneArm = None,
    power: PowerOn = False,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the loopback interface; 0: any free one.")
    ] = PORT,
    cameras: Annotated[
        str, typer.Option("--cameras", help="Cameras of the scene whose images are shown, with commas; or none.")
    ] = "front",
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after this time.")] = None,
    seed: Seed = 0,
    settings: Settings = None,
    perturbed: Perturbed = False,
) -> None:
    """Watch and lead both arms in a page on this machine: in 3D, with plots, handles, and a button that stops both."""
    from dual_ur10.envs.core.setup import EnvSetup
    from dual_ur10.policies.operators.catalog import device_class
    from dual_ur10.policies.operators.page import open_page

    if operator.startswith(f"{PAGE}:"):
        raise SettingsError(f"--operator {operator}: the page of live takes --port and --cameras instead")
    if operator not in (PAGE, NOBODY):
        device_class(operator)  # an unknown name is refused before a page is started
    if command and cell is None:
        raise SettingsError("--command is for two controllers: name their cell file with --cell")
    watches = cell is not None and str(cell) != "echo" and not command
    if watches and (policy is not None or power):
        raise SettingsError("--policy and --power-on command the arms of a cell: add --command, or leave them out")
    keywords = keywords_of(settings, perturbed, cell, arm)
    setup = EnvSetup.resolve(env, keywords)
    buttons = () if watches else _buttons(setup, takes=policy is not None and operator != NOBODY)
    page = open_page(setup, buttons, port=port, cameras=cameras, handles=operator == PAGE and not watches)
    try:
        if watches:
            _watch(setup, page, seconds)
        else:
            if power:
                power_on(cell)
            _lead(env, policy, operator, keywords, page, seed, seconds)
    except KeyboardInterrupt:
        if cell is None or watches:
            console.print("closed")
            return
        errors.print(f"interrupted: {STOP_COMMANDED}", highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        page.close()


def _tell(page: LivePage) -> None:
    """Print the address of a page that is ready."""
    console.print(f"the page is at {page.wait_until_ready()}", soft_wrap=True, highlight=False, markup=False)
    console.print("Whoever has this address may press its buttons. Ctrl-C ends it", style="dim")


def _watch(setup: EnvSetup, page: LivePage, seconds: float | None) -> None:
    from dual_ur10.cli.live_session import WatchSession
    from dual_ur10.cli.status_view import StatusView
    from dual_ur10.kinematics.ur10 import ARMS
    from dual_ur10.sim2real.config.cell_file import CellFile
    from dual_ur10.sim2real.processes.system import LOCAL

    file = setup.config.file
    if not isinstance(file, CellFile):
        raise SettingsError("--cell names no cell file: the page watches two controllers")
    with contextlib.ExitStack() as stack:
        arms = [
            stack.enter_context(StatusView(name, each, system=LOCAL))
            for name, each in zip(ARMS, file.arms, strict=True)
        ]
        _tell(page)
        words = {"arms": f"{file.kind} cell, watched only", "cell": str(file.source)}
        WatchSession(arms, page, words).run(seconds)


def _lead(
    env: str,
    policy: str | None,
    operator: str,
    keywords: dict[str, Any],
    page: LivePage,
    seed: int,
    seconds: float | None,
) -> None:
    from dual_ur10.cli.live_session import LiveSession

    made, actor = make(env, policy or "zero", keywords, seed)
    person = None
    try:
        person = _operator(operator, made.unwrapped.core.setup, page)
        session = LiveSession(made, actor if policy else None, person, page, seed)
        session.shown.words["policy"] = policy or "none: the operator leads"
        _tell(page)
        session.run(seconds)
    finally:
        close(made, person)


def _operator(text: str, setup: EnvSetup, page: LivePage) -> Operator | None:
    from dual_ur10.policies.operators.catalog import make_device, operator_with
    from dual_ur10.policies.operators.page import PageDevice

    if text == NOBODY:
        return None
    device, mapping = (PageDevice(page), None) if text == PAGE else make_device(text, setup)
    return operator_with(device, setup, mapping)


def _buttons(setup: EnvSetup, *, takes: bool) -> tuple[str, ...]:
    """Return the names of the buttons of a page that commands.

    Args:
        setup: The environment.
        takes: There are a policy and an operator who may take arms from it.
    """
    from dual_ur10.envs.rendering.live.memory import TAKES

    buttons: tuple[str, ...] = ("stop", "reset", "next_seed")
    if not setup.config.controllers:
        buttons += ("pause", "step")
    if setup.options.record is not None:
        buttons += ("record", "success", "discard")
    return (*buttons, *TAKES) if takes else buttons
