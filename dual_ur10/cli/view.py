"""The command `view`."""

from __future__ import annotations

from typing import Annotated

import typer

from dual_ur10.cli.live import NOBODY, PAGE_EXTRA, Cameras, NoBrowser, Port, buttons_of, lead, policies_of, setup_for
from dual_ur10.cli.options import (
    POLICIES,
    EnvName,
    Perturbed,
    Randomization,
    Seed,
    Settings,
    check_extras,
    console,
    keywords_of,
    randomize,
)
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.errors import SettingsError


def view(
    env: EnvName,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            "--policy",
            "-p",
            help=f"{POLICIES} May be repeated: the "
            "page switches between them and those of the environment. Default: scripted.",
        ),
    ] = None,
    no_browser: NoBrowser = False,
    port: Port = PORT,
    cameras: Cameras = "front",
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after this time.")] = None,
    seed: Seed = 0,
    settings: Settings = None,
    randomization: Randomization = None,
    perturbed: Perturbed = False,
) -> None:
    """Watch policies in a browser on this machine: pause, step, slow down, switch between them. Simulation only."""
    from dual_ur10.policies.operators.page import open_page

    check_extras(PAGE_EXTRA)
    keywords = keywords_of(settings, perturbed)
    randomize(keywords, randomization)
    policies = policies_of(env, policy or ["scripted"])
    setup = setup_for(env, policies[0], keywords)
    if setup.config.controllers:
        raise SettingsError("view is for simulation: `live --cell` shows two controllers")
    page = open_page(
        setup, buttons_of(setup, stops=False), port=port, cameras=cameras, handles=False, policies=policies
    )
    try:
        lead(env, policies, NOBODY, keywords, page, seed, seconds, browser=not no_browser)
    except KeyboardInterrupt:
        console.print("closed")
    finally:
        page.close()
