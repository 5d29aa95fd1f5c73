"""The run of a command: its cell, environment, policy and operator, from their making to the last line."""

from __future__ import annotations

import dataclasses
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape

from dual_ur10 import policies
from dual_ur10.cli.options import VIRTUAL, at_end, console, errors, is_file, keywords_of
from dual_ur10.errors import SettingsError, UnknownNameError, nearest_name
from dual_ur10.ids import env_id_of
from dual_ur10.policies.policy import close_policy
from dual_ur10.policies.registry import check_name, keywords_for, wrong_types_named
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS
from ur_core.processes.machine_load import too_busy

if TYPE_CHECKING:
    from dual_ur10.policies.operators.operator import Operator


def on_virtual(cell: Path | None, task: str | None, keywords: Mapping[str, Any] | None = None) -> Any:
    """Return the virtual cell that `--cell virtual` stands for, which ends with the command; another value unchanged.

    Args:
        cell: Value of the option.
        task: Id of the environment; None: none.
        keywords: Keywords of the environment. Those of its task decide the scene of the virtual cell.

    Raises:
        MissingExtraError: The extra `virtual` is not installed.
        UnknownNameError: It is "virtual", misspelled.
    """
    if cell is None:
        return None
    if (name := str(cell)) != VIRTUAL:
        if not is_file(name) and name not in CELL_KINDS and nearest_name(name, [VIRTUAL]):
            raise UnknownNameError("cell", name, [VIRTUAL, "echo"], "the path of a cell file, such as lab.toml")
        return name
    from dual_ur10.testing import VirtualCell

    options: dict[str, Any] = {"task": task}
    if task is not None and keywords:
        from dual_ur10.envs.core.setup import load_task

        names = [each.name for each in dataclasses.fields(load_task(task).settings_type)]
        options["settings"] = {name: keywords[name] for name in names if name in keywords}
    made = VirtualCell(**options)
    at_end.callback(made.close)
    return made


def keywords_on(
    cell: Path | None, env_id: str, settings: list[str] | None, perturbed: bool, arm: str | None
) -> dict[str, Any]:
    """Return keywords of the environment as `keywords_of`, with the cell that the value of --cell stands for.

    Raises:
        SettingsError: Or one of its kinds: as raised by `keywords_of` and `on_virtual`.
    """
    keywords = keywords_of(settings, perturbed, cell, arm)
    if cell is not None:
        keywords["cell"] = on_virtual(cell, env_id, keywords)
    return keywords


def asks(cell: object) -> bool:
    """Return True if a cell, the value of --cell, may ask the operator at the terminal before it moves."""
    return cell is not None and str(cell) != VIRTUAL


