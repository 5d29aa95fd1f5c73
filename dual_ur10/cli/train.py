"""Commands that make policies: `train`, `collect` for its data, and `convert` for models of others."""

from __future__ import annotations

import math
import os
import shlex
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from rich.markup import escape

from dual_ur10.cli.options import (
    RUNS,
    CellName,
    EnvName,
    OneArm,
    OperatorName,
    PolicyName,
    Randomization,
    Record,
    Settings,
    TakeoverName,
    asks,
    check_extras,
    close,
    console,
    errors,
    keywords_of,
    make,
    make_operator,
    on_virtual,
    progress_of,
    randomize,
    record_in,
    shown,
)
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError
from dual_ur10.ids import env_id_of
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from rich.progress import Progress

    from dual_ur10.policies.operators.operator import Operator
    from dual_ur10.policies.training import progress as reporting
    from dual_ur10.policies.training.corrections import Person
    from dual_ur10.policies.training.demonstrations import Demonstration
    from dual_ur10.policies.training.settings import Training

_REPORT_S = 30.0  # between lines where no terminal can draw a bar

_KEYS = "b begins an episode, return keeps it, backspace discards it, n begins it anew; Ctrl-C ends"
_OF_PAGE = "Record begins an episode, Success keeps it, Discard throws it away, Reset begins it anew; Ctrl-C ends"
_TAKES = "; 1, 2, 3 take the left arm, the right one, both, 0 hands back"

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
_Dataset = Annotated[str, typer.Option("--dataset", metavar="ID", help="bc, dagger: a Minari dataset to start from.")]


def train(
    context: typer.Context,
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="ENV",
            help="An id, such as DualUR10/SineTracking-v0, or its short form SineTracking; `list` names all.",
        ),
    ] = None,
    algo: Annotated[str, typer.Option("--algo", "-a", help="ppo, sac, bc or dagger.")] = "dagger",
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
    """Train a policy and save it as a checkpoint: by imitation (dagger, bc) or by reinforcement learning (ppo, sac)."""
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
    kept = _Kept(operator, _TAKES)
    return Person(
        operator,
        shown=lambda env: kept.shown_in(shown(env, operator)),
        tell=lambda text: console.print(escape(text), highlight=False),
        on_end=kept,
    )


class _Kept:
    """Prints the end of each demonstrated episode, and shows in the page what is kept.

    Args:
        operator: Operator, whose buttons it names.
        more: Further keys of the terminal.
    """

    def __init__(self, operator: Operator, more: str = "") -> None:
        from dual_ur10.policies.operators.page import PageDevice

        has_page = isinstance(operator.device, PageDevice)
        console.print(_OF_PAGE if has_page else f"{_KEYS}{more}", highlight=False, soft_wrap=True)
        self._count, self._total_s = 0, 0.0
        self._env: Any = None

    def shown_in(self, env: Any) -> Any:
        """Return an environment, whose page shows what is kept if it has one."""
        from dual_ur10.envs.rendering.live.shown import Shown

        self._env = env if isinstance(env, Shown) else None
        self._show()
        return env

    def _show(self) -> None:
        if self._env is not None:
            self._env.words["kept"] = f"{self._count} episodes, {self._total_s:.0f} s"
            self._env.waiting = "press Record to begin an episode"
            self._env.say()

    def __call__(self, found: Demonstration) -> None:
        """Print it."""
        if found.kept:
            self._count, self._total_s = self._count + 1, self._total_s + found.time_s
        end = "kept" if found.kept else "thrown away"
        console.print(
            f"{end} after {found.time_s:.1f} s ({escape(found.ended_by)}); {self._count} kept, {self._total_s:.0f} s"
        )
        self._show()


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


def collect(
    env: EnvName,
    policy: PolicyName = "scripted",
    operator: OperatorName = None,
    takeover: TakeoverName = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 100,
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", metavar="ID", help="Minari's dataset id, such as ur10/carry/mine-v0."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode.")] = 100_000,
    envs: Annotated[int, typer.Option("--envs", min=1, help="Number of cells stepped together.")] = 16,
    randomization: Randomization = None,
    settings: Settings = None,
    cell: CellName = None,
    arm: OneArm = None,
    record: Record = RUNS,
    author: Annotated[str | None, typer.Option("--author", help="Kept in the dataset.")] = None,
    email: Annotated[str | None, typer.Option("--author-email", help="Kept in the dataset.")] = None,
    code: Annotated[str | None, typer.Option("--code-permalink", help="Kept in the dataset.")] = None,
) -> None:
    """Run a policy and write a Minari dataset of its episodes, with one key per agent.

    With --operator or --takeover a person demonstrates, also on a --cell: the keys b, return and backspace begin, keep
    and discard an episode. What is kept is recorded at once; after Ctrl-C, and when the command is repeated after a
    crash, all of it is in the dataset.
    """
    from dual_ur10.policies.training.dataset import collect as run

    check_extras(("data", "a dataset"), cell=cell, devices=[operator, takeover])
    env_id = env_id_of(env)
    keywords = keywords_of(settings, False, on_virtual(cell, env_id), arm)
    randomize(keywords, randomization)
    source = "operator" if operator or takeover else Path(policy).name
    name = dataset or f"dual-ur10/{env_id.split('/')[1].rsplit('-v', 1)[0].lower()}/{source}-v0"
    if operator or takeover:
        about = {"author": author, "author_email": email, "code_permalink": code}
        _demonstrate(env, policy, operator, takeover, keywords, name, record, episodes, seed, about)
        return
    with progress_of(console, asks(cell)) as progress:
        bar = progress.add_task("running", total=episodes)
        well = 0

        def show(done: int, successes: int) -> None:
            nonlocal well
            well = successes
            progress.update(bar, completed=done, description=f"{successes} of {done} successful")

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


