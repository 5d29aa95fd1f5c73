"""Cameras that an environment observes on a cell of controllers."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

from dual_ur10.assets.visuals import cameras as camera_names
from dual_ur10.errors import CellFileError, UnknownNameError
from dual_ur10.sim2real.cameras.camera_memory import described
from dual_ur10.sim2real.cameras.camera_process import CameraProcess, ready
from dual_ur10.sim2real.cameras.camera_source import CameraRequest
from dual_ur10.sim2real.cell.cell import SeenImage
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import CameraEntry, EmulatedCameraEntry
from ur_core.mjcf.camera import Camera
from ur_core.processes.system import LOCAL, System
from ur_core.types import Closing


class CameraSet(Closing):
    """Cameras by name. Construction opens them, and waits until each has an image.

    Args:
        file: Cell file. That of an emulated cell need not name cameras: it has those of its scene.
        config: The cell, with the scene that names the cameras.
        names: Names of the cameras that are observed.
        size: Height and width of the images.
        views: Cameras that the program added to the scene.
        system: Clock, network and processes.

    Attributes:
        seen: Newest image of each at the last `look`.
        looked_s: Time of that.

    Raises:
        UnknownNameError: The scene has no such camera.
        CellFileError: The file of a real cell does not name one of them.
        SettingsError: A camera of one's own cannot be made.
        LinkError: One cannot be opened, or sends no image in time.
    """

    def __init__(
        self,
        file: CellFile,
        config: CellConfig,
        names: Sequence[str],
        size: tuple[int, int],
        *,
        views: tuple[Camera, ...] = (),
        system: System = LOCAL,
    ) -> None:
        known = camera_names(config.scene)
        for name in names:
            if name not in known:
                raise UnknownNameError("camera", name, list(known))
        entries = [entry_of(file, name) for name in names]
        self.seen: Mapping[str, SeenImage] = {}
        self.looked_s = system.clock.now_s()
        self._cameras: list[CameraProcess] = []
        with contextlib.ExitStack() as made:
            for entry in entries:
                request = CameraRequest(entry=entry, file=file, size=size, views=views, system=system)
                self._cameras.append(made.enter_context(CameraProcess(request)))
            ready(self._cameras)
            made.pop_all()

    def look(self, now_s: float) -> None:
        """Take the newest image of each camera that is not newer than a time. It does not wait.

        Raises:
            LinkError: One was lost, or stalls.
        """
        self.seen = {each.request.entry.name: SeenImage(*each.newest(now_s)) for each in self._cameras}
        self.looked_s = now_s

    @property
    def memories(self) -> tuple[str, ...]:
        """Texts from which a live page opens their memories."""
        return tuple(described(each.request.entry.name, each.memory) for each in self._cameras)

    @property
    def processes(self) -> Sequence[CameraProcess]:
        """Cameras with their processes, in the order of their names."""
        return tuple(self._cameras)

    def close(self) -> None:
        """End all of them. May be called twice."""
        for each in self._cameras:
            each.memory.end()  # all at once, before the first is waited for
        for each in self._cameras:
            each.close()


def entry_of(file: CellFile, name: str) -> CameraEntry:
    """Return the table of a camera, or, in an emulated cell without one, that of the camera of its scene.

    Raises:
        CellFileError: The file does not name it.
    """
    for entry in file.camera:
        if entry.name == name:
            return entry
    if file.emulator is not None:
        return EmulatedCameraEntry(name=name)
    raise CellFileError(
        f"{file.source}: the camera {name!r} is observed, and nothing says what takes its images: add a table "
        f'[[camera]] with name = "{name}" and the kind "v4l2", "file", "pattern" or "own"'
        + (", or a table [emulator]" if file.kind == "emulated" else "")
    )
