"""The command `evaluate`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dual_ur10.cli.options import (
    RUNS,
    CellName,
    MinSuccess,
    NoRecord,
    OneArm,
    OperatorName,
    Perturbed,
    PolicyName,
    PowerOn,
    Randomization,
    Seed,
    Settings,
    check_extras,
    console,
    progress_of,
    randomize,
)
from dual_ur10.cli.session import (
    STOP_COMMANDED,
    asks,
    check_leader,
    check_min_success,
    conclude,
    keywords_on,
    late_text,
    make_operator,
    power_on,
)
from dual_ur10.errors import SettingsError
from dual_ur10.ids import TASKS, env_id_of
from dual_ur10.policies.registry import NAMES, names_for
from ur_core.files import check_target
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.policies.evaluation.failures import FailureKeeper
    from dual_ur10.policies.evaluation.results import Evaluation
    from dual_ur10.policies.policy import Policy


ALL = "all"
"""Name of all tasks that have the policy."""


def evaluate(
    env: Annotated[
        list[str],
        typer.Argument(
            metavar="ENV...",
            help="Ids, such as DualUR10/SineTracking-v0, or their short forms, such as SineTracking; `list` names all. "
            "Or all: those with a script, or with the learned policy that is named.",
        ),
    ],
    policy: PolicyName = "scripted",
    operator: OperatorName = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", help="Number of episodes.")] = 300,
    seed: Seed = 0,
    envs: Annotated[int, typer.Option("--envs", help="Episodes that run at a time; no result depends on it.")] = 8,
    min_success: MinSuccess = None,
    json: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Write all results to this file: of several tasks a list."),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write a row per episode to this file.")
    ] = None,
    failures: Annotated[
        Path | None,
        typer.Option(
            "--failures",
            metavar="FOLDER",
            help="Write videos of failed episodes into this folder, of at most ten of each task.",
        ),
    ] = None,
    settings: Settings = None,
    randomization: Randomization = None,
    perturbed: Perturbed = False,
    cell: CellName = None,
    arm: OneArm = None,
    power: PowerOn = False,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            metavar="FOLDER",
            help="Record the run, in a new folder inside this one. Default: runs with --cell, none in simulation. "
            "Episodes that are recorded run one at a time.",
        ),
    ] = None,
    no_record: NoRecord = False,
) -> None:
    """Run many episodes of a policy or of an operator, and print its success rate and further figures.

    With --cell, both arms move to the start of every episode; real ones after your yes to each of these motions.
    """
    from dual_ur10.envs.rendering.video_file import check_video
    from dual_ur10.policies.evaluation.failures import FailureKeeper
    from dual_ur10.policies.evaluation.results import write_evaluations

    env_ids = _env_ids(env, policy)
    several = len(env_ids) > 1
    if several and (cell is not None or csv is not None):
        raise SettingsError(
            f"{'--cell' if cell is not None else '--csv'} is for one task, found {', '.join(env_ids)}: run the command "
            "once for each"
        )
    keywords = keywords_on(cell, env_ids[0], settings, perturbed, arm)
    randomize(keywords, randomization)
    if no_record and record is not None:
        raise SettingsError("--record and --no-record do not go together: leave one out")
    if not no_record and (record is not None or cell is not None):
        keywords.setdefault("record", str(record or RUNS))
    check_leader(policy, operator)
    if operator is not None and operator.partition(":")[0] == "page":
        raise SettingsError("evaluate shows no page: use rollout, view or live with --operator page")
    alone = cell is not None or "record" in keywords or operator is not None
    envs = 1 if alone else envs
    check_min_success(min_success)
    check_extras(cell=cell, devices=[operator])
    targets = [path for path in (json, csv) if path is not None]
    if len({check_target(path) for path in targets}) < len(targets):
        raise SettingsError(f"--json and --csv both name {json}")
    if failures is not None:
        if cell is not None:
            raise SettingsError("--failures is for simulation: on two controllers the record has what happened")
        try:
            failures.mkdir(exist_ok=True)
        except OSError as error:
            raise SettingsError(f"the folder {failures} cannot be made: {error}. Name another one") from error
        check_video(failures / "x.mp4")
    if power:
        power_on(cell)
    results: list[Evaluation] = []
    for env_id in env_ids:
        kept = None if failures is None else FailureKeeper()
        arguments = {"seed": seed, "num_envs": envs, "env_kwargs": dict(keywords), "on_episode": kept}
        if operator is None:
            found = _run(env_id, policy, episodes, cell, **arguments)
        else:
            with contextlib.closing(make_operator(operator, env_id, keywords)) as person:
                found = _run(env_id, person, episodes, cell, **arguments)
        console.print(found.as_table())
        results.append(found)
        if json is not None:  # after each task: a later one may fail
            write_evaluations(json, results) if several else found.to_json(json)
        if csv is not None:
            found.to_csv(csv)
        if kept is not None and failures is not None:
            _film(kept, failures, found)
    for name, path in (("json", json), ("csv", csv)):
        if path is not None:
            console.print(f"{name:4}  {path}", soft_wrap=True, highlight=False, markup=False)
    worst = min(results, key=lambda each: each.success_rate)
    task = f"{worst.env_id}: " if several else ""
    conclude(worst.successes, episodes, worst.late_actions, min_success, task)


def _env_ids(names: list[str], policy: str) -> list[str]:
    """Return the ids of environments, each once.

    Raises:
        UnknownNameError: There is no such environment.
        SettingsError: One is named twice, or "all" beside others.
    """
    if names == [ALL]:
        wanted = policy if policy in NAMES else "scripted"
        return [each for each in TASKS if wanted in names_for(each)]
    found = [env_id_of(each) for each in names]
    twice = [each for each in found if found.count(each) > 1]
    if twice:
        raise SettingsError(f"{twice[0]} is named twice: name each environment once")
    return found


def _film(kept: FailureKeeper, folder: Path, found: Evaluation) -> None:
    """Write and list the videos of failed episodes."""
    with progress_of(console) as progress:
        bar = progress.add_task("drawing", total=1.0)
        films = kept.film(folder, found, on_ratio=lambda ratio: progress.update(bar, completed=ratio))
    failed = len(found.episodes) - found.successes
    text = f"{len(films)} of {failed} failed episodes: {folder}" if failed else "no failed episode"
    console.print(f"video  {text}", soft_wrap=True, highlight=False, markup=False)


def _run(env_id: str, policy: Policy | str, episodes: int, cell: Path | None, **arguments: Any) -> Evaluation:
    """Return the evaluation, with its progress shown.

    Args:
        env_id: Id of the environment.
        policy: Name of the policy, or an operator.
        episodes: Number of episodes.
        cell: Value of --cell: whoever names one asks for the motions to each start.
        **arguments: Further arguments of `dual_ur10.policies.evaluation.evaluate.evaluate`.

    Raises:
        typer.Exit: It was interrupted.
    """
    from dual_ur10.policies.evaluation.evaluate import evaluate as run

    found: Evaluation | None = None
    moves = cell is not None
    try:
        with progress_of(console, asks(cell)) as progress:
            bar = progress.add_task("running", total=episodes)

            def show(so_far: Evaluation) -> None:
                nonlocal found
                found = so_far
                text = f"success {100 * so_far.success_rate:.1f} %"
                progress.update(bar, description=text)
                if asks(cell):  # no bar is shown
                    done = f"{len(so_far.episodes)} of {episodes} episodes, {text}{late_text(so_far.late_actions)}"
                    console.print(done, highlight=False)

            return run(
                env_id,
                policy,
                episodes=episodes,
                move_to_start=moves,
                on_progress=show,
                on_step=lambda done: progress.update(bar, completed=done),
                **arguments,
            )
    except KeyboardInterrupt:
        if found is not None:
            console.print(found.as_table())
        done = 0 if found is None else len(found.episodes)
        arms = f"; {STOP_COMMANDED}" if moves else ""
        text = f"interrupted after {done} of {episodes} episodes, whose result was not written{arms}"
        console.print(text, highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
