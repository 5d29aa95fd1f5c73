"""The command `list`."""

from __future__ import annotations

import gymnasium as gym
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import console
from dual_ur10.ids import FAILED_ENTRY_POINTS, TASKS, discover
from dual_ur10.policies.baselines import BASELINES
from dual_ur10.policies.registry import names_for


def list_environments() -> None:
    """List the environments, their rates and sizes, and the policies for them: also those of installed packages."""
    discover()
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for header, justify in (("environment", "left"), ("rate", "right"), ("action", "right"), ("observation", "right")):
        # An id must stay whole, to be copied.
        table.add_column(header, justify=justify, no_wrap=True, min_width=len(header))  # type: ignore[arg-type]  # rich wants literals
    table.add_column("policies")
    table.columns[0].min_width = max(map(len, TASKS))
    failed = [f"the entry point {point} failed: {why}" for point, why in FAILED_ENTRY_POINTS.items()]
    for env_id in TASKS:
        try:
            with gym.make(env_id) as env:
                core = env.unwrapped.core  # type: ignore[attr-defined]  # Gymnasium knows only Env
                sizes = [" × ".join(map(str, space.shape or ())) for space in (env.action_space, env.observation_space)]
                names = ", ".join((*names_for(env_id), *BASELINES))
                table.add_row(f"[cyan]{env_id}[/]", f"{1 / core.timing.period_s:g} Hz", *sizes, names)
        except Exception as error:  # tasks of others may raise anything
            failed.append(f"{env_id} cannot be made: {error}")
    console.print(table)
    for text in failed:
        console.print(f"[yellow]{escape(text)}[/]")
