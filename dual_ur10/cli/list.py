"""The command `list`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable

import gymnasium as gym
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import console, print_whole
from dual_ur10.errors import DualUR10Error
from dual_ur10.ids import FAILED_ENTRY_POINTS, LEARNED_NAMES, TASKS, discover
from dual_ur10.policies.baselines import BASELINES
from dual_ur10.policies.registry import names_for
from ur_core.kinematics.robots import ROBOTS
from ur_core.objects import load_object
from ur_core.tools.tool import Tool, tool_named, tool_names


def list_environments() -> None:
    """List environments, policies, devices of operators, grippers and robots, also those of installed packages."""
    from dual_ur10.policies.operators.catalog import installed
    from dual_ur10.policies.scripted.base import ScriptedPolicy

    discover()
    table = _table("environment", ("rate", "action", "observation"), "policies, and the task")
    failed = [f"the entry point {point} failed: {why}" for point, why in FAILED_ENTRY_POINTS.items()]
    for env_id in TASKS:
        try:
            with gym.make(env_id) as env:
                core = env.unwrapped.core  # type: ignore[attr-defined]  # Gymnasium knows only Env
                sizes = [" × ".join(map(str, space.shape or ())) for space in (env.action_space, env.observation_space)]
                names = ", ".join((*names_for(env_id), *BASELINES))
                task = f"{names}\n[dim]{escape(_summary(type(core.task)))}[/]"
                table.add_row(f"[cyan]{env_id}[/]", f"{1 / core.timing.period_s:g} Hz", *sizes, task)
        except Exception as error:  # tasks of others may raise anything
            failed.append(f"{env_id} cannot be made: {error}")
    print_whole(table)
    policies = {"scripted": _summary(ScriptedPolicy), **LEARNED_NAMES}
    policies |= {name: _summary(kind) for name, kind in BASELINES.items()}
    devices = _each(installed(), lambda name: _summary(load_object(installed()[name], "the device")), failed)
    grippers = _each(tool_names(), lambda name: _of_tool(tool_named(name)), failed)
    robots = {
        name: f"{robot.title}: {robot.family}, reach {robot.reach_m:g} m, payload {robot.payload_kg:g} kg"
        for name, robot in ROBOTS.items()
    }
    groups = {"policy": policies, "device": devices, "gripper": grippers, "robot": robots}
    for title, rows in groups.items():
        table = _table(title, (), "")
        for name, text in rows.items():
            table.add_row(f"[cyan]{name}[/]", f"[dim]{escape(text)}[/]")
        console.print()
        print_whole(table)
    for text in failed:
        console.print(f"[yellow]{escape(text)}[/]")


def _each(names: Iterable[str], line: Callable[[str], str], failed: list[str]) -> dict[str, str]:
    """Return a line for each name; those of packages that cannot be loaded are added to `failed`."""
    found = {}
    for name in names:
        try:
            found[name] = line(name)
        except DualUR10Error as error:
            failed.append(str(error))
    return found


def _of_tool(tool: Tool) -> str:
    return f"{tool.title}: stroke {1e3 * tool.stroke_m:g} mm, up to {tool.force_n[1]:g} N, {tool.mass_kg:g} kg"


def _table(first: str, numbers: tuple[str, ...], last: str) -> Table:
    """Return a table whose first column stays whole, so that its names can be copied."""
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column(first, no_wrap=True, min_width=max(map(len, TASKS)) if numbers else None)
    for header in numbers:
        table.add_column(header, justify="right", no_wrap=True, min_width=len(header))
    table.add_column(last)
    return table


def _summary(documented: object) -> str:
    """Return the first paragraph of what a class or function says of itself."""
    return " ".join((inspect.getdoc(documented) or "").partition("\n\n")[0].split())
