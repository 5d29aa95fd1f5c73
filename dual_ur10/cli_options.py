"""What the commands share: their arguments, and what these stand for."""

from __future__ import annotations

import ast
import json
from typing import Annotated, Any

import typer
from rich.console import Console

from dual_ur10 import ENV_IDS
from dual_ur10.errors import SettingsError, UnknownNameError

console = Console()
errors = Console(stderr=True)

EnvName = Annotated[
    str, typer.Argument(metavar="ENV", help="An id, such as DualUR10/SineTracking-v0; SineTracking will do.")
]
PolicyName = Annotated[str, typer.Option("--policy", "-p", help="scripted, random or zero.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="A keyword of the environment, such as amplitude_m=0.05. May be repeated."
    ),
]
Perturbed = Annotated[
    bool, typer.Option("--perturbed", help="A plant that differs from what the controller believes of it.")
]
Seed = Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode; the next ones count on.")]


def env_id_of(name: str) -> str:
    """The id that a short name stands for.

    Raises:
        UnknownNameError: None does.
    """
    known = {short: env_id for env_id in ENV_IDS for short in _short_names(env_id)}
    if name not in known:
        raise UnknownNameError("environment", name, list(ENV_IDS))
    return known[name]


def _short_names(env_id: str) -> tuple[str, str, str]:
    task = env_id.split("/")[-1]
    return env_id, task, task.rsplit("-v", 1)[0]


def keywords_of(settings: list[str] | None, perturbed: bool) -> dict[str, Any]:
    """Keywords of the environment from `KEY=VALUE` texts; values are Python literals or JSON, or else text.

    Raises:
        SettingsError: A text has no "=", or a key is given twice.
    """
    keywords: dict[str, Any] = {}
    if perturbed:
        from dual_ur10.sim2real.cell import TYPICAL_PERTURBATION, CellConfig

        keywords["cell"] = CellConfig(perturbation=TYPICAL_PERTURBATION)
    for text in settings or ():
        key, sign, value = text.partition("=")
        key = key.strip()
        if not sign or not key.isidentifier():
            raise SettingsError(f"--set {text!r}: write it as KEY=VALUE, such as --set amplitude_m=0.05")
        if key in keywords:
            raise SettingsError(f"{key} is set twice" + (": --perturbed sets it" if key == "cell" else ""))
        keywords[key] = _value(value)
    return keywords


def _value(text: str) -> Any:
    for parse in (ast.literal_eval, lambda each: json.loads(each, parse_constant=_no_constant)):
        try:
            return parse(text.strip())
        except (ValueError, SyntaxError):
            continue
    return text


def _no_constant(name: str) -> None:
    """NaN and Infinity are not JSON, though Python reads them."""
    raise ValueError(name)
