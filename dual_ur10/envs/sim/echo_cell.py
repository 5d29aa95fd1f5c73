"""Dry run: a cell without controllers and physics, whose state is what was commanded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.sim.servo_reference import ReferenceMotion, ServojReference
from dual_ur10.errors import ClosedError, SettingsError
from dual_ur10.sim2real.cell.cell import CellRequest, CellState, CellStep, Start, TickTrace
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.mirror_model import MirrorModel
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.command_queue import CommandQueue
from ur_core.tools.tool import strokes_m
from ur_core.types import Array, Rows


class EchoCell:
    """One cell that is always where the servoj law, fed with its targets, puts the arms.

    Targets pass the same adapter and safety gate as everywhere. Nothing is measured: tracking errors, contact, and
    whatever else an arm would show are absent. Objects stay where an episode begins, also those that were grasped.

    Args:
        config: The cell, with a task's equipment.
        ticks: Controller ticks per call of `advance`.
        n: Number of cells, 1.
        latency_ticks: L: delay of commands in ticks.

    Raises:
        SettingsError: There are several cells, or a perturbation.
    """

    n = 1

    def __init__(self, config: CellConfig, ticks: int, *, n: int = 1, latency_ticks: int = 0) -> None:
        if n > 1:
            raise SettingsError(f"{n} environments on a dry run: it echoes the commands of one cell. Use one")
        if config.perturbation != Perturbation():
            raise SettingsError("a perturbation is for simulated cells: a dry run has no plant. Leave it out")
        self.config, self.ticks = config, ticks
        self._queue = CommandQueue(1, latency_ticks, strokes_m(config.equipment.tools))
        self._reference = ServojReference(config.servoj, 1, 1, ticks, config.speed_factor)
        self._mirror: MirrorModel | None = MirrorModel(config.scene)
        self._gripper_m: Array | None = None
        self._elapsed = 0
        self._tracing = False

    def reset(
        self,
        start: Start,
        rows: Rows | None = None,
        *,
        seeds: Sequence[int] | None = None,
        perturbation: Mapping[str, Array] | None = None,
    ) -> CellStep:
        """Put the commanded arms at rest at the start of an episode. Seeds and perturbations have no effect."""
        mirror, row = self._open, np.zeros(1, dtype=np.intp)
        q = np.asarray(start.q_rad, dtype=np.float64).reshape(1, 2, 6)
        self._queue.reset(q, row, start.gripper_m)
        self._reference.reset(q, row)
        self._gripper_m, self._elapsed = None if start.gripper_m is None else np.asarray(start.gripper_m)[0], 0
        mirror.start(start)
        return CellStep(self._state(mirror, q[0], np.zeros((2, 6))))

    def advance(self, command: Command) -> CellStep:
        """Command [now + L, now + L + period), and return what is commanded at the end of [now, now + period)."""
        mirror, command = self._open, self._queue(command)
        motion = self._reference(command.targets_rad)
        end, speed = motion.end_q_rad[0].reshape(2, 6), motion.end_qd_rad_s[0].reshape(2, 6)
        if command.gripper_m is not None:
            self._gripper_m = command.gripper_m[0, -1]
        self._elapsed += self.ticks
        trace = self._traced(command.targets_rad, motion) if self._tracing else None
        return CellStep(self._state(mirror, end, speed), trace=trace)

    def _traced(self, targets: Array, motion: ReferenceMotion) -> TickTrace:
        after: Array = np.append(motion.q_rad[0, 1:], motion.end_q_rad, axis=0).reshape(-1, 2, 6)
        return TickTrace(targets[0].copy(), after, after, motion.qd_rad_s[0].reshape(-1, 2, 6).copy())

    def _state(self, mirror: MirrorModel, q_rad: Array, qd_rad_s: Array) -> CellState:
        wrench = np.zeros((2, 6)) if self.config.equipment.grippers else None
        time_s = self._elapsed * self.config.servoj.tick_s
        return mirror.follow(time_s, q_rad, qd_rad_s, gripper_m=self._gripper_m, wrench=wrench)

    def finish(self) -> None:
        """Do nothing: nothing moves."""

    def stop(self, reason: str) -> str:
        """Return "": nothing moves."""
        return ""

    def record(self) -> None:
        """Return a trace with every step from now on: what was sent, and what that commands."""
        self._tracing = True

    def integration_state(self) -> bytes | None:
        """Return None: there is no simulation."""
        return None

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """Return the MuJoCo model and data of the commanded arms, for rendering."""
        return self._open.model_and_data()

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the commanded state to another model of this scene, and that model's data; see `Cell.copy_state`."""
        self._open.copy_state(model, data)

    def close(self) -> None:
        """Release the model. May be called twice."""
        self._mirror = None

    @property
    def _open(self) -> MirrorModel:
        if self._mirror is None:
            raise ClosedError("this cell was closed: make a new one")
        return self._mirror


def make_echo_cell(request: CellRequest) -> EchoCell:
    """Make the dry run of a request.

    Raises:
        SettingsError: Something is randomized, or another reason of `EchoCell`.
    """
    if request.randomized:
        raise SettingsError("randomization is for simulated cells: leave it out in a dry run")
    return EchoCell(request.config, request.ticks, n=request.n, latency_ticks=request.latency_ticks)
