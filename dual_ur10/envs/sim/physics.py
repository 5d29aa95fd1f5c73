"""Physics of n cells: arms whose joint servos follow a wanted motion, grippers, and props."""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.assets.scene import build_model
from dual_ur10.envs.sim.feedforward import FeedForward
from dual_ur10.envs.sim.handling import NOT_HANDLED, Handling, Props
from dual_ur10.envs.sim.plant import Plant
from dual_ur10.envs.sim.servo_reference import ReferenceMotion
from dual_ur10.errors import ClosedError, SettingsError
from dual_ur10.sim2real.cell.cell import CellState, Start, check_start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.mjcf.torque_control import TorqueControl, Torques
from ur_core.types import Array, Rows

# Attributes that hold MuJoCo's memory: not pickled, and built anew.
_LIVE = (
    *("_batch", "_flags", "_warnings", "_integration", "_arms_q", "_arms_qd", "_flange"),
    *("_handling", "_props", "_plant", "_feedforward", "_rendered", "_torque"),
)


def _keep_inherited() -> None:
    """Never free MuJoCo's memory in a forked process: it would wait for threads that are not there, and abort."""
    for each in _inherited:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(each._batch))


_inherited: weakref.WeakSet[Physics] = weakref.WeakSet()
os.register_at_fork(after_in_child=_keep_inherited)


