"""The command `evaluate`: how often a policy succeeds, and how well."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dual_ur10.cli.options import (
    RUNS,
    TOLD_TO_REST,
    CellFileName,
    EnvName,
    NoRecord,
    OneArm,
    Perturbed,
    PolicyName,
    PowerOn,
    Seed,
    Settings,
    console,
    errors,
    keywords_of,
    late_text,
    power_on,
    progress_of,
    randomize,
)
from dual_ur10.errors import SettingsError
from dual_ur10.files import check_target
from dual_ur10.ids import env_id_of
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.policies.evaluation.results import Evaluation

BELOW = 1
"""Exit code when fewer episodes succeed than wanted."""


def evaluate(
    env: EnvName,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option("--episodes", "-n", help="Number of episodes.")] = 300,
    seed: Seed = 0,
    envs: Annotated[int, typer.Option("--envs", help="Episodes that run at a time. No result depends on it.")] = 8,
    min_success: Annotated[
        float | None,
        typer.Option("--min-success", metavar="RATE", help="Exit with code 1 if fewer succeed, such as 0.95."),
    ] = None,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything to a file.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write a row per episode.")] = None,
    settings: Settings = None,
    randomization: Annotated[
        str | None,
        typer.Option("--randomization", metavar="PRESET", help="What differs from episode to episode."),
    ] = None,
    perturbed: Perturbed = False,
    cell: CellFileName = None,
    arm: OneArm = None,
    power: PowerOn = False,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            metavar="FOLDER",
            help="A folder with the record of this run is made in it: with --cell in runs/ if nothing is said, in "
            "simulation only if it is, and then one episode runs at a time.",
        ),
    ] = None,
    no_record: NoRecord = False,
) -> None:
    """Run many episodes of a policy, and print how often and how well it succeeds."""
    from dual_ur10.policies.evaluation.evaluate import evaluate as run

    env_id, keywords = env_id_of(env), keywords_of(settings, perturbed, cell, arm)
    randomize(keywords, randomization)
    if no_record and record is not None:
        raise SettingsError("--record and --no-record do not go together: leave one out")
    if not no_record and (record is not None or cell is not None):
        keywords.setdefault("record", str(record or RUNS))
    envs = envs if cell is None and "record" not in keywords else 1
    if min_success is not None and not 0.0 <= min_success <= 1.0:
        raise SettingsError(f"--min-success is {min_success:g}: it must be a share from 0 to 1, such as 0.95")
    targets = [path for path in (json, csv) if path is not None]
    if len({check_target(path) for path in targets}) < len(targets):
        raise SettingsError(f"--json and --csv both name {json}")
    if power:
        power_on(cell)
    found: Evaluation | None = None
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    try:
        with progress_of(console, cell, *columns) as progress:
            bar = progress.add_task("running", total=episodes)

            def show(so_far: Evaluation) -> None:
                nonlocal found
                found = so_far
                text = f"success {100 * so_far.success_rate:.1f} %"
                progress.update(bar, description=text, completed=len(so_far.episodes))
                if cell is not None:  # there is no bar
                    done = f"{len(so_far.episodes)} of {episodes} episodes, {text}{late_text(so_far.late_actions)}"
                    console.print(done, highlight=False)

            found = run(
                env_id, policy, episodes=episodes, seed=seed, num_envs=envs, env_kwargs=keywords, on_progress=show
            )
    except KeyboardInterrupt:
        if found is not None:
            console.print(found.as_table())
        done = 0 if found is None else len(found.episodes)
        arms = "" if cell is None else f"; {TOLD_TO_REST}"
        console.print(f"interrupted after {done} of {episodes} episodes; no result was written{arms}", highlight=False)
        raise typer.Exit(INTERRUPTED) from None
    console.print(found.as_table())
    if json is not None:
        found.to_json(json)
        console.print(f"json  {json}", soft_wrap=True, highlight=False, markup=False)
    if csv is not None:
        found.to_csv(csv)
        console.print(f"csv   {csv}", soft_wrap=True, highlight=False, markup=False)
    if min_success is not None and found.success_rate < min_success:
        errors.print(
            f"[bold red]too few successes:[/] [red]{found.successes} of {episodes} are a rate of "
            f"{found.success_rate:.4g}, wanted {min_success:g} or more[/]",
            soft_wrap=True,
            highlight=False,
        )
        raise typer.Exit(BELOW)