def _demonstrate(
    env: str,
    policy: str,
    operator: str | None,
    takeover: str | None,
    keywords: dict[str, Any],
    name: str,
    record: Path,
    episodes: int,
    seed: int,
    about: dict[str, str | None],
) -> None:
    """Let a person demonstrate, and write the dataset of what was kept, however it ends."""
    from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
    from dual_ur10.policies.training.dataset import check_new
    from dual_ur10.policies.training.demonstrations import demonstrate, folder_of, make_dataset

    check_new(name)
    folder = folder_of(record, name)
    leader = f"operator {operator}" if operator else f"{policy}, takeover {takeover}"
    record_in(keywords, folder, {"policy": leader})
    if "cell" not in keywords:
        keywords = {**AS_ON_CONTROLLERS, **keywords}
    made, actor = make(env, policy, keywords, seed, operator, takeover, keys=True)
    kept = _Kept(actor.operator if takeover else actor, _TAKES if takeover else "")
    interrupted = False
    try:
        demonstrate(kept.shown_in(made), actor, episodes=episodes, seed=seed, on_end=kept)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        close(made, actor)
        found = make_dataset(folder, name, **about)
        if found is None:
            errors.print("nothing was kept", highlight=False)
        else:
            console.print(
                f"{escape(name)}: {found.total_episodes} episodes, {found.total_steps} steps; "
                f"minari.load_dataset({escape(repr(name))}); records in {escape(str(folder))}",
                highlight=False,
                soft_wrap=True,
            )
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def convert(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model saved by Stable-Baselines3, a zip file.")],
    env: EnvName,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to create.")],
    trust_pickle: Annotated[
        bool,
        typer.Option("--trust-pickle", help="Run the code in these files: you trust their author."),
    ] = False,
    vec_normalize: Annotated[
        Path | None, typer.Option("--vec-normalize", metavar="FILE", help="The VecNormalize saved with the model.")
    ] = None,
    algo: Annotated[str | None, typer.Option("--algo", "-a", help="ppo or sac. Default: from the file.")] = None,
    agents: Annotated[
        str | None,
        typer.Option(
            "--agents",
            help="joint: for both arms; shared: for each arm. Default: from the file.",
        ),
    ] = None,
    settings: Settings = None,
) -> None:
    """Convert a model of Stable-Baselines3 to a checkpoint. This runs the code that the file holds."""
    from dual_ur10.policies.learned.checkpoint import check_new, save
    from dual_ur10.policies.learned.from_sb3 import Algorithm, from_sb3
    from dual_ur10.policies.learned.signature import view_of

    env_id, keywords = env_id_of(env), keywords_of(settings, False)
    if algo is not None and algo not in get_args(Algorithm):
        raise UnknownNameError("algorithm", algo, list(get_args(Algorithm)))
    view = view_of(env_id, keywords)
    sizes: dict[str, int] = {"joint": view.signature.observation.shape[0], "shared": view.layout.size}
    if agents is not None and agents not in sizes:
        raise UnknownNameError("agents", agents, list(sizes))
    check_new(out)
    trained, kind = _chosen(model, algo, agents, env_id, sizes)
    policy = from_sb3(
        model,
        env_id,
        algorithm=trained,
        agents=kind,
        vec_normalize=vec_normalize,
        trust_pickle=trust_pickle,
        **keywords,
    )
    manifest = save(out, policy.layers, policy.manifest)
    # With a "/" in it, a folder is never mistaken for the name of a policy.
    folder = out if os.sep in str(out) else f"./{out}"
    options = [word for text in settings or () for word in ("--set", text)]
    for line in (
        f"model   {model}: {trained}, {kind}",
        f"policy  {out}",
        f"sha256  {manifest.weights_sha256}",
        f"evaluate it with: dual-ur10 evaluate {shlex.join([env, '--policy', str(folder), *options])}",
    ):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def _chosen(model: Path, algo: str | None, agents: str | None, env_id: str, sizes: dict[str, int]) -> tuple[Any, Any]:
    """Return the algorithm and the agents of a model: those that are named, or those of its file.

    Raises:
        CheckpointError: The file tells no algorithm, another one, or observations of another size.
    """
    from dual_ur10.policies.learned.from_sb3 import inspect_model

    specified, size = inspect_model(model)
    if algo is None and specified is None:
        raise CheckpointError(
            f"{model} does not specify PPO or SAC, and no other can be converted: name one with --algo"
        )
    if algo is not None and specified not in (None, algo):
        raise CheckpointError(f"{model} is a model of {specified}, but --algo is {algo}: leave --algo out")
    kind = agents or next((name for name, each in sizes.items() if each == size), "joint")
    if size not in (None, sizes[kind]):
        raise CheckpointError(
            f"{model} observes {size} numbers; in {env_id} both arms together (joint) observe {sizes['joint']}, and "
            f"each of them (shared) {sizes['shared']}: name the environment, --agents and --set of its training"
        )
    return algo or specified, kind
