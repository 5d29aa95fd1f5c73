"""The simulated cell: n times two arms in MuJoCo, with the lag of real UR controllers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.physics import Physics
from dual_ur10.envs.reference import ServojReference, TargetDelay
from dual_ur10.errors import ClosedError
from dual_ur10.sim2real.adapter import Command
from dual_ur10.sim2real.cell import CellConfig, CellState, Start
from dual_ur10.sim2real.command_queue import CommandQueue

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


class MujocoCell:
    """n simulated cells, stepped together.

    One call of `advance` is one rollout of MuJoCo's batch: targets are delayed, the servoj law turns them into motion,
    the joint servos follow with feed-forward, and the state is that of the last instant.

    Args:
        config: The cell, with a task's equipment.
        ticks: Controller ticks per call of `advance`.
        n: Number of cells.
        threads: Threads to step on.
        latency_ticks: L: what is commanded acts so many ticks later.
        varied: Names of the values of `Perturbation` that a reset may change. How targets are computed follows from
            them and the configuration alone, so that a row does not depend on what others drew.
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
    ) -> None:
        self.config, self.ticks, self.n = config, ticks, n
        self.threads = threads
        self.steps = ticks * config.substeps
        self._queue = CommandQueue(n, latency_ticks)
        self._delay = TargetDelay(n, config.substeps)
        self._reference = ServojReference(config.servoj, n, config.substeps, ticks)
        self._elapsed = np.zeros(n, dtype=np.int64)
        self._tick_s = np.float64(config.servoj.tick_s)
        self._values = config.perturbation.expanded(n)
        late = any(name in varied or self._values[name].any() for name in ("latency_s", "jitter_s", "loss"))
        self._delayed = late
        self._uneven = "lookahead_scale" in varied or len(np.unique(self._values["lookahead_scale"])) > 1
        self._physics: Physics | None = Physics(config, n, threads)
        self._perturb(np.arange(n))

    def _perturb(self, rows: Rows) -> None:
        """Let the plant of `rows` differ from what is believed of it, as `_values` says."""
        values = self._values
        step_s = self.config.timestep_s or self.config.scene.timestep_s
        self._delay.latency = np.rint(values["latency_s"] / step_s).astype(np.int64)
        self._delay.jitter = np.rint(values["jitter_s"] / step_s).astype(np.int64)
        self._delay.loss = values["loss"]
        self._reference.set_lookahead(values["lookahead_scale"], delayed=self._delayed, uneven=self._uneven)
        self._open.perturb(values, rows)

    def reset(
        self,
        start: Start,
        rows: Rows | None = None,
        *,
        seeds: Sequence[int] | None = None,
        perturbation: Mapping[str, Array] | None = None,
    ) -> CellState:
        """Put the arms, and what they handle, to rest where an episode begins.

        Args:
            start: How it begins, in all cells or in `rows`.
            rows: The cells to reset; None: all.
            seeds: One per cell to reset, of the jitter and loss that follow; None: zeros.
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
        self._queue.reset(q, rows, start.gripper_m)
        self._delay.reset(q, rows, [0] * len(rows) if seeds is None else seeds)
        self._reference.reset(q, rows)
        self._elapsed[rows] = 0
        return physics.state(self._elapsed * self._tick_s, moved=False)

    def advance(self, command: Command) -> CellState:
        """Command [now + L, now + L + period), and return the state at the end of [now, now + period).

        A row whose physics diverged stays where it was last well, marked as failed, until it is reset.

        Raises:
            ActionError: A gripper is asked for an opening that it does not have.
            SettingsError: The command is for grippers, and the cell has none.
        """
        physics, command = self._open, self._queue(command)
        targets = command.targets_rad
        if self._delayed:
            targets = self._delay(targets)
        physics.advance(self._reference(targets), command.gripper_m, command.payload_kg)
        self._elapsed += self.ticks * ~physics.failed
        return physics.state(self._elapsed * self._tick_s, moved=True)

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's model and data of one cell, to be drawn: the same objects at every call, brought up to date."""
        return self._open.model_and_data(row)

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