@contextmanager
def interrupts_noted() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets, instead of raising, within the block."""
    event = threading.Event()
    before = signal.signal(signal.SIGINT, lambda *_: event.set())
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


STOP_COMMANDED = "both arms were commanded to stop: check them"
"""Message on the arms of a cell after Ctrl-C."""


def late_text(count: int) -> str:
    """Return a suffix with the number of actions that missed their deadline; "" if none did."""
    if not count:
        return ""
    return f", {count} late action{'' if count == 1 else 's'}"


BELOW = 1
"""Exit code when too few episodes succeed."""


def check_min_success(rate: float | None) -> None:
    """Check the value of --min-success.

    Raises:
        SettingsError: It is no rate.
    """
    if rate is not None and not 0.0 <= rate <= 1.0:
        raise SettingsError(f"--min-success is {rate:g}: it must be a rate from 0 to 1, such as 0.95")


def conclude(successes: int, episodes: int, late: int, min_success: float | None, task: str = "") -> None:
    """Print a last line if no episode succeeded or too few did; exit with code `BELOW` below the required rate.

    Args:
        successes: Number of successful episodes.
        episodes: Number of episodes.
        late: Number of actions that missed their deadline.
        min_success: Required rate; None: none.
        task: Beginning of the line, where there are several tasks.
    """
    rate = successes / episodes
    below = min_success is not None and rate < min_success
    if successes and not below:
        return
    text = f"{task}{'too few successes' if successes else 'nothing succeeded'}: {successes} of {episodes}"
    if below:
        text += f" are a rate of {rate:.4g}, required {min_success:g} or more"
    if late:
        text += (
            f"; {late} late action{'' if late == 1 else 's'} stopped both arms, which is no decision of the policy: "
            f"{too_busy('or the policy computes too long')}"
        )
    errors.print(f"[bold red]{escape(text)}[/]", soft_wrap=True, highlight=False)
    if below:
        raise typer.Exit(BELOW)


def power_on(cell: Path | None) -> None:
    """Power the arms of a cell on and release their brakes, once an operator at the terminal confirms it.

    Raises:
        SettingsError: No cell is named.
        StartError: The operator has not confirmed it.
        DualUR10Error: An arm cannot be powered on.
    """
    if cell is None:
        raise SettingsError("--power-on is for two controllers: name their cell file with --cell")
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
    from dual_ur10.sim2real.commissioning import power
    from dual_ur10.sim2real.commissioning.operator_prompts import prompt_for

    file = load_cell_file(cell)
    power.power_on(file, prompt_for(file))


def check_leader(policy: str, operator: str | None) -> None:
    """Refuse --policy beside --operator.

    Raises:
        SettingsError: Both are given.
    """
    if operator is not None and policy != "scripted":
        raise SettingsError(f"--policy {policy} and --operator {operator} do not go together: leave one out")


def make_operator(
    operator: str, env_id: str, keywords: dict[str, Any], *, keys: bool = False, buttons: Sequence[str] = ()
) -> Operator:
    """Return the operator of an environment, in the time of day.

    Raises:
        DualUR10Error: The device cannot be opened, or a value is not legal.
    """
    from dual_ur10.policies.operators.catalog import load_operator

    with wrong_types_named(env_id):
        return load_operator(operator, env_id, keywords, paced=True, keys=keys, buttons=buttons)


def make(
    env: str,
    policy: str,
    keywords: dict[str, Any],
    seed: int,
    operator: str | None = None,
    takeover: str | None = None,
    *,
    keys: bool = False,
) -> tuple[Any, Any]:
    """Return environment and policy, or the operator, whose device is to be closed; or a policy with a takeover.

    Args:
        env: Id of the environment, or its short form.
        policy: Name of the policy.
        keywords: Keywords of the environment.
        seed: Seed of random actions.
        operator: Device of an operator in place of the policy.
        takeover: Device of a person who may take over.
        keys: The keys of the terminal are buttons of an operator, too; a page has the buttons of episodes.

    Raises:
        DualUR10Error: A name or a value is not legal, or a device cannot be opened.
    """
    from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES

    env_id = env_id_of(env)
    check_leader(policy, operator)
    buttons = EPISODES if keys else ()
    if takeover is not None:
        return _make_takeover(env_id, policy, keywords, seed, operator, takeover, (*TAKES, *buttons))
    if operator is None:
        return policies.make(policy, env_id, seed=seed, **keywords)
    person, made = make_operator(operator, env_id, keywords, keys=keys, buttons=buttons), None
    try:
        made, _ = policies.make(person, env_id, **keywords)
        return shown(made, person), person
    except BaseException:
        if made is not None:
            made.close()
        person.close()
        raise


def _make_takeover(
    env_id: str,
    policy: str,
    keywords: dict[str, Any],
    seed: int,
    operator: str | None,
    device: str,
    buttons: Sequence[str],
) -> tuple[Any, Any]:
    """Return environment and policy with a person who may take over."""
    from dual_ur10.policies.operators.takeover import Takeover

    if operator is not None:
        raise SettingsError("--operator leads from the beginning, --takeover takes over from a policy: leave one out")
    check_name(policy)
    keywords = keywords_for(policy, env_id, keywords)
    person, made = make_operator(device, env_id, keywords, keys=True, buttons=buttons), None
    try:
        made, actor = make(env_id, policy, keywords, seed)
        actor = Takeover(actor, person, tell=lambda text: console.print(escape(text), highlight=False))
        return shown(made, person), actor
    except BaseException:
        if made is not None:
            made.close()
        person.close()
        raise


def shown(made: Any, person: Operator) -> Any:
    """Return an environment, shown by the page of its operator, once a browser has opened it; or as it is."""
    from dual_ur10.envs.rendering.live.shown import Shown
    from dual_ur10.policies.operators.page import PageDevice

    if not isinstance(person.device, PageDevice):
        return made
    page = person.device.page
    console.print(f"open the page to begin: {page.url}", soft_wrap=True, highlight=False, markup=False)
    page.wait_until_open()
    return Shown(made, page)


def close(made: Any, actor: Any) -> None:
    """Close an environment, and what the policy or operator holds: a device, a thread, a connection."""
    try:
        made.close()
    finally:
        close_policy(actor)
