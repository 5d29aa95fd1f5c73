"""The command `train`."""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dual_ur10.cli.collect import TAKES_KEYS, Kept
from dual_ur10.cli.options import (
    Randomization,
    Settings,
    check_extras,
    console,
    keywords_of,
    progress_of,
)
from dual_ur10.cli.session import make_operator, shown
from dual_ur10.errors import SettingsError
from dual_ur10.ids import env_id_of
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from rich.progress import Progress

    from dual_ur10.policies.training import progress as reporting
    from dual_ur10.policies.training.corrections import Person
    from dual_ur10.policies.training.settings import Training

_REPORT_S = 30.0  # between lines where no terminal can draw a bar


_OPTIONS = {"env": "ENV", "settings": "--set", "change": "--hyperparameter"}
"""Names on the command line of the parameters that have another name here."""


_Agents = Annotated[
    str | None,
    typer.Option(
        "--agents",
        help="joint: one network; shared: the same one for each arm; independent: two. Default: joint; of ppo and sac "
        "without --init: shared.",
    ),
]

_Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--hyperparameter",
        metavar="KEY=VALUE",
        help="A hyperparameter of the algorithm, such as gamma=0.99. May be repeated. An unknown one is "
        "answered with all of them.",
    ),
]
_Corrector = Annotated[
    str,
    typer.Option(
        "--operator",
        metavar="DEVICE",
        help="dagger: a person takes over with this device, named as in `rollout`, where the policy of --init or "
        "--dataset errs; the person's steps are the labels.",
    ),
]
_Dataset = Annotated[
    str, typer.Option("--dataset", metavar="ID", help="bc, dagger, act: a Minari dataset to start from.")
]


def train(
    context: typer.Context,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="ENV",
            help="An id, such as DualUR10/SineTracking-v0, or its short form SineTracking; `list` names all.",
        ),
    ] = None,
    algo: Annotated[str, typer.Option("--algo", "-a", help="ppo, sac, bc, dagger or act.")] = "dagger",
    agents: _Agents = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to create.")] = None,
    envs: Annotated[int | None, typer.Option("--envs", min=1, help="Number of cells stepped together.")] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Total number of environment steps.")] = None,
    randomization: Randomization = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of all random numbers.")] = 0,
    settings: Settings = None,
    change: _Changes = None,
    dataset: _Dataset = "",
    init: Annotated[str, typer.Option("--init", metavar="FOLDER", help="A checkpoint to start from.")] = "",
    operator: _Corrector = "",
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="FOLDER", help="Continue the training in this folder.")
    ] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Threads that step the cells.")] = None,
) -> None:
    """Train a policy and save it as a checkpoint, by imitation (dagger, bc, act) or reinforcement (ppo, sac)."""
    from dual_ur10.policies.training import train as trainings

    if resume is not None:
        _check_resumed(context)
        run, where = partial(trainings.resume, out=resume, steps=steps), resume
    elif env is None:
        raise SettingsError("name an environment, such as SineTracking, or a folder to continue: --resume FOLDER")
    else:
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
            operator=operator,
        )
        where = out or Path("trainings") / f"{asked.env_id.split('/')[1]}-{algo}-{asked.agents}-{seed}"
        run = partial(trainings.train, training=asked, out=where)
        extras = ("train", "training"), *([("data", "a dataset")] if dataset else [])
        check_extras(*extras, devices=[operator] if operator else [])
    try:
        with progress_of(console, left=False) as bar:
            made = run(threads=threads, on_progress=_ProgressDisplay(bar, where), meet=_meet)
    except KeyboardInterrupt:
        console.print(
            f"interrupted; continue with: dual-ur10 train --resume {where}",
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
        raise typer.Exit(INTERRUPTED) from None
    _print(made)


def _meet(training: Training) -> Person:
    """Return the person who corrects a policy, at the terminal or the page."""
    from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES
    from dual_ur10.policies.training.corrections import Person

    operator = make_operator(
        training.operator, training.env_id, training.keywords, keys=True, buttons=(*TAKES, *EPISODES)
    )
    kept = Kept(operator, TAKES_KEYS)
    return Person(
        operator,
        shown=lambda env: kept.shown_in(shown(env, operator)),
        tell=lambda text: console.print(escape(text), highlight=False),
        on_end=kept,
    )


class _ProgressDisplay:
    """Shows the progress of a training: in the bar of a terminal, or in lines.

    Args:
        bar: The bar.
        where: Folder of the training.
    """

    def __init__(self, bar: Progress, where: Path) -> None:
        self._bar, self._where = bar, where
        self._row = bar.add_task("beginning", total=None)
        self._reported_s, self._begun = -math.inf, False

    def __call__(self, progress: reporting.Progress) -> None:
        """Show it."""
        if not self._begun:  # all that was asked for has been checked
            self._begun = True
            console.print(f"training in {self._where}", highlight=False, soft_wrap=True, markup=False)
        self._bar.update(self._row, description=_text(progress), completed=progress.steps, total=progress.total)
        if progress.steps and not console.is_terminal and time.monotonic() - self._reported_s > _REPORT_S:
            self._reported_s = time.monotonic()
            console.print(f"{progress.steps} of {progress.total}, {_text(progress)}", highlight=False, soft_wrap=True)


def _print(made: Path) -> None:
    """Print results and name of a checkpoint."""
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


def _check_resumed(context: typer.Context) -> None:
    """Check that nothing is given that a resumed training keeps in its folder.

    Raises:
        SettingsError: An option is.
    """
    given = [each for each in context.params if _is_given(context, each)]
    others = sorted(_OPTIONS.get(each, f"--{each}") for each in given if each not in ("resume", "steps", "threads"))
    if others:
        raise SettingsError(
            f"--resume continues with the settings kept in its folder: leave out {', '.join(others)}. "
            "Only --steps and --threads can change"
        )


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _changes(texts: list[str] | None) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in keywords_of(texts, False).items()}


def _text(progress: reporting.Progress) -> str:
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
