"""The command `check-configuration`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from dual_ur10.cli.options import EnvName, Settings, console, keywords_of
from dual_ur10.errors import SettingsError
from ur_core.kinematics.poses import Poses
from ur_core.types import Array


def check_configuration(
    env: EnvName,
    tools: Annotated[
        str | None,
        typer.Option(
            "--tools",
            metavar="NUMBERS",
            help="Poses of both tools in the cell frame: x y z (m) and quaternion w x y z of the left one, then of the "
            "right one.",
        ),
    ] = None,
    q: Annotated[
        str | None,
        typer.Option(
            "--q",
            metavar="NUMBERS",
            help="Joint positions (rad): six of the left arm, then six of the right one. With --tools, those to which "
            "the solution is the nearest one. Default: home.",
        ),
    ] = None,
    settings: Settings = None,
    cell: Annotated[
        Path | None,
        typer.Option("--cell", metavar="FILE", help="A cell file: bases, robots, tools, obstacles. Nothing connects."),
    ] = None,
) -> None:
    """Check a configuration of both arms: reach, joint margins, and what the safety gate finds in the way.

    Nothing moves and nothing is simulated. Exit code 1 if the configuration is not legal.
    """
    from dual_ur10.envs.core import configuration

    poses = None if tools is None else _numbers("--tools", tools, 14).reshape(2, 7)
    report = configuration.check_configuration(
        env,
        q_rad=None if q is None else _numbers("--q", q, 12).reshape(2, 6),
        tools=None if poses is None else Poses(poses[:, :3], poses[:, 3:]),
        **keywords_of(settings, False, cell),
    )
    console.print(str(report), highlight=False, markup=False, soft_wrap=True)
    if not report.is_legal:
        raise typer.Exit(1)


def _numbers(option: str, text: str, count: int) -> Array:
    """Return the numbers of an option, with blanks or commas between them.

    Raises:
        SettingsError: They are not that many numbers.
    """
    try:
        numbers = np.array([float(each) for each in re.split(r"[\s,;]+", text.strip())])
    except ValueError as error:
        raise SettingsError(f"{option} is {text!r:.200}: write {count} numbers, with blanks between") from error
    if len(numbers) != count:
        raise SettingsError(f"{option} has {len(numbers)} numbers: write {count}, with blanks between")
    return numbers
