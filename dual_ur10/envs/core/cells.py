"""Makes the cell that an environment's keywords ask for."""

from __future__ import annotations

from collections.abc import Collection

from dual_ur10.envs.core.options import MOVE_TO_START, EnvOptions
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.errors import ResetRefusedError, SettingsError
from dual_ur10.sim2real.config.cell import Cell, CellConfig, Perturbation
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits


def make_cell(
    config: CellConfig,
    options: EnvOptions,
    ticks: int,
    n: int,
    *,
    threads: int,
    limits: MotionLimits,
    clearance: Clearance,
    varied: Collection[str],
    coupled: bool,
) -> Cell:
    """A simulated cell, or that of two controllers.

    Args:
        config: The cell, with a task's equipment.
        options: Keywords of the environment.
        ticks: Control periods of a step.
        n: Number of cells.
        threads: Threads to simulate on.
        limits: Of the task.
        clearance: Measures the distances on the way to a start.
        varied: What randomization changes.
        coupled: Whether both arms hold one object.

    Raises:
        DualUR10Error: It cannot be made; see `MujocoCell` and `RtdeCell`.
    """
    latency = options.latency_ticks(config)
    if config.file is None:
        return MujocoCell(config, ticks, n=n, threads=threads, latency_ticks=latency, varied=varied)
    from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell  # what it needs, a simulation does not

    return RtdeCell(
        config,
        ticks,
        limits=limits,
        clearance=clearance,
        latency_ticks=latency,
        coupled=coupled,
        confirm=options.confirm,
        only=options.arm,
    )


def check_for_controllers(config: CellConfig, n: int, *, autoreset: bool, randomized: bool) -> None:
    """Refuse what two controllers cannot do.

    Args:
        config: The cell.
        n: Number of environments.
        autoreset: Whether episodes begin by themselves.
        randomized: Whether something is to differ from episode to episode.

    Raises:
        SettingsError: So it is, and the cell is one of two controllers.
    """
    if config.file is None:
        return
    if n > 1:
        raise SettingsError(f"{n} environments on one cell of controllers: there is one pair of arms. Use one")
    if autoreset:
        raise SettingsError(
            "episodes that begin by themselves, as in training, on a cell of controllers: arms go to where an episode "
            'begins when somebody resets them. Train in simulation; or set autoreset_mode to "Disabled"'
        )
    if randomized:
        raise SettingsError("randomization is of simulated cells: leave it out on controllers, which are as they are")
    if config.perturbation != Perturbation():
        raise SettingsError("a perturbation is of simulated cells: leave it out on controllers, which are as they are")


def check_reset(*, begun: bool, consent: bool) -> None:
    """Refuse a reset that would move the arms of two controllers without consent.

    Wrappers that begin episodes by themselves call the same `reset` as a program. They pass no options, so that none of
    them leads arms to another start.

    Args:
        begun: An episode has begun before.
        consent: The caller consents to the motion.

    Raises:
        ResetRefusedError: An episode has begun before, and the caller does not consent.
    """
    if begun and not consent:
        raise ResetRefusedError(
            "reset was called again without consent, on a cell of two controllers: it would move both arms to where an "
            "episode begins, and nothing may do that by itself. Pass "
            f'reset(options={{"{MOVE_TO_START}": True}}) in your program, or make the environment with confirm=, which '
            "is asked before each such motion; train in simulation"
        )
