"""Check of the cameras of a cell file: rate, age and a picture of each."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Final, NamedTuple

from dual_ur10.errors import DualUR10Error, LinkError, SettingsError
from dual_ur10.sim2real.cameras.camera_process import START_S, CameraProcess
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, Exposure
from dual_ur10.sim2real.cameras.video_camera import FileCamera
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import CameraEntry, FileCameraEntry, OwnCameraEntry, V4l2CameraEntry
from dual_ur10.sim2real.commissioning.findings import Finding
from ur_core.processes.system import LOCAL, System

OBSERVE_S: Final = 1.5
SIZE: Final = (480, 640)
"""Height and width of images of cameras that have none of their own."""

_POLL_S: Final = 0.005
_RATE: Final = 0.1  # relative deviation of a rate that is none
_CHECK: Final = "check its cable, its settings and what else this machine does"


class CheckedCamera(NamedTuple):
    """Result of the check of a camera.

    Attributes:
        finding: The finding.
        picture: Its newest image; None: there is none.
    """

    finding: Finding
    picture: Exposure | None


def check_cameras(file: CellFile, system: System = LOCAL, *, observe_s: float = OBSERVE_S) -> list[CheckedCamera]:
    """Check all cameras of a cell file at the same time. Nothing moves.

    Args:
        file: The cell file.
        system: Clock, network and processes.
        observe_s: Time for which their images are counted.
    """
    started: list[tuple[CameraEntry, CameraProcess | DualUR10Error]] = []
    try:
        for entry in file.camera:
            try:
                started.append((entry, CameraProcess(_request(entry, file, system))))
            except DualUR10Error as error:
                started.append((entry, error))
        until_s = system.clock.now_s() + START_S
        seen = {entry.name: _Observation(camera) for entry, camera in started if isinstance(camera, CameraProcess)}
        for each in seen.values():
            each.wait(until_s)
        _observe(list(seen.values()), system, observe_s)
        found = []
        for entry, camera in started:
            if isinstance(camera, DualUR10Error):
                found.append(CheckedCamera(_failure(entry, camera), None))
            else:
                found.append(seen[entry.name].result())
        return found
    finally:
        for _, camera in started:
            if isinstance(camera, CameraProcess):
                camera.close()


def _request(entry: CameraEntry, file: CellFile, system: System) -> CameraRequest:
    """Return the request for a camera with images of its own size."""
    size = SIZE
    if isinstance(entry, V4l2CameraEntry | OwnCameraEntry):
        size = entry.height, entry.width
    elif isinstance(entry, FileCameraEntry):
        with FileCamera(CameraRequest(entry=entry, file=file, size=SIZE)) as video:
            size = video.size
    return CameraRequest(entry=entry, file=file, size=size, system=system)


def _failure(entry: CameraEntry, error: DualUR10Error) -> Finding:
    found, _, remedy = str(error).rpartition(": ")
    return Finding("cell", f"camera {entry.name}", "fail", found or remedy, "images", remedy)


class _Observation:
    """Images of one camera while it is observed."""

    def __init__(self, camera: CameraProcess) -> None:
        self._camera, self._times_s, self._ages_s = camera, list[float](), list[float]()
        self._error: DualUR10Error | None = None

    def wait(self, until_s: float) -> None:
        """Wait for the first image."""
        try:
            self._camera.wait_until_ready(until_s)
        except (LinkError, SettingsError) as error:
            self._error = error

    def note(self, now_s: float) -> None:
        """Note the images that are new."""
        last_s = self._times_s[-1] if self._times_s else -1.0
        for at_s in self._camera.memory.times_s:
            if at_s > last_s:
                self._times_s.append(at_s)
                self._ages_s.append(max(0.0, now_s - at_s))

    def result(self) -> CheckedCamera:
        """Return the finding."""
        entry, name = self._camera.request.entry, f"camera {self._camera.request.entry.name}"
        if self._error is None and self._camera.memory.lost:
            self._error = LinkError(self._camera.memory.lost)
        if self._error is not None:
            return CheckedCamera(_failure(entry, self._error), None)
        picture = self._camera.memory.newest(float("inf"))
        height, width = self._camera.request.size
        expected = "images" if isinstance(entry, FileCameraEntry) else f"{entry.rate_hz:g} Hz"
        if len(self._times_s) < 2:
            return CheckedCamera(Finding("cell", name, "fail", "one image", expected, _CHECK), picture)
        rate_hz = (len(self._times_s) - 1) / (self._times_s[-1] - self._times_s[0])
        age_s = statistics.median(self._ages_s[1:])
        found = f"{entry.kind}, {width} × {height}, {rate_hz:.1f} Hz, {1e3 * age_s:.0f} ms old on arrival"
        wanted_hz = rate_hz if isinstance(entry, FileCameraEntry) else entry.rate_hz
        good = abs(rate_hz - wanted_hz) <= _RATE * wanted_hz
        finding = Finding("cell", name, "ok" if good else "warn", found, expected, "" if good else _CHECK)
        return CheckedCamera(finding, picture)


def _observe(cameras: Sequence[_Observation], system: System, observe_s: float) -> None:
    clock = system.clock
    end_s = clock.now_s() + observe_s
    while (now_s := clock.now_s()) < end_s:
        for each in cameras:
            each.note(now_s)
        clock.sleep(_POLL_S)
