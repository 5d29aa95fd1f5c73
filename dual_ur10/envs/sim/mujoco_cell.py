"""Simulated cell: n times two arms in MuJoCo, with the lag of real UR controllers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.sim.physics import Physics
from dual_ur10.envs.sim.servo_reference import ReferenceMotion, ServojReference, TargetDelay, TimeScaledTargets
from dual_ur10.errors import ClosedError, SettingsError
from dual_ur10.sim2real.cell.cell import CellRequest, CellStep, Start, TickTrace
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.command_queue import CommandQueue
from ur_core.tools.tool import strokes_m
from ur_core.types import Array, Rows


class MujocoCell:
    """n simulated cells, stepped together.

    One call of `advance` is one rollout of MuJoCo's batch: targets are delayed, the servoj law converts them to motion,
    and the joint servos follow with feed-forward. The state is that of the last instant.

    Args:
        config: The cell, with a task's equipment.
        ticks: Controller ticks per call of `advance`.
        n: Number of cells.
        threads: Threads to step on.
        latency_ticks: L: delay of commands in ticks.
        varied: Names of the values of `Perturbation` that a reset may change. They and the configuration determine how
            targets are computed, so that a row does not depend on the samples of others.
        contacts: False if nothing can touch, because a gate checks the targets and the plant is nominal.
    """

    def __init__(
        self,
        config: CellConfig,
        ticks: int,
        *,
        n: int = 1,
        threads: int = 1,
        latency_ticks: int = 0,
        varied: Collection[str] = (),
        contacts: bool = True,
    ) -> None:
        self.config, self.ticks, self.n = config, ticks, n
        self.threads = threads
        self.steps = ticks * config.substeps
        self._queue = CommandQueue(n, latency_ticks, strokes_m(config.equipment.tools))
        slow = config.speed_factor
        self._scaled = None if slow == 1.0 else TimeScaledTargets(n, config.substeps, slow)
        self._delay = TargetDelay(n, 1 if self._scaled else config.substeps)
        self._reference = ServojReference(config.servoj, n, config.substeps, ticks, slow, threads)
        self._elapsed = np.zeros(n, dtype=np.int64)
        self._tick_s = np.float64(config.servoj.tick_s)
        self._values = config.perturbation.expanded(n)
        delayed = any(name in varied or self._values[name].any() for name in ("latency_s", "jitter_s", "loss"))
        self._delayed = delayed
        self._physics: Physics | None = Physics(config, n, self.steps, threads, contacts=contacts)
        self._perturb(np.arange(n))

    def _perturb(self, rows: Rows) -> None:
        """Perturb the plant of `rows` by `_values`."""
        values = self._values
        # With time scaling, a physics step takes longer on the controllers' clock.
        step_s = (self.config.timestep_s or self.config.scene.timestep_s) / self.config.speed_factor
        self._delay.latency = np.rint(values["latency_s"] / step_s).astype(np.int64)
        self._delay.jitter = np.rint(values["jitter_s"] / step_s).astype(np.int64)
        self._delay.loss = values["loss"]
        delayed = self._delayed or self._scaled is not None
        self._reference.set_lookahead(values["lookahead_scale"], delayed=delayed)
        self._open.perturb(values, rows)

    def reset(
        self,
        start: Start,
        rows: Rows | None = None,
        *,
        seeds: Sequence[int] | None = None,
        perturbation: Mapping[str, Array] | None = None,
    ) -> CellStep:
        """Put the arms, and their object, at rest at the start of an episode.

        Args:
            start: Start of the episode, in all cells or in `rows`.
            rows: Cells to reset; None: all.
            seeds: Seeds of jitter and loss, one per cell to reset; None: zeros.
            perturbation: Values of `Perturbation` for the cells to reset, (len(rows), ...) each, from this episode on.
        """
        physics = self._open
        rows = np.arange(self.n) if rows is None else rows
        q = np.asarray(start.q_rad, dtype=np.float64).reshape(-1, 2, 6)
        if perturbation:
            for name, value in perturbation.items():
                self._values[name][rows] = value
            self._perturb(rows)
        physics.reset(start, rows)
        self._queue.reset(q, rows, start.widths_m)
        self._delay.reset(q, rows, [0] * len(rows) if seeds is None else seeds)
        if self._scaled is not None:
            self._scaled.reset(q, rows)
        self._reference.reset(q, rows)
        self._elapsed[rows] = 0
        return CellStep(physics.state(self._elapsed * self._tick_s, moved=False))

    def advance(self, command: Command) -> CellStep:
        """Command [now + L, now + L + period), and return the state at the end of [now, now + period).

        A row whose physics diverged keeps its last good state, marked as failed, until a reset.

        Raises:
            ActionError: A width is beyond the gripper's range.
            SettingsError: The command is for grippers, and the cell has none.
        """
        physics, command = self._open, self._queue(command)
        targets = command.targets_rad
        if self._scaled is not None:
            targets = self._scaled(targets)
        if self._delayed:
            targets = self._delay(targets)
        motion = self._reference(targets)
        physics.advance(motion, command.gripper_m, command.payload_kg)
        trace = self._traced(command.targets_rad, motion) if physics.tracing else None
        self._elapsed += self.ticks * ~physics.failed if np.count_nonzero(physics.failed) else self.ticks
        state = physics.state(self._elapsed * self._tick_s, moved=True)
        return CellStep(state, trace=trace, target_q_rad=motion.end_q_rad.reshape(-1, 2, 6))

    def record(self) -> None:
        """Return a trace with every step from now on.

        Raises:
            SettingsError: There are several cells.
        """
        if self.n != 1:
            raise SettingsError(f"{self.n} cells are stepped together: only one alone can be recorded")
        self._open.tracing = True

    def integration_state(self) -> bytes:
        """Return MuJoCo's full state of the first cell."""
        return self._open.integration_state(0)

    def _traced(self, targets: Array, motion: ReferenceMotion) -> TickTrace:
        substeps = self.config.substeps
        after = np.append(motion.q_rad[0], motion.end_q_rad, axis=0)[substeps::substeps]
        trace = self._open.trace
        q, qd = (each[0, substeps - 1 :: substeps].copy() for each in trace) if trace else (np.zeros(0), np.zeros(0))
        return TickTrace(targets[0].copy(), after.reshape(-1, 2, 6), q, qd)

    def finish(self) -> None:
        """Do nothing: a simulation moves only in `advance`."""

    def stop(self, reason: str) -> str:
        """Return "": a simulation moves only in `advance`."""
        return ""

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of one cell for rendering: the same objects at every call, updated."""
        return self._open.model_and_data(row)

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the state of one cell to another model of its scene, and that model's data; see `Cell.copy_state`."""
        self._open.copy_state(row, model, data)

    def close(self) -> None:
        """Release the simulation. May be called twice."""
        self._physics = None

    @property
    def _open(self) -> Physics:
        if self._physics is None:
            raise ClosedError("this cell was closed: make a new one")
        return self._physics

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self._physics is not None:
            self._perturb(np.arange(self.n))
            self._physics.restore()


def make_mujoco_cell(request: CellRequest) -> MujocoCell:
    """Make the simulated cells of a request."""
    return MujocoCell(
        request.config,
        request.ticks,
        n=request.n,
        threads=request.threads,
        latency_ticks=request.latency_ticks,
        varied=request.varied,
        contacts=request.contacts,
    )
