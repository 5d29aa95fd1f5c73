"""The command `rollout`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import (
    RUNS,
    CellName,
    EnvName,
    MinSuccess,
    NoRecord,
    OneArm,
    OperatorName,
    Perturbed,
    PolicyName,
    PowerOn,
    Randomization,
    Record,
    Seed,
    Settings,
    TakeoverName,
    check_extras,
    console,
    errors,
    progress_of,
    randomize,
    record_in,
)
from dual_ur10.cli.session import asks, check_min_success, close, conclude, keywords_on, late_text, make, power_on
from dual_ur10.ids import env_id_of
from dual_ur10.policies.registry import provenance
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.policies.evaluation.rollout import Record as EpisodeRecord


def rollout(
    env: EnvName,
    policy: PolicyName = "scripted",
    operator: OperatorName = None,
    takeover: TakeoverName = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 5,
    seed: Seed = 0,
    min_success: MinSuccess = None,
    settings: Settings = None,
    randomization: Randomization = None,
    perturbed: Perturbed = False,
    cell: CellName = None,
    arm: OneArm = None,
    power: PowerOn = False,
    record: Record = RUNS,
    no_record: NoRecord = False,
) -> None:
    """Run episodes of a policy or of an operator, in MuJoCo or on two controllers, and print a row for each."""
    from dual_ur10.policies.evaluation.rollout import rollout as run_episode

    check_min_success(min_success)
    check_extras(cell=cell, devices=[operator, takeover])
    keywords = keywords_on(cell, env_id_of(env), settings, perturbed, arm)
    randomize(keywords, randomization)
    if power:
        power_on(cell)
    if not no_record:
        about = {"policy": f"operator {operator}"} if operator else provenance(policy, env_id_of(env))
        if takeover:
            about["policy"] += f", takeover {takeover}"
        record_in(keywords, record, about)
    made, actor = make(env, policy, keywords, seed, operator, takeover)
    table = Table(header_style="bold")
    returns, successes = [], 0
    late = 0
    try:
        with progress_of(console, asks(cell)) as progress:
            horizon = made.unwrapped.task.horizon
            bar = progress.add_task("running", total=horizon and episodes * horizon)

            def step(_: Any) -> None:
                progress.advance(bar)

            for episode in range(episodes):
                done = horizon and episode * horizon
                progress.update(bar, description=f"episode {episode + 1} of {episodes}", completed=done)
                found = run_episode(made, actor, seed=seed + episode, on_step=step)
                returns.append(float(found.reward.sum()))
                successes += found.success
                if episode == 0:
                    _add_columns(table, found)
                table.add_row(str(episode), str(seed + episode), *_row(found))
                late = made.unwrapped.core.late_actions
    except KeyboardInterrupt:
        end = ""
        if made.unwrapped.core.config.controllers:
            runner = getattr(made.unwrapped.core.cell, "runner", None)  # none in a kind of cell of one's own
            close(made, actor)
            seen = runner is not None and runner.stopped
            end = ": " + ("both arms have stopped" if seen else "check both arms, one was not seen to stop")
        errors.print(f"interrupted{end}", highlight=False, soft_wrap=True)
        if returns:
            console.print(table)
            console.print(f"success {successes} of {len(returns)}; {episodes} were asked for", highlight=False)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        close(made, actor)
    console.print(table)
    spread = f" ± {np.std(returns):.2f}" if episodes > 1 else ""
    plant = "perturbed plant" if perturbed else "nominal plant: errors near zero are those of an exact model"
    if cell is not None:
        plant = f"{made.unwrapped.core.config.kind} cell"
    console.print(
        f"success {successes} of {episodes}, return {np.mean(returns):.2f}{spread} ({plant}){late_text(late)}",
        highlight=False,
    )
    conclude(successes, episodes, late, min_success)


def _add_columns(table: Table, found: EpisodeRecord) -> None:
    """Add the columns of a task: with errors of the flanges, if it has them."""
    errors_mm = () if found.flange_error_m is None else ("RMS error\n[dim]mm[/]", "largest\n[dim]mm[/]")
    for header in ("episode", "seed", "steps", "return", "success", *errors_mm):
        table.add_column(header, justify="center" if header == "success" else "right")
    table.add_column("ended by")


def _row(found: EpisodeRecord) -> tuple[str, ...]:
    """Return the cells of an episode's row from its number of steps on."""
    figures: list[str] = []
    if found.flange_error_m is not None:
        squares = (found.flange_error_m**2).mean(axis=0)
        figures = [f"{1e3 * np.sqrt(squares.max()):.4f}", f"{1e3 * found.flange_error_m.max():.4f}"]
    mark = "[green]yes[/]" if found.success else "[red]no[/]"
    return (str(found.steps), f"{found.reward.sum():.2f}", mark, *figures, escape(found.ended_by or found.end_reason))
