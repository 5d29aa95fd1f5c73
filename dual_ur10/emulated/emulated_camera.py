"""Camera in the world of an emulated cell: images of the positions that its simulation reports."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.visuals import cameras
from dual_ur10.emulated.cell_world import scene_of
from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.errors import LinkError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, CameraSource, Exposure
from dual_ur10.sim2real.cell_file.tables import EmulatedCameraEntry
from ur_core.links.json_link import JsonLink

_ANSWER_S: Final = 2.0


class _Positions(BaseModel):
    """Answer of the emulated cell."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    qpos: Annotated[list[float], Field(max_length=10_000)]
    mocap: Annotated[list[Annotated[list[float], Field(min_length=7, max_length=7)]], Field(max_length=1000)]
    at_s: float


class EmulatedCamera(CameraSource):
    """Camera of the scene that an emulated cell simulates, with nominal arms.

    Its images are those of a simulation at the same positions. The time of exposure is that of the control period to
    which the positions belong.

    Args:
        request: The request.

    Raises:
        SettingsError: The cell file has no table [emulator].
        UnknownNameError: The scene that is simulated has no such camera.
        RenderError: No OpenGL backend was found.
    """

    def __init__(self, request: CameraRequest) -> None:
        import mujoco

        entry, emulator = request.entry, request.file.emulator
        if not isinstance(entry, EmulatedCameraEntry) or emulator is None:
            raise SettingsError(f"{request.where}: the camera of an emulated cell needs the table [emulator]")
        config, _ = scene_of(request.file.config(), *(request.file.emulated_scene or (None,)))
        equipment = config.equipment
        config = dataclasses.replace(
            config, equipment=dataclasses.replace(equipment, cameras=(*equipment.cameras, *request.views))
        )
        if entry.name not in (known := cameras(config.scene)):
            raise UnknownNameError("camera of the emulated cell", entry.name, list(known))
        self._name, self._where, self._clock = entry.name, request.where, request.system.clock
        self._model = build_model(config.scene)
        self._data = mujoco.MjData(self._model)
        self._canvas = Canvas(self._model, request.size[1], request.size[0])
        self._link = JsonLink(
            "emulated camera", request.file.left.host, emulator.port, _ANSWER_S, system=request.system
        )
        self._period_s, self._due_s = 1.0 / entry.rate_hz, self._clock.now_s()

    def read(self) -> Exposure:
        """See `CameraSource`. Images that are late are left out."""
        import mujoco

        now_s = self._clock.now_s()
        self._clock.sleep(self._due_s - now_s)
        self._due_s = max(self._due_s, now_s) + self._period_s
        found = self._link.ask("positions")
        try:
            positions = _Positions.model_validate(found)
        except ValidationError:
            raise LinkError(f"{self._where}: found {found!r:.200}; expected are positions: check the port") from None
        data = self._data
        shape = len(positions.qpos), len(positions.mocap)
        if shape != (self._model.nq, self._model.nmocap):
            raise LinkError(
                f"{self._where}: the cell has {shape[0]} positions and {shape[1]} placed bodies, and its scene "
                f"{self._model.nq} and {self._model.nmocap}: let `emulate --cell` write the cell file anew"
            )
        data.qpos[:] = positions.qpos
        if shape[1]:
            mocap = np.array(positions.mocap)
            data.mocap_pos[:], data.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        return Exposure(self._canvas.image(data, self._name), positions.at_s)

    def close(self) -> None:
        """See `CameraSource`."""
        self._link.close()
        self._canvas.close()
