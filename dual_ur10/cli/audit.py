"""The command `audit`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from dual_ur10.cli.options import EnvName, Seed, Settings, console, keywords_of, progress_of
from dual_ur10.cli.session import BELOW
from dual_ur10.ids import env_id_of
from ur_core.files import check_target

_STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def audit(
    env: EnvName,
    quick: Annotated[
        bool, typer.Option("--quick", help="One seed of each behaviour, and episodes about as long as the script's.")
    ] = False,
    episodes: Annotated[int, typer.Option("--episodes", "-n", help="Number of episodes of each cheat.")] = 1,
    seed: Seed = 0,
    cheat: Annotated[
        list[str] | None,
        typer.Option(
            "--cheat", metavar="MODULE:CLASS", help="A further policy that must not succeed. May be repeated."
        ),
    ] = None,
    settings: Settings = None,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the report to this file.")] = None,
) -> None:
    """Find what makes a task unlearnable or dishonest: income without success, dead actions, cheats and more.

    The code is 1 if there is a warning or an error.
    """
    env_id = env_id_of(env)
    keywords = keywords_of(settings, False)
    if json is not None:
        check_target(json)
    from dual_ur10.policies.evaluation.audit.audit import audit as run

    with progress_of(console) as progress:
        bar = progress.add_task("auditing", total=1.0)
        found = run(
            env_id,
            cheats={each: each for each in cheat or ()},
            episodes=episodes,
            seed=seed,
            quick=quick,
            on_progress=lambda ratio: progress.update(bar, completed=ratio),
            **keywords,
        )
    for line in str(found).splitlines():
        style = _STYLES.get(line.partition(":")[0], "")
        console.print(escape(line), style=style, highlight=False, soft_wrap=True)
    if json is not None:
        found.to_json(json)
        console.print(f"json  {json}", soft_wrap=True, highlight=False, markup=False)
    if found.above("note"):
        raise typer.Exit(BELOW)
