"""The command `collect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dual_ur10.cli.options import EnvName, PolicyName, Randomization, Settings, console, keywords_of, randomize
from dual_ur10.ids import env_id_of


def collect(
    env: EnvName,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 100,
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", metavar="ID", help="Minari's dataset id, such as ur10/carry/mine-v0."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode.")] = 100_000,
    envs: Annotated[int, typer.Option("--envs", min=1, help="Number of cells stepped together.")] = 16,
    randomization: Randomization = None,
    settings: Settings = None,
    author: Annotated[str | None, typer.Option("--author", help="Kept in the dataset.")] = None,
    email: Annotated[str | None, typer.Option("--author-email", help="Kept in the dataset.")] = None,
    code: Annotated[str | None, typer.Option("--code-permalink", help="Kept in the dataset.")] = None,
) -> None:
    """Run a policy and write a Minari dataset of its episodes, with one key per agent."""
    from dual_ur10.policies.training.dataset import collect as run

    env_id, keywords = env_id_of(env), keywords_of(settings, False)
    randomize(keywords, randomization)
    name = dataset or f"dual-ur10/{env_id.split('/')[1].rsplit('-v', 1)[0].lower()}/{Path(policy).name}-v0"
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as shown:
        bar = shown.add_task("running", total=episodes)
        well = 0

        def show(done: int, successes: int) -> None:
            nonlocal well
            well = successes
            shown.update(bar, completed=done, description=f"{successes} of {done} successful")

        made = run(
            env_id,
            name,
            policy=policy,
            episodes=episodes,
            seed=seed,
            envs=envs,
            env_kwargs=keywords,
            author=author,
            author_email=email,
            code_permalink=code,
            on_progress=show,
        )
    console.print(
        f"{escape(name)}: {made.total_episodes} episodes, {well} of them successful, {made.total_steps} steps; "
        f"minari.load_dataset({escape(repr(name))})",
        highlight=False,
        soft_wrap=True,
    )
