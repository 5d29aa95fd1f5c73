"""The commands `train` and `collect`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dual_ur10.cli.options import EnvName, PolicyName, Settings, console, keywords_of, randomize
from dual_ur10.errors import SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.policies.training import progress as told

_SAID_S = 30.0  # between lines where there is no terminal to draw a bar in

_OPTIONS = {"env": "ENV", "settings": "--set", "change": "--setting"}
"""What parameters are called on the command line that are not called so here."""

Envs = Annotated[int | None, typer.Option("--envs", min=1, help="Cells that are stepped together.")]
Random = Annotated[
    str | None, typer.Option("--randomization", metavar="PRESET", help="What differs from episode to episode.")
]


def train(
    context: typer.Context,
    env: Annotated[
        str | None,
        typer.Argument(metavar="ENV", help="An id, such as DualUR10/SineTracking-v0; SineTracking will do."),
    ] = None,
    algo: Annotated[str, typer.Option("--algo", "-a", help="ppo, sac, bc or dagger.")] = "dagger",
    agents: Annotated[
        str, typer.Option("--agents", help="joint: one network; shared: one for each arm, the same; independent: two.")
    ] = "joint",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to be made.")] = None,
    envs: Envs = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Of the environment, in all.")] = None,
    randomization: Random = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Of everything that is drawn.")] = 0,
    settings: Settings = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--setting", metavar="KEY=VALUE", help="A setting of the algorithm. May be repeated."),
    ] = None,
    dataset: Annotated[
        str, typer.Option("--dataset", metavar="ID", help="bc, dagger: a Minari dataset to begin with.")
    ] = "",
    init: Annotated[str, typer.Option("--init", metavar="FOLDER", help="A checkpoint to begin with.")] = "",
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="FOLDER", help="Go on with the training in this folder.")
    ] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Threads that cells are stepped on.")] = None,
) -> None:
    """Train a policy. It learns from the scripted one (dagger, bc) or by trial (ppo, sac), and becomes a checkpoint."""
    from dual_ur10.policies.training import train as trainings

    common: dict[str, Any] = {"threads": threads}
    if resume is not None:
        given = [each for each in context.params if _is_given(context, each)]
        others = sorted(_OPTIONS.get(each, f"--{each}") for each in given if each not in ("resume", "steps", "threads"))
        if others:
            raise SettingsError(
                f"--resume goes on with what was asked, which is kept in its folder: leave out {', '.join(others)}. "
                "Only --steps and --threads can be others"
            )
        run: Callable[..., Path] = trainings.resume
        arguments: dict[str, Any] = {"out": resume, "steps": steps, **common}
        where = resume
    else:
        if env is None:
            raise SettingsError("name an environment, such as SineTracking, or a folder to go on with: --resume FOLDER")
        from dual_ur10.policies.training.settings import defaults

        asked = defaults(
            env_id_of(env),
            algo,
            agents,
            envs=envs,
            steps=steps,
            seed=seed,
            randomization=randomization,
            keywords=keywords_of(settings, False),
            changes=_changes(change),
            dataset=dataset,
            init=init,
        )
        where = out or Path("trainings") / f"{asked.env_id.split('/')[1]}-{algo}-{agents}-{seed}"
        run = trainings.train
        arguments = {"training": asked, "out": where, **common}
    console.print(f"training in {where}", highlight=False, soft_wrap=True, markup=False)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as shown:
            bar = shown.add_task("beginning", total=None)

            said_s = time.monotonic()

            def show(progress: told.Progress) -> None:
                nonlocal said_s
                shown.update(bar, description=_text(progress), completed=progress.steps, total=progress.total)
                if not console.is_terminal and time.monotonic() - said_s > _SAID_S:
                    said_s = time.monotonic()
                    console.print(
                        f"{progress.steps} of {progress.total}, {_text(progress)}", highlight=False, soft_wrap=True
                    )

            made = run(**arguments, on_progress=show)
    except KeyboardInterrupt:
        console.print(
            f"interrupted; go on with: dual-ur10 train --resume {where}", highlight=False, soft_wrap=True, markup=False
        )
        raise typer.Exit(INTERRUPTED) from None
    from dual_ur10.policies.learned.checkpoint import read_manifest

    manifest = read_manifest(made)
    found: Any = manifest.evaluation or {}
    if found:
        low, high = found["success_interval"]
        console.print(
            f"success {found['successes']} of {found['episodes']} "
            f"(95 % interval {100 * low:.1f} to {100 * high:.1f} %), return {found['mean_return']:.2f}",
            highlight=False,
        )
    console.print(f"policy  {made}", highlight=False, soft_wrap=True, markup=False)
    console.print(f"sha256  {manifest.weights_sha256}", highlight=False, soft_wrap=True)


def collect(
    env: EnvName,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 100,
    dataset: Annotated[
        str | None, typer.Option("--dataset", metavar="ID", help="Minari's name of it, such as ur10/carry/mine-v0.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Of the first episode.")] = 100_000,
    envs: Annotated[int, typer.Option("--envs", min=1, help="Cells that are stepped together.")] = 16,
    randomization: Random = None,
    settings: Settings = None,
    author: Annotated[str | None, typer.Option("--author", help="Kept in the dataset.")] = None,
    email: Annotated[str | None, typer.Option("--author-email", help="Kept in the dataset.")] = None,
    code: Annotated[str | None, typer.Option("--code-permalink", help="Kept in the dataset.")] = None,
) -> None:
    """Run a policy and make a Minari dataset of its episodes, with one key per agent."""
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
            shown.update(bar, completed=done, description=f"{successes} of {done} well")

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
        f"{escape(name)}: {made.total_episodes} episodes, {well} of them well, {made.total_steps} steps; "
        f"minari.load_dataset({escape(repr(name))})",
        highlight=False,
        soft_wrap=True,
    )


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _changes(texts: list[str] | None) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in keywords_of(texts, False).items()}


def _text(progress: told.Progress) -> str:
    parts = [progress.doing]
    if progress.rate:
        parts.append(f"{progress.rate:.0f} steps/s")
    if progress.mean_return is not None:
        parts.append(f"return {progress.mean_return:.1f}")
    if progress.success_rate is not None:
        parts.append(f"success {100 * progress.success_rate:.0f} %")
    if progress.seconds_left is not None:
        parts.append(f"{progress.seconds_left / 60:.0f} min left")
    return ", ".join(parts)