class Physics:
    """n simulated cells whose arms follow the motion of their controllers, physics step by physics step.

    Args:
        config: The cell, with a task's equipment.
        n: Number of cells.
        steps: Physics steps per call of `advance`.
        threads: Threads to step on.
        contacts: False to let bodies pass through each other, which saves a third of the time of arms alone.

    Attributes:
        failed: (n,) rows whose physics diverged. They keep their last good state until a reset.
        tracing: True to keep the joint states of every physics step in `trace`.
        trace: Joint positions and speeds of the last `advance`, (n, steps, 2, 6) each; None: not kept.
    """

    tracing = False
    trace: tuple[Array, Array] | None = None

    def __init__(self, config: CellConfig, n: int, steps: int, threads: int, *, contacts: bool = True) -> None:
        self.config, self.n, self.steps, self.threads, self.contacts = config, n, steps, threads, contacts
        self.failed = np.zeros(n, dtype=bool)
        self._build()
        self._good: Array = self._integration.copy()
        self._grippers = self._handling.servos(config, steps) if self._handling else None
        self._payload: Array = np.zeros((n, 2))
        self._held_m: Array = np.zeros((n, 2))  # width of grippers without a command

    def _build(self) -> None:
        import mujoco
        from mujoco.batch import Batch

        scene, n = self.config.scene, self.n
        # All measurements depend on positions, the state, or the last physics step.
        self._stage = int(mujoco.mjtStage.mjSTAGE_POS)
        model = build_model(scene, visuals=False)
        if not self.contacts:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._batch: Any = Batch(model, n, self.threads)
        self._pid = os.getpid()
        _inherited.add(self)
        self._warnings, self._integration = self._batch.warning[:, :, 1], self._batch.state
        # A rollout needs no sensors but those of forces; what follows from positions needs no contacts or constraints.
        disable = mujoco.mjtDisableBit
        self._flags, self._rolling = self._batch.expand("opt.disableflags"), int(model.opt.disableflags)
        self._positions = self._rolling | int(disable.mjDSBL_CONTACT) | int(disable.mjDSBL_CONSTRAINT)
        if not scene.equipment.grippers:
            self._rolling |= int(disable.mjDSBL_SENSOR)
        self._flags[:] = self._rolling
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
        self._props = Props(self._batch, scene.equipment.props)
        dofs = np.concatenate([np.arange(6), joints + np.arange(6)])
        self._plant = Plant(self._batch, scene, dofs)
        self._feedforward = FeedForward(scene, n, self.steps, self.threads)
        stride = joints - 1 if scene.equipment.grippers else joints  # a gripper has one actuator and two joints
        self._torque = [
            TorqueControl(self._batch, arm * stride + np.arange(6), dofs[6 * arm : 6 * arm + 6]) for arm in range(2)
        ]
        self._rendered: tuple[Any, Any] | None = None

    def _check_process(self) -> None:
        """Refuse to wait for threads that a forked process does not have.

        Raises:
            ClosedError: This process was forked from the one that made the simulation, which has several threads.
        """
        if self.threads > 1 and os.getpid() != self._pid:
            raise ClosedError(
                f"this environment has {self.threads} threads in the process {self._pid}, from which this one was "
                'forked without them: make it here, or with threads=1, or start processes with "spawn"'
            )

    def _forward(self, rows: Rows | None = None) -> None:
        """Compute what follows from the positions of `rows`, or of all."""
        self._flags[:] = self._positions
        self._batch.forward(ids=rows, stage=self._stage)
        self._flags[:] = self._rolling

    def _joints(self, values: Array) -> Array:
        joints = 8 if self._handling is not None else 6
        return values[..., : 2 * joints].reshape(*values.shape[:-1], 2, joints)[..., :6]

    def integration_state(self, row: int) -> bytes:
        """Return MuJoCo's full state of one cell: `mjSTATE_INTEGRATION`, as float64."""
        state: bytes = self._integration[row].tobytes()
        return state

    @property
    def model(self) -> Any:
        """MuJoCo's model."""
        return self._batch.model

    def bind(self, name: str) -> Array:
        """Return a view, (n, ...), of one of MuJoCo's arrays, as of the last step or change of positions."""
        view: Array = self._batch.bind(name)
        return view

    def perturb(self, values: Mapping[str, Array], rows: Rows) -> None:
        """Perturb the plant of `rows` by values of `Perturbation.expanded`.

        Raises:
            ClosedError: This process is a fork, and there are several threads.
        """
        self._check_process()
        self._plant.write(values, rows)
        self._feedforward.declare_payload(values["declared_payload_kg"])

    def reset(self, start: Start, rows: Rows) -> None:
        """Put the arms of `rows`, and the props, at rest at the start of an episode.

        Raises:
            ClosedError: This process is a fork, and there are several threads.
            UnknownNameError: The start names a prop or joint that the scene does not have.
        """
        self._check_process()
        check_start(start, self.config.equipment.props)
        self._batch.reset(ids=rows, stage=0)
        self._arms_q[rows] = np.asarray(start.q_rad, dtype=np.float64).reshape(-1, 2, 6)
        if self._handling is not None and self._grippers is not None:
            opening_m = self._handling.reset(start, rows)
            self._held_m[rows] = opening_m if start.commanded_m is None else start.commanded_m
            self._grippers.reset(self._held_m[rows], rows)
        self._props.reset(start, rows)
        self._forward(rows)
        payload_kg = self._payload.copy()  # that of the command before may be the task's
        payload_kg[rows] = 0.0 if start.payload_kg is None else start.payload_kg
        self._payload = payload_kg
        self._good = self._integration.copy()
        self.failed[rows] = False

    def place(self, name: str, pose: Array) -> None:
        """Put a prop of every cell at a pose, (7,), at rest.

        Raises:
            UnknownNameError: There is no such prop, or nothing places it.
        """
        self._props.place(name, pose, self._batch.bind("qvel"))
        self._good = self._integration.copy()
        self._forward()

    def set_joints(self, values: Mapping[str, float]) -> None:
        """Put joints of the props of every cell at positions, rad or m, at rest.

        Raises:
            UnknownNameError: There is no such joint.
        """
        self._props.set_joints(values, self._batch.bind("qvel"))
        self._good = self._integration.copy()
        self._forward()

    def advance(
        self,
        motion: ReferenceMotion,
        gripper_m: Array | None = None,
        payload_kg: Array | None = None,
        torques: Sequence[Torques | None] = (None, None),
    ) -> None:
        """Advance all cells.

        Args:
            motion: Wanted motion of both arms.
            gripper_m: Commanded widths, (n, ticks, 2); None: as they are.
            payload_kg: Declared mass in each gripper, (n, 2); None: as before.
            torques: Torques of each arm, in place of its wanted motion; None: it follows the motion.

        Raises:
            ClosedError: This process is a fork, and there are several threads.
            ActionError: A width is beyond the gripper's range.
            SettingsError: The command is for grippers, and the cell has none.
        """
        self._check_process()
        control = self._control(motion, gripper_m, payload_kg)
        for switch, wanted in zip(self._torque, torques, strict=True):
            switch(control, wanted)
        record = self._batch.rollout(control.shape[1], control, record=("qpos", "qvel") if self.tracing else ())
        if self.tracing:
            self.trace = self._joints(record["qpos"]), self._joints(record["qvel"])
        if self._handling is not None:
            self._handling.feel()
        if np.count_nonzero(self._warnings) or np.count_nonzero(self.failed):
            self.failed |= self._warnings.any(axis=1)
            self._integration[self.failed] = self._good[self.failed]
        np.copyto(self._good, self._integration)
        self._forward()

    def _control(self, motion: ReferenceMotion, commanded: Array | None, payload_kg: Array | None) -> Array:
        """Return the controls of both arms' servos, (n, steps, 12), or with their grippers, (n, steps, 14)."""
        handling, grippers, steps = self._handling, self._grippers, self.steps
        if handling is None or grippers is None:
            if commanded is not None:
                raise SettingsError("a command for grippers was sent to a cell that has none: leave gripper_m out")
            return self._feedforward(motion).reshape(self.n, steps, 12)
        if commanded is None:
            commanded = np.repeat(self._held_m[:, None], steps // self.config.substeps, axis=1)
        widths = grippers(commanded, handling.opening_m)
        before = self._payload
        if payload_kg is not None:
            self._payload = payload_kg
        control = self._feedforward(motion, before, self._payload)
        control[..., 6] = widths
        return control.reshape(self.n, steps, 14)

    def state(self, time_s: Array, *, moved: bool) -> CellState:
        """Return the measurable state.

        Args:
            time_s: (n,) time since the reset.
            moved: True after a step, which gives a force.
        """
        base_m, base_quat, flange_m = self._flange
        handled = self._handling.state(base_quat, self.failed if moved else None) if self._handling else NOT_HANDLED
        return CellState(
            time_s,
            self._arms_q,
            self._arms_qd,
            base_m,
            base_quat,
            flange_m,
            self.failed,
            *handled,
            self._props.objects,
            self._props.joints,
        )

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of one cell for rendering: the same objects at every call, updated."""
        import mujoco

        if self._rendered is None:
            model = build_model(self.config.scene)
            self._rendered = model, mujoco.MjData(model)
        self.copy_state(row, *self._rendered)
        mujoco.mj_forward(*self._rendered)
        return self._rendered

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the state and the true base poses of one cell to another model of its scene, and that model's data.

        Derived quantities are not computed. Threads may call it at the same time, each with a model of its own.
        """
        import mujoco

        self._plant.place_bases(model, row)
        mujoco.mj_setState(model, data, self._integration[row], int(mujoco.mjtState.mjSTATE_INTEGRATION))

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        for name in _LIVE:
            del state[name]
        state["integration"] = self._integration.copy()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._pickled: Array = state.pop("integration")
        self.__dict__.update(state)
        self._build()

    def restore(self) -> None:
        """Restore the pickled state, once the plant is perturbed as before."""
        self._integration[:] = self._pickled
        self._forward()
