"""The command `repeatability`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from dual_ur10.cli.options import CellFileName, Perturbed, PowerOn, console, keywords_of, power_on
from dual_ur10.kinematics.ur10 import ARMS


def repeatability(
    paths: Annotated[int, typer.Option("--paths", min=2, help="Random paths away and back.")] = 20,
    cell: CellFileName = None,
    settle: Annotated[
        float, typer.Option("--settle", metavar="S", min=0.0, max=60.0, help="Rest before each measurement.")
    ] = 1.0,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the random paths.")] = 0,
    perturbed: Perturbed = False,
    power: PowerOn = False,
) -> None:
    """Measure how well both arms return to the home configuration, after random collision-free paths.

    Flange positions come from the joints' encoders by forward kinematics: they show no bending and no wrong kinematics.
    On two controllers the arms first move home slowly, once you confirm it, and then at the speeds of the cell.
    """
    import numpy as np

    from dual_ur10.envs.core.follower import home_of, make_follower
    from dual_ur10.sim2real.trajectory.repeatability import UR10_M, returns, spread_of

    keywords = keywords_of(None, perturbed, cell)
    if power:
        power_on(cell)
    chosen = keywords.get("cell", "mujoco")
    with make_follower(chosen) as executor:
        executor.start(home_of(chosen))
        found = list(returns(executor, paths, np.random.default_rng(seed), settle))
    only_ur10 = set(executor.gate.limits.robots) == {"ur10"}  # whose data sheet is known here
    spread = spread_of(np.stack([executor.flanges_m(q_rad) for q_rad in found]))
    table = Table(header_style="bold")
    for header in ("arm", "ISO 9283\n[dim]mm[/]", "largest\n[dim]mm[/]", *["UR10, data sheet\n[dim]mm[/]"] * only_ur10):
        table.add_column(header, justify="left" if header == "arm" else "right")
    for row, arm in enumerate(ARMS):
        values = (spread.iso_9283_m[row], spread.largest_m[row])
        table.add_row(arm, *(f"{1e3 * each:.5f}" for each in values), *[f"±{1e3 * UR10_M:g}"] * only_ur10)
    console.print(table)
    console.print(f"{paths} returns, {settle:g} s after each, from encoders and forward kinematics", highlight=False)
