"""The simulated cell: n times two arms in MuJoCo, with the lag of real UR controllers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import build_model
from dual_ur10.envs.feedforward import FeedForward
from dual_ur10.envs.payload import write_masses
from dual_ur10.envs.reference import ServojReference, TargetDelay
from dual_ur10.errors import ClosedError
from dual_ur10.sim2real.adapter import Command
from dual_ur10.sim2real.cell import CellConfig, CellState, Perturbation

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

# What belongs to MuJoCo: built anew by unpickling, dropped by close.
_LIVE = ("_batch", "_warnings", "_qpos", "_qvel", "_flange", "_feedforward", "_drawn")

_ARM = slice(0, 12)  # joints of both arms come first in the model, which `assets.scene` checks


class MujocoCell:
    """n simulated cells, stepped together.

    One call of `advance` is one rollout of MuJoCo's batch: targets are delayed, the servoj law turns them into motion,
    the joint servos follow with feed-forward, and the state is that of the last instant.

    Args:
        config: The cell.
        ticks: Controller ticks per call of `advance`.
        n: Number of cells.
        threads: Threads to step on.
    """

    def __init__(self, config: CellConfig, ticks: int, *, n: int = 1, threads: int = 1) -> None:
        self.config, self.ticks, self.n = config, ticks, n
        self.threads = threads
        self.steps = ticks * config.substeps
        self._delay = TargetDelay(n, config.substeps)
        self._reference = ServojReference(config.servoj, n, config.substeps, ticks)
        self._elapsed = np.zeros(n, dtype=np.int64)
        self._failed = np.zeros(n, dtype=bool)
        self._good: Array = np.zeros((n, 0))
        self._tick_s = np.float64(config.servoj.tick_s)
        self._build()
        self.perturb(config.perturbation)

    def _build(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        scene = self.config.scene
        # Everything measured is of positions, or part of the state.
        self._stage = int(mujoco.mjtStage.mjSTAGE_POS)
        self._batch: Any = Batch(build_model(scene, drawn=False), self.n, self.threads)
        self._warnings = self._batch.warning[:, :, 1]
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        sensors: Array = self._batch.bind("sensordata")
        # Views of the flange sensors, in the order that `assets.scene` documents.
        self._flange = tuple(
            sensors[:, start : start + 2 * size].reshape(self.n, 2, size) for start, size in ((0, 3), (6, 4), (14, 3))
        )
        self._feedforward = FeedForward(scene, self.n, self.threads)
        self._drawn: tuple[Any, Any] | None = None
        # Whether the batch has values of its own for each cell, which cost a little and are then kept up.
        self._own_masses = self._own_friction = False
        self._closed = False

    def perturb(self, perturbation: Perturbation) -> None:
        """Let the plant differ from what is believed of it. To be followed by a reset of all rows."""
        self.perturbation = perturbation
        values = perturbation.expanded(self.n)
        step_s = self.config.timestep_s
        self._delay.latency = np.rint(values["latency_s"] / step_s).astype(np.int64)
        self._delay.jitter = np.rint(values["jitter_s"] / step_s).astype(np.int64)
        self._delay.loss = values["loss"]
        self._reference.set_lookahead(values["lookahead_scale"], delayed=not self._delay.is_none)
        nominal = Perturbation().expanded(self.n)
        masses = ("mass_scale", "payload_kg", "declared_payload_kg")
        if self._own_masses or any((values[key] != nominal[key]).any() for key in masses):
            self._own_masses = True
            write_masses(self._batch, *(values[key] for key in masses))
            self._feedforward.declare_payload(values["declared_payload_kg"])
        if self._own_friction or values["friction_nm"].any():
            self._own_friction = True
            self._batch.expand("dof_frictionloss")[:, _ARM] = values["friction_nm"].reshape(self.n, 12)

    def reset(self, q_rad: Array, rows: Rows | None = None, *, seeds: Sequence[int] | None = None) -> CellState:
        """Put the arms to rest at `q_rad`.

        Args:
            q_rad: (n, 2, 6), or (len(rows), 2, 6).
            rows: The cells to reset; None: all.
            seeds: One per cell to reset, of the jitter and loss that follow; None: zeros.
        """
        self._check_open()
        rows = np.arange(self.n) if rows is None else rows
        q = np.asarray(q_rad, dtype=np.float64).reshape(-1, 2, 6)
        self._batch.reset(ids=rows, stage=0)
        self._qpos[rows, _ARM] = q.reshape(-1, 12)
        self._batch.forward(ids=rows, stage=self._stage)
        self._delay.reset(q, rows, [0] * len(rows) if seeds is None else seeds)
        self._reference.reset(q, rows)
        self._good = self._batch.state.copy()
        self._elapsed[rows] = 0
        self._failed[rows] = False
        return self._state()

    def advance(self, command: Command) -> CellState:
        """Send the targets of one control period, (n, ticks, 2, 6), and return the state at its end.

        A row whose physics diverged stays where it was last well, marked as failed, until it is reset.
        """
        self._check_open()
        batch, targets = self._batch, command.targets_rad
        if not self._delay.is_none:
            targets = self._delay(targets)
        batch.rollout(self.steps, self._feedforward(*self._reference(targets)), record=())
        if np.logical_or.reduce(self._warnings, axis=None) or np.logical_or.reduce(self._failed):
            self._failed |= self._warnings.any(axis=1)
            batch.state[self._failed] = self._good[self._failed]
        self._elapsed += self.ticks * ~self._failed
        self._good = batch.state.copy()
        batch.forward(stage=self._stage)
        return self._state()

    def _state(self) -> CellState:
        base_m, base_quat, flange_m = self._flange
        return CellState(
            time_s=self._elapsed * self._tick_s,
            q_rad=self._qpos[:, _ARM].reshape(self.n, 2, 6),
            qd_rad_s=self._qvel[:, _ARM].reshape(self.n, 2, 6),
            flange_base_m=base_m,
            flange_base_quat=base_quat,
            flange_m=flange_m,
            failed=self._failed,
        )

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's model and data of one cell, to be drawn: the same objects at every call, brought up to date."""
        import mujoco

        self._check_open()
        if self._drawn is None:
            model = build_model(self.config.scene)
            self._drawn = model, mujoco.MjData(model)
        model, data = self._drawn
        # The drawn model has more geoms and the same state.
        mujoco.mj_setState(model, data, self._batch.state[row], int(mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_forward(model, data)
        return model, data

    def close(self) -> None:
        """Release the simulation. May be called twice."""
        self._closed = True
        for name in _LIVE:
            setattr(self, name, None)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("this cell was closed: make a new one")

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in _LIVE:
            del state[name]
        state["integration"] = None if self._closed else self._batch.state.copy()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        integration = state.pop("integration")
        self.__dict__.update(state)
        if integration is None:
            self.close()
            return
        self._build()
        self.perturb(self.perturbation)
        self._batch.state[:] = integration
        self._batch.forward(stage=self._stage)
