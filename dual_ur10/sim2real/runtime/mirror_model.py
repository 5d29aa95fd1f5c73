"""Mirror model: a MuJoCo model set to the measured state of real or emulated arms."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import CellState
from dual_ur10.types import Array

Pose = tuple[Array, Array]


class MirrorModel:
    """Derives the state of a cell from measurements, without simulating it.

    Args:
        scene: Both arms with their grippers and objects.
    """

    def __init__(self, scene: SceneSettings) -> None:
        import mujoco

        self._scene, self._mujoco = scene, mujoco
        self._model = build_model(scene, visuals=False)
        self._data = mujoco.MjData(self._model)
        self._rendered: tuple[Any, Any] | None = None
        where = sensor_slices(self._model)
        names = ("flange_base_pos", "flange_base_quat", "flange_pos")
        self._flanges = [np.r_[*(where[f"{arm}/{name}"] for arm in ARMS)] for name in names]
        self._gripped = scene.equipment.grippers
        self._joints = 8 if self._gripped else 6
        self._bodies = [self._model.body(f"{arm}/gripper").id for arm in ARMS] if self._gripped else []
        self._target: Pose | None = None

    def aim(self, target: Pose | None) -> None:
        """Set the pose of the task's target: position (3,) and orientation (4,); None: there is none."""
        self._target = target

    def follow(
        self,
        time_s: float,
        q_rad: Array,
        qd_rad_s: Array,
        *,
        gripper_m: Array | None = None,
        wrench: Array | None = None,
        thing: Pose | None = None,
    ) -> CellState:
        """Set the model to a measurement and return the resulting state.

        Args:
            time_s: Time since the episode began.
            q_rad: (2, 6) measured joint positions.
            qd_rad_s: (2, 6) measured joint speeds.
            gripper_m: (2,) measured gripper widths; None: there are no grippers.
            wrench: (2, 6) measured force and torque at the flanges in their `base` frames; None: there are no grippers.
            thing: Measured pose of the object; None: there is none.
        """
        data, joints = self._data, self._joints
        arms = data.qpos[: 2 * joints].reshape(2, joints)
        arms[:, :6] = q_rad
        if self._gripped and gripper_m is not None:
            arms[:, 6:] = np.asarray(gripper_m)[:, None] / 2
        if thing is not None and self._scene.equipment.prop:
            data.qpos[-7:] = np.concatenate(thing)
        if self._target is not None and self._model.nmocap:
            data.mocap_pos[0], data.mocap_quat[0] = self._target
        self._mujoco.mj_kinematics(self._model, data)
        self._mujoco.mj_comPos(self._model, data)
        self._mujoco.mj_sensorPos(self._model, data)
        base_m, base_quat, flange_m = (data.sensordata[each].reshape(1, 2, -1).copy() for each in self._flanges)
        state = CellState(
            np.array([time_s]),
            np.array([q_rad]),
            np.array([qd_rad_s]),
            base_m,
            base_quat,
            flange_m,
            np.zeros(1, dtype=bool),
        )
        if not self._gripped:
            return state
        return state._replace(
            flange_quat=data.xquat[self._bodies][None].copy(),
            gripper_m=np.array([gripper_m]),
            wrench=np.array([wrench]),
            object_m=None if thing is None else np.array([thing[0]]),
            object_quat=None if thing is None else np.array([thing[1]]),
            target_m=None if self._target is None else np.array([self._target[0]]),
            target_quat=None if self._target is None else np.array([self._target[1]]),
        )

    def model_and_data(self) -> tuple[Any, Any]:
        """Return the MuJoCo model and data for rendering: the same objects at every call, updated."""
        if self._rendered is None:
            model = build_model(self._scene)
            self._rendered = model, self._mujoco.MjData(model)
        self.copy_state(*self._rendered)
        self._mujoco.mj_forward(*self._rendered)
        return self._rendered

    def copy_state(self, model: Any, data: Any) -> None:
        """Copy the measured positions to another model of this scene, and that model's data."""
        data.qpos[:] = self._data.qpos
        if model.nmocap:
            data.mocap_pos[:], data.mocap_quat[:] = self._data.mocap_pos, self._data.mocap_quat
