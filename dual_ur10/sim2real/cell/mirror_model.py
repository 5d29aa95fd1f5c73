"""Mirror model: a MuJoCo model set to the measured state of real or emulated arms."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from dual_ur10.assets.scene import build_model, sensor_slices
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.sim2real.cell.cell import CellState, Start, check_start
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array


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
        model, props = self._model, scene.equipment.props
        data = self._data
        self._joint_rows = {each: model.joint(f"{p.name}/{each}").qposadr[0] for p in props for each in p.joints}
        self._places: dict[str, tuple[Array, Array]] = {}
        for prop in props:
            if prop.free:
                first = int(model.joint(f"{prop.name}/free").qposadr[0])
                self._places[prop.name] = data.qpos[first : first + 3], data.qpos[first + 3 : first + 7]
            elif prop.placed:
                row = int(model.body(prop.body).mocapid[0])
                self._places[prop.name] = data.mocap_pos[row], data.mocap_quat[row]

    def place(self, objects: Mapping[str, Poses], joints: Mapping[str, float] = MappingProxyType({})) -> None:
        """Put props at poses, position_m (3,) and quat (4,), and their joints at positions. Others stay."""
        for name, pose in objects.items():
            self._places[name][0][:], self._places[name][1][:] = pose.position_m, pose.quat
        for name, value in joints.items():
            self._data.qpos[self._joint_rows[name]] = value

    def start(self, start: Start) -> None:
        """Put all props where an episode begins.

        Raises:
            UnknownNameError: The start names a prop or joint that the scene does not have.
        """
        check_start(start, self._scene.equipment.props)
        self._mujoco.mj_resetData(self._model, self._data)
        poses = {name: np.asarray(pose).reshape(7) for name, pose in start.objects.items()}
        self.place(
            {name: Poses(pose[:3], pose[3:]) for name, pose in poses.items()},
            {name: float(np.asarray(value).reshape(())) for name, value in start.joints.items()},
        )

    def follow(
        self,
        time_s: float,
        q_rad: Array,
        qd_rad_s: Array,
        *,
        gripper_m: Array | None = None,
        wrench: Array | None = None,
    ) -> CellState:
        """Set the arms to a measurement and return the resulting state, with the props where they were placed.

        Args:
            time_s: Time since the episode began.
            q_rad: (2, 6) measured joint positions.
            qd_rad_s: (2, 6) measured joint speeds.
            gripper_m: (2,) measured gripper widths; None: there are no grippers.
            wrench: (2, 6) measured force and torque at the flanges in their `base` frames; None: there are no grippers.
        """
        data, joints = self._data, self._joints
        arms = data.qpos[: 2 * joints].reshape(2, joints)
        arms[:, :6] = q_rad
        if self._gripped and gripper_m is not None:
            arms[:, 6:] = np.asarray(gripper_m)[:, None] / 2
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
            objects={name: Poses(at[None].copy(), quat[None].copy()) for name, (at, quat) in self._places.items()},
            joints={name: data.qpos[row : row + 1].copy() for name, row in self._joint_rows.items()},
        )
        if not self._gripped:
            return state
        return state._replace(
            flange_quat=data.xquat[self._bodies][None].copy(),
            gripper_m=np.array([gripper_m]),
            wrench=np.array([wrench]),
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
