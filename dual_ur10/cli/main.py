"""The command line: `python -m dual_ur10`, or `dual-ur10`."""

from __future__ import annotations

import contextlib
import time
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10 import __version__, policies
from dual_ur10.cli.cell import app as cell_commands
from dual_ur10.cli.convert import convert
from dual_ur10.cli.demo import demo
from dual_ur10.cli.doctor import doctor
from dual_ur10.cli.emulate import emulate
from dual_ur10.cli.evaluate import evaluate
from dual_ur10.cli.options import (
    RUNS,
    CellFileName,
    EnvName,
    NoRecord,
    OneArm,
    Perturbed,
    PolicyName,
    PowerOn,
    Record,
    Seed,
    Settings,
    console,
    errors,
    keywords_of,
    late_text,
    power_on,
    record_in,
)
from dual_ur10.cli.runs import compare, fit, replay
from dual_ur10.cli.status import status
from dual_ur10.cli.train import collect, train
from dual_ur10.errors import DualUR10Error, SettingsError, UnknownNameError
from dual_ur10.ids import ENV_IDS, env_id_of
from dual_ur10.policies.baselines import BASELINES, RandomPolicy, ZeroPolicy
from dual_ur10.policies.registry import provenance, shipped_names
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED, begin_program, end_interrupted

USAGE_ERROR = 2
"""Exit code of every error of this package."""


