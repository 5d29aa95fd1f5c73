"""Grippers and what they handle, in a batch of models: where they are, and what the controllers feel of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dual_ur10.assets.scene import sensor_slices
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.sim.feedforward import GRAVITY_M_S2
from dual_ur10.envs.sim.grippers import GripperServos
from dual_ur10.kinematics.rotations import quat_to_matrix
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import CellConfig, Start
from dual_ur10.types import Array, Rows

_SLACK = 1.5  # of the way that the servo's reference must lead by for full force

_HELD_M = 0.04  # opening of grippers that are welded to the bar


class Handled(NamedTuple):
    """The part of `CellState` that is about grippers and what they handle."""

    flange_quat: Array
    gripper_m: Array
    wrench: Array
    object_m: Array | None
    object_quat: Array | None
    target_m: Array | None
    target_quat: Array | None


class Handling:
    """Reads and sets grippers, object and target of n cells.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        settings: A scene with grippers.
    """

    def __init__(self, batch: Any, settings: SceneSettings) -> None:
        model, n = batch.model, batch.nsim
        self.n, self._settings = n, settings
        qpos = batch.bind("qpos")
        self._fingers: Array = qpos[:, :16].reshape(n, 2, 8)[..., 6:]
        self._object: Array | None = qpos[:, 16:23] if settings.equipment.prop else None
        self._target: tuple[Array, Array] | None = None
        if model.nmocap:
            self._target = batch.bind("mocap_pos")[:, 0], batch.bind("mocap_quat")[:, 0]
        where = sensor_slices(model)
        sensors: Array = batch.bind("sensordata")
        first = where["left/wrench_force"].start
        self._forces: Array = sensors[:, first : first + 12].reshape(n, 2, 2, 3)
        self._bodies = [model.body(f"{arm}/gripper").id for arm in ARMS]
        self._orientations: Array = batch.bind("xquat")
        self._mass_kg, self._lever_m = _weight(model)
        self._kp = float(model.actuator("left/gripper").gainprm[0])
        self._felt: Array = np.zeros((n, 2, 2, 3))
        self._wrench: Array = np.zeros((n, 2, 6))

    def servos(self, config: CellConfig) -> GripperServos:
        """The controllers of the grippers."""
        slack_m = _SLACK * config.equipment.grip_force_n / self._kp
        return GripperServos(self.n, config.servoj.tick_s, config.substeps, slack_m)

    @property
    def opening_m(self) -> Array:
        """(n, 2) where the fingers are."""
        opening: Array = np.add.reduce(self._fingers, axis=2)
        return opening

    def reset(self, start: Start, rows: Rows) -> Array:
        """Put fingers, object and target of `rows` where an episode begins. Returns the openings, (len(rows), 2)."""
        opening = np.full((len(rows), 2), _HELD_M) if start.gripper_m is None else np.asarray(start.gripper_m)
        self._fingers[rows] = opening[..., None] / 2
        self._wrench[rows] = 0.0
        if self._object is not None and start.object_pose is not None:
            self._object[rows] = start.object_pose
        if self._target is not None and start.target_pose is not None:
            self._target[0][rows], self._target[1][rows] = start.target_pose[:, :3], start.target_pose[:, 3:]
        return opening

    def place(self, pose: Array) -> None:
        """Put the object of every cell at a pose, (7,)."""
        if self._object is not None:
            self._object[:] = pose

    def feel(self) -> None:
        """Read the forces of the last physics step; to be called before anything else is computed.

        Stages of the batch that stop before accelerations leave in the sensors of forces what any cell felt last.
        """
        # The sensors give what the wrist does to the gripper.
        self._felt = -self._forces.swapaxes(1, 2)

    def state(self, flange_base_quat: Array, moved: Rows | None) -> Handled:
        """What can be measured.

        Args:
            flange_base_quat: (n, 2, 4) orientation of the flanges in the arms' `base` frames.
            moved: The rows that have just made a step, so that there is a force to be read; None: none.
        """
        if moved is not None:
            rotation = quat_to_matrix(flange_base_quat)
            felt = self._felt @ rotation.swapaxes(2, 3)
            # Bases stand upright: their z is against gravity.
            weight = np.zeros((self.n, 2, 2, 3))
            weight[..., 0, 2] = -self._mass_kg * GRAVITY_M_S2
            lever = rotation @ self._lever_m
            weight[..., 1, 0], weight[..., 1, 1] = lever[..., 1], -lever[..., 0]
            weight[..., 1, :2] *= -self._mass_kg * GRAVITY_M_S2
            self._wrench[moved] = (felt - weight).reshape(self.n, 2, 6)[moved]
        target = (None, None) if self._target is None else self._target
        thing = (None, None) if self._object is None else (self._object[:, :3], self._object[:, 3:])
        return Handled(self._orientations[:, self._bodies], self.opening_m, self._wrench.copy(), *thing, *target)


def _weight(model: Any) -> tuple[float, Array]:
    """Mass of a gripper, and its centre in the flange's frame, (3,), with half open fingers on its axis."""
    mass, moment = 0.0, np.zeros(3)
    for name in ("gripper", "finger_1", "finger_2"):
        body = model.body(f"left/{name}")
        mass += float(body.mass[0])
        # The fingers' offsets across the axis cancel.
        moment += float(body.mass[0]) * body.ipos * (name == "gripper" or np.array([1.0, 0.0, 1.0]))
    return mass, moment / mass
