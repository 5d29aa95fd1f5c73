"""Record of all cameras of a cell beside a run: those that are observed, and those that nothing observes."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from dual_ur10.errors import DualUR10Error, LinkError
from dual_ur10.sim2real.cameras.camera_process import START_S, CameraProcess
from dual_ur10.sim2real.cameras.camera_set import CameraSet
from dual_ur10.sim2real.cameras.camera_source import CameraRequest
from dual_ur10.sim2real.cameras.video_record import video_name
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from ur_core.processes.system import LOCAL, System
from ur_core.types import Closing

log = logging.getLogger(__name__)

NOTE: Final = "camera"
"""Kind of the event of a camera that is not recorded."""

_SIZE: Final = (480, 640)  # of images of cameras that have none of their own


class CameraRecord(Closing):
    """Videos of the cameras of a cell. No camera and no video that fails stops a run: it is noted.

    Cameras of the cell file that nothing observes are opened for the record alone. Nothing waits for them.

    Args:
        file: Cell file.
        observed: Observed cameras, which are open; None: there are none.
        folder: Existing folder of the run.
        begin_s: Zero of the run's clock on the system's clock.
        note: Called with the kind and the text of an event.
        system: Clock, network and processes.
    """

    def __init__(
        self,
        file: CellFile,
        observed: CameraSet | None,
        folder: Path,
        begin_s: float,
        note: Callable[[str, str], None],
        *,
        system: System = LOCAL,
    ) -> None:
        self._clock, self._note = system.clock, note
        self._observed = () if observed is None else observed.processes
        self._begun_s = self._clock.now_s()
        self._noted: list[CameraProcess] = []
        self._others: list[CameraProcess] = []
        seen = {each.request.entry.name for each in self._observed}
        with contextlib.ExitStack() as made:
            for entry in file.camera:
                if entry.name in seen:
                    continue
                request = CameraRequest(entry=entry, file=file, size=_SIZE, observed=False, system=system)
                try:
                    self._others.append(made.enter_context(CameraProcess(request)))
                except DualUR10Error as error:
                    self._say(request.where, str(error))
            for each in (*self._observed, *self._others):
                each.memory.record(str(folder.resolve() / video_name(each.request.entry.name)), begin_s)
            made.pop_all()

    def poll(self) -> None:
        """Note each camera that is not recorded, once. It does not wait."""
        for each in (*self._observed, *self._others):
            if each not in self._noted and (problem := self._problem(each)):
                self._noted.append(each)
                self._say(each.where, problem)

    def _problem(self, camera: CameraProcess) -> str:
        failure, now_s = camera.memory.failure or camera.memory.lost, self._clock.now_s()
        starts = not camera.memory.count and now_s - self._begun_s < START_S
        if failure or starts or camera in self._observed:  # what is observed stops the arms where it stalls
            return failure
        try:
            camera.newest(now_s)
        except LinkError as error:
            return str(error)
        return ""

    def _say(self, where: str, problem: str) -> None:
        text = f"{where} is not recorded: {problem}"
        log.warning("%s. The run goes on", text)
        self._note(NOTE, text)

    def close(self) -> None:
        """End the cameras that nothing observes. May be called twice."""
        for each in self._others:
            each.memory.end()  # all at once, before the first is waited for
        for each in self._others:
            each.close()