class _Commands(typer.core.TyperGroup):
    """Turns this package's errors, and Ctrl-C where no command has more to say of it, into one line each."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (DualUR10Error, gym.error.Error) as error:
            errors.print(f"[bold red]error:[/] [red]{escape(' '.join(str(error).split()))}[/]", soft_wrap=True)
            raise typer.Exit(USAGE_ERROR) from None
        except KeyboardInterrupt:
            end_interrupted()


app = typer.Typer(
    cls=_Commands,
    help="Two UR10s in MuJoCo: run policies, measure them, look at them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,  # what is not an error of this package is a bug: its traceback is to be copied
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _options(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        console.print(__version__, highlight=False)
        raise typer.Exit


@app.command("list")
def list_environments() -> None:
    """List the environments, their rates and sizes, and the policies for them."""
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for header, justify in (("environment", "left"), ("rate", "right"), ("action", "right"), ("observation", "right")):
        # An id is there to be copied: it is never cut.
        table.add_column(header, justify=justify, no_wrap=True, min_width=len(header))  # type: ignore[arg-type]  # rich wants literals
    table.add_column("policies")
    table.columns[0].min_width = max(map(len, ENV_IDS))
    for env_id in ENV_IDS:
        env = gym.make(env_id)
        try:
            core = env.unwrapped.core  # type: ignore[attr-defined]  # Gymnasium knows only Env
            sizes = [" × ".join(map(str, space.shape or ())) for space in (env.action_space, env.observation_space)]
            names = ", ".join(("scripted", *shipped_names(env_id), *BASELINES))
            table.add_row(f"[cyan]{env_id}[/]", f"{1 / core.timing.period_s:g} Hz", *sizes, names)
        finally:
            env.close()
    console.print(table)


app.command()(demo)


@app.command()
def rollout(
    env: EnvName,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 5,
    seed: Seed = 0,
    settings: Settings = None,
    perturbed: Perturbed = False,
    cell: CellFileName = None,
    arm: OneArm = None,
    power: PowerOn = False,
    record: Record = RUNS,
    no_record: NoRecord = False,
) -> None:
    """Run episodes of a policy, in MuJoCo or on two controllers, and print a row for each."""
    from dual_ur10.policies.evaluation.rollout import rollout as run_episode

    keywords = keywords_of(settings, perturbed, cell, arm)
    if power:
        power_on(cell)
    if not no_record:
        record_in(keywords, record, provenance(policy, env_id_of(env)))
    made, actor = _make(env, policy, keywords, seed)
    table = Table(header_style="bold")
    for header in ("episode", "seed", "steps", "return", "success", "RMS error\n[dim]mm[/]", "largest\n[dim]mm[/]"):
        table.add_column(header, justify="center" if header == "success" else "right")
    table.add_column("ended by")
    returns, successes = [], 0
    late = 0
    try:
        # Somebody may be asked something at the terminal.
        with contextlib.nullcontext() if cell else console.status("running") as shown:
            for episode in range(episodes):
                if shown is not None:
                    shown.update(f"episode {episode + 1} of {episodes}")
                found = run_episode(made, actor, seed=seed + episode)
                figures = ["—", "—"]
                if found.flange_error_m is not None:
                    squares = (found.flange_error_m**2).mean(axis=0)
                    figures = [f"{1e3 * np.sqrt(squares.max()):.4f}", f"{1e3 * found.flange_error_m.max():.4f}"]
                total = float(found.reward.sum())
                returns.append(total)
                successes += found.success
                mark = "[green]yes[/]" if found.success else "[red]no[/]"
                row = (str(episode), str(seed + episode), str(found.steps), f"{total:.2f}", mark, *figures)
                table.add_row(*row, escape(found.ended_by))
                late = made.unwrapped.core.late_actions
    except KeyboardInterrupt:
        if cell is None:
            raise
        runner = made.unwrapped.core.cell.runner
        made.close()
        end = "both arms are at rest" if runner.came_to_rest else "look at both arms, one was not seen to come to rest"
        errors.print(f"interrupted: {end}", highlight=False, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        made.close()
    console.print(table)
    spread = f" ± {np.std(returns):.2f}" if episodes > 1 else ""
    plant = "perturbed plant" if perturbed else "nominal plant: errors near zero are those of an exact model"
    if cell is not None:
        plant = f"{made.unwrapped.core.config.kind} cell"
    console.print(
        f"success {successes} of {episodes}, return {np.mean(returns):.2f}{spread} ({plant}){late_text(late)}",
        highlight=False,
    )


@app.command()
def view(
    env: EnvName,
    policy: PolicyName = "scripted",
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long.")] = None,
    seed: Seed = 0,
    settings: Settings = None,
    perturbed: Perturbed = False,
) -> None:
    """Watch a policy in real time, in a window or, without a display, in a browser on this machine."""
    keywords = keywords_of(settings, perturbed)
    made, actor = _make(env, policy, {**keywords, "render_mode": "human"}, seed)
    period_s = made.unwrapped.core.timing.period_s
    try:
        observation, _ = made.reset(seed=seed)
        actor.reset()
        viewer = made.unwrapped.viewer
        if viewer.url:
            console.print(f"the viewer is at [bold cyan]{viewer.url}[/] for browsers on this machine", soft_wrap=True)
        console.print("Ctrl-C ends it", style="dim")
        begun = due = time.monotonic()
        while viewer.is_running() and (seconds is None or due - begun < seconds):
            action = np.asarray(actor(observation), dtype=made.action_space.dtype)
            observation, _, terminated, truncated, _ = made.step(action)
            if terminated or truncated:
                observation, _ = made.reset()
                actor.reset()
            # Against the clock, not from step to step: delays do not add up. What is late by much is let go.
            due = max(due + period_s, time.monotonic() - 0.5)
            time.sleep(max(0.0, due - time.monotonic()))
    except KeyboardInterrupt:
        console.print("closed")
    finally:
        made.close()


app.command()(evaluate)
app.command()(train)
app.command()(collect)
app.command()(convert)
app.command()(emulate)
app.command()(doctor)
app.command()(status)
app.command()(replay)
app.command()(compare)
app.command()(fit)
app.add_typer(cell_commands, name="cell")


def _make(env: str, policy: str, keywords: dict[str, Any], seed: int) -> tuple[Any, Any]:
    """Environment and policy.

    Raises:
        DualUR10Error: A name or a value is not legal.
    """
    env_id = env_id_of(env)
    names = (*policies.NAMES, *BASELINES)
    if policy not in names and not policies.is_path(policy):
        raise UnknownNameError("policy", policy, names)
    try:
        made = gym.make(env_id, **keywords)
    except TypeError as error:
        # Gymnasium appends where it was raised and all keywords.
        reason = str(error).split(" was raised from the environment creator")[0]
        raise SettingsError(f"a value of --set has the wrong type: {reason}") from error
    try:
        if policy == "random":
            return made, RandomPolicy(made.action_space, seed=seed)
        if policy == "zero":
            return made, ZeroPolicy(made.action_space)
        return made, policies.load(policy, env_id, **keywords)
    except DualUR10Error:
        made.close()
        raise


def main() -> None:
    """Run the command line."""
    try:
        begin_program()
        app(prog_name="dual-ur10")
    except KeyboardInterrupt:  # between two of them
        end_interrupted()


if __name__ == "__main__":
    main()
