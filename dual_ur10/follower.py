"""Executor of trajectories on a cell that is named as for an environment, without a task and its equipment."""

from __future__ import annotations

import math

from dual_ur10.assets.settings import Equipment, home_q_rad
from dual_ur10.errors import UnknownNameError
from dual_ur10.sim2real.cell.cell import CellRequest
from dual_ur10.sim2real.cell.cell_config import HostedCell
from dual_ur10.sim2real.cell.named_cell import make_cell, resolve_cell
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.proximity import ProximityScaling
from dual_ur10.sim2real.recording.of_env import record_run
from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor
from dual_ur10.sim2real.trajectory.path_check import TargetLaw
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.gains import STIFF
from ur_core.processes.system import LOCAL
from ur_core.types import Array

TICKS = 2
"""Targets per period: after so many ticks at most, a violated tolerance is noticed."""

LEAD_S = 0.1
"""Time by which targets are written ahead of two controllers: a stall of this program that is a little shorter costs
nothing. A longer one of this machine stops the arms anyway: it is the senders' `MOST_LATE_S`.

What is written is executed: a cancel, a violated tolerance, another goal and a scaling take effect after it. Stops by
the arms' processes and the supervisor do not wait.
"""


def home_of(cell: object = "mujoco") -> Array:
    """Return the home configuration of a cell's arms, (2, 6) rad; see `make_follower`."""
    config = resolve_cell(cell)
    return home_q_rad((config.left, config.right))


def make_follower(
    cell: object = "mujoco",
    *,
    limits: MotionLimits | None = None,
    arm: str | None = None,
    ticks: int = TICKS,
    confirm: Confirm | None = None,
) -> TrajectoryExecutor:
    """Return an executor of trajectories on a cell. Simulated arms are at home; nothing else has moved.

    On two controllers a stop leaves a black box, as with an environment.

    Args:
        cell: "mujoco", "echo", a `CellConfig`, the path of a cell file, or a `dual_ur10.testing.VirtualCell`.
        limits: Motion limits, as far as the cell allows them; None: the hard ones.
        arm: "left" or "right": the only arm that moves. A goal of the other one is rejected. None: both may.
        ticks: Controller ticks per period.
        confirm: Called with a description before the arms of two controllers move to a start; None: real arms need a
            yes at the terminal, emulated ones none.

    Raises:
        UnknownNameError: There is no such cell or arm.
        DualUR10Error: The cell cannot be made; see `MujocoCell` and `RtdeCell`.
    """
    if arm is not None and arm not in ARMS:
        raise UnknownNameError("arm", str(arm), [*ARMS, "None"])
    config = resolve_cell(cell).equipped(Equipment(), 0.002, STIFF)
    limits = config.capped(MotionLimits() if limits is None else limits)
    clearance = Clearance(config.measured_scene, minimum_m=config.minimum_clearance_m, uncertainty=config.uncertainty)
    law = TargetLaw.of(config.servoj, ticks, config.speed_factor, config.measured_lookahead_s)
    gate = SafetyGate(limits, law.tick_s, ticks, clearance)
    latency_ticks = config.latency_ticks
    if config.controllers:
        latency_ticks = max(latency_ticks, math.ceil(LEAD_S / law.tick_s * config.speed_factor - 1e-9))
    request = CellRequest(
        config=config,
        ticks=ticks,
        limits=limits,
        clearance=clearance,
        latency_ticks=latency_ticks,
        contacts=config.perturbation != Perturbation(),
        confirm=confirm,
        only=arm,
        system=cell.system if isinstance(cell, HostedCell) else LOCAL,
    )
    made = make_cell(request)
    try:
        black_box = record_run("trajectories", {}, request, made)
    except BaseException:
        made.close()
        raise
    executor = TrajectoryExecutor(
        made,
        gate,
        law,
        clearance,
        latency_ticks=latency_ticks,
        dh=[mount.dh for mount in (config.left, config.right)],
        proximity=ProximityScaling(clearance, law.period_s) if config.controllers else None,
        only=None if arm is None else ARMS.index(arm),
        on_close=None if black_box is None else black_box.close,
    )
    with executor.closed_on_error():
        if not config.controllers:
            executor.start(home_q_rad((config.left, config.right)))
    return executor
