"""The simulated cell: n times two arms in MuJoCo, with the lag of real UR controllers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import build_model
from dual_ur10.envs.feedforward import FeedForward
from dual_ur10.envs.handling import Handling
from dual_ur10.envs.plant import Plant
from dual_ur10.envs.reference import ServojReference, TargetDelay
from dual_ur10.errors import ClosedError, SettingsError
from dual_ur10.sim2real.adapter import Command
from dual_ur10.sim2real.cell import CellConfig, CellState, Start

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

# What belongs to MuJoCo: built anew by unpickling, dropped by close.
_LIVE = ("_batch", "_warnings", "_arms_q", "_arms_qd", "_flange", "_handling", "_plant", "_feedforward", "_drawn")


class MujocoCell:
    """n simulated cells, stepped together.

    One call of `advance` is one rollout of MuJoCo's batch: targets are delayed, the servoj law turns them into motion,
    the joint servos follow with feed-forward, and the state is that of the last instant.

    Args:
        config: The cell, with a task's equipment.
        ticks: Controller ticks per call of `advance`.
        n: Number of cells.
        threads: Threads to step on.
        varied: Names of the values of `Perturbation` that a reset may change. How targets are computed follows from
            them and the configuration alone, so that a row does not depend on what others drew.
    """

    def __init__(
        self, config: CellConfig, ticks: int, *, n: int = 1, threads: int = 1, varied: Collection[str] = ()
    ) -> None:
        self.config, self.ticks, self.n = config, ticks, n
        self.threads = threads
        self.steps = ticks * config.substeps
        self._delay = TargetDelay(n, config.substeps)
        self._reference = ServojReference(config.servoj, n, config.substeps, ticks)
        self._elapsed = np.zeros(n, dtype=np.int64)
        self._failed = np.zeros(n, dtype=bool)
        self._good: Array = np.zeros((n, 0))
        self._tick_s = np.float64(config.servoj.tick_s)
        self._values = config.perturbation.expanded(n)
        late = any(name in varied or self._values[name].any() for name in ("latency_s", "jitter_s", "loss"))
        self._delayed = late
        self._uneven = "lookahead_scale" in varied or len(np.unique(self._values["lookahead_scale"])) > 1
        self._build()
        self._grippers = self._handling.servos(config) if self._handling else None
        self._payload: Array = np.zeros((n, 2))
        self._held_m: Array = np.zeros((n, 2))  # what grippers that are not commanded are held at
        self._perturb(np.arange(n))

    def _build(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        scene, n = self.config.scene, self.n
        # Everything measured is of positions, or part of the state, or of the last physics step.
        self._stage = int(mujoco.mjtStage.mjSTAGE_POS)
        self._batch: Any = Batch(build_model(scene, drawn=False), n, self.threads)
        self._warnings = self._batch.warning[:, :, 1]
        # Views: the arms' joints and, if there are grippers, each arm's two fingers behind its own.
        joints = 8 if scene.equipment.grippers else 6
        qpos, qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._arms_q: Array = qpos[:, : 2 * joints].reshape(n, 2, joints)[..., :6]
        self._arms_qd: Array = qvel[:, : 2 * joints].reshape(n, 2, joints)[..., :6]
        sensors: Array = self._batch.bind("sensordata")
        # Views of the flange sensors, in the order that `assets.scene` documents.
        self._flange = tuple(
            sensors[:, start : start + 2 * size].reshape(n, 2, size) for start, size in ((0, 3), (6, 4), (14, 3))
        )
        self._handling = Handling(self._batch, scene) if scene.equipment.grippers else None
        dofs = np.concatenate([np.arange(6), joints + np.arange(6)])
        self._plant = Plant(self._batch, scene, dofs)
        self._feedforward = FeedForward(scene, n, self.threads)
        self._drawn: tuple[Any, Any] | None = None
        self._closed = False

    def _perturb(self, rows: Rows) -> None:
        """Let the plant of `rows` differ from what is believed of it, as `_values` says."""
        values = self._values
        step_s = self.config.timestep_s or self.config.scene.timestep_s
        self._delay.latency = np.rint(values["latency_s"] / step_s).astype(np.int64)
        self._delay.jitter = np.rint(values["jitter_s"] / step_s).astype(np.int64)
        self._delay.loss = values["loss"]
        self._reference.set_lookahead(values["lookahead_scale"], delayed=self._delayed, uneven=self._uneven)
        self._plant.write(values, rows)
        self._feedforward.declare_payload(values["declared_payload_kg"])

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
        self._check_open()
        rows = np.arange(self.n) if rows is None else rows
        q = np.asarray(start.q_rad, dtype=np.float64).reshape(-1, 2, 6)
        if perturbation:
            for name, value in perturbation.items():
                self._values[name][rows] = value
            self._perturb(rows)
        self._batch.reset(ids=rows, stage=0)
        self._arms_q[rows] = q
        if self._handling is not None and self._grippers is not None:
            self._held_m[rows] = self._handling.reset(start, rows)
            self._grippers.reset(self._held_m[rows], rows)
        self._batch.forward(ids=rows, stage=self._stage)
        self._delay.reset(q, rows, [0] * len(rows) if seeds is None else seeds)
        self._reference.reset(q, rows)
        self._payload[rows] = 0.0
        self._good = self._batch.state.copy()
        self._elapsed[rows] = 0
        self._failed[rows] = False
        return self._state()

    def advance(self, command: Command) -> CellState:
        """Send one control period and return the state at its end.

        A row whose physics diverged stays where it was last well, marked as failed, until it is reset.

        Raises:
            ActionError: A gripper is asked for an opening that it does not have.
            SettingsError: The command is for grippers, and the cell has none.
        """
        self._check_open()
        batch = self._batch
        batch.rollout(self.steps, self._control(command), record=())
        if self._handling is not None:
            self._handling.feel()
        if np.logical_or.reduce(self._warnings, axis=None) or np.logical_or.reduce(self._failed):
            self._failed |= self._warnings.any(axis=1)
            batch.state[self._failed] = self._good[self._failed]
        self._elapsed += self.ticks * ~self._failed
        self._good = batch.state.copy()
        batch.forward(stage=self._stage)
        return self._state(moved=True)

    def _arm_control(self, targets: Array, payload_kg: Array | None) -> Array:
        """Controls of the arms' servos, (n, steps, 12), from the targets sent, (n, ticks, 2, 6)."""
        if self._delayed:
            targets = self._delay(targets)
        return self._feedforward(*self._reference(targets), payload_kg)

    def _control(self, command: Command) -> Array:
        """Controls of both arms' servos, (n, steps, 12), or with their grippers, (n, steps, 14)."""
        handling, grippers, commanded = self._handling, self._grippers, command.gripper_m
        if handling is None or grippers is None:
            if commanded is not None:
                raise SettingsError("a command for grippers was sent to a cell that has none: leave gripper_m out")
            return self._arm_control(command.targets_rad, None)
        opening = handling.opening_m
        if commanded is None:
            commanded = np.repeat(self._held_m[:, None], self.ticks, axis=1)
        control = np.empty((self.n, self.steps, 2, 7))
        control[..., 6] = grippers(commanded, opening)
        before, self._payload = self._payload, self._payload if command.payload_kg is None else command.payload_kg
        payload = None
        if before.any() or self._payload.any():
            share = np.arange(1, self.steps + 1)[:, None] / self.steps
            payload = before[:, None] + share * (self._payload - before)[:, None]
        control[..., :6] = self._arm_control(command.targets_rad, payload).reshape(self.n, self.steps, 2, 6)
        return control.reshape(self.n, self.steps, 14)

    def _state(self, *, moved: bool = False) -> CellState:
        base_m, base_quat, flange_m = self._flange
        return CellState(
            self._elapsed * self._tick_s,
            self._arms_q,
            self._arms_qd,
            base_m,
            base_quat,
            flange_m,
            self._failed,
            *(
                self._handling.state(base_quat, np.flatnonzero(~self._failed) if moved else None)
                if self._handling
                else ()
            ),
        )

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's model and data of one cell, to be drawn: the same objects at every call, brought up to date."""
        import mujoco

        self._check_open()
        if self._drawn is None:
            model = build_model(self.config.scene)
            self._drawn = model, mujoco.MjData(model)
        model, data = self._drawn
        # The drawn model has more geoms and the same state, and stands where the bases truly are.
        self._plant.place_bases(model, row)
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
        self._perturb(np.arange(self.n))
        self._batch.state[:] = integration
        self._batch.forward(stage=self._stage)
