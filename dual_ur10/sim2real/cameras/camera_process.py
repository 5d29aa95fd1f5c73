"""Process of one camera, and the program's side of it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import DualUR10Error, LinkError
from dual_ur10.sim2real.cameras.camera_memory import CameraMemory
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, CameraSource, Exposure, source_of, source_type
from dual_ur10.sim2real.cameras.image_size import check_fits, resized
from dual_ur10.sim2real.cameras.video_record import VideoRecord
from dual_ur10.sim2real.cell_file.tables import FileCameraEntry
from ur_core.processes.system import LOCAL, Process, System
from ur_core.types import Closing

START_S: Final = 20.0
"""Time limit of the first image. OpenGL takes seconds to start."""

STALE_S: Final = 0.5
"""Largest age of an image, unless three periods of the camera are longer; those of a video file are not known."""

_STALE_PERIODS: Final = 3.0
_END_S: Final = 1.0
_POLL_S: Final = 0.01
_GUARD_S: Final = 0.2
_RELEASE_S: Final = 0.3  # for the camera, of the time that the program waits
_AHEAD_S: Final = 0.1  # an emulated exposure belongs to the end of a control period that has just begun


class CameraProcess(Closing):
    """Camera in a process of its own, which starts at once. Nothing here waits for it but `wait_until_ready`.

    Args:
        request: The camera.

    Attributes:
        request: As given, for the system of the program.
        memory: Memory with its images.

    Raises:
        SettingsError: Its class cannot be imported, or is no camera.
    """

    def __init__(self, request: CameraRequest) -> None:
        source_type(request.entry)  # refused here, before there is a process
        self.request, self._clock = request, request.system.clock
        rate_hz = math.inf if isinstance(request.entry, FileCameraEntry) else request.entry.rate_hz
        self._stale_s = max(STALE_S, _STALE_PERIODS / rate_hz)
        self.memory = CameraMemory(request.kept)
        self._process: Process = request.system.spawn(
            main,
            self.memory.name,
            dataclasses.replace(request, system=LOCAL),  # the process has its own
            request.system.pid,
            name=f"camera {request.entry.name}",
        )

    @property
    def where(self) -> str:
        """Name and kind of the camera, for messages."""
        return self.request.where

    def wait_until_ready(self, until_s: float) -> None:
        """Wait for the first image.

        Raises:
            LinkError: There is none in time, or the camera was lost.
        """
        while not self.memory.count:
            self._check()
            if self._clock.now_s() > until_s:
                raise LinkError(f"{self.where} has sent no image in {START_S:g} s: check it with `doctor --cell FILE`")
            self._clock.sleep(_POLL_S)

    def newest(self, now_s: float) -> Exposure:
        """Return a copy of the newest image that is not newer than now. It does not wait.

        Raises:
            LinkError: It is older than allowed, there is none, or the camera was lost.
        """
        self._check()
        found = self.memory.newest(now_s)
        if found is None or now_s - found.exposed_s > self._stale_s:
            age = "there is no image" if found is None else f"the newest image is {now_s - found.exposed_s:.2f} s old"
            raise LinkError(
                f"{self.where} stalls: {age}; expected is at most {self._stale_s:g} s: check its cable, and that this "
                "machine is not overloaded"
            )
        return found

    def _check(self) -> None:
        lost = self.memory.lost
        if lost:
            raise LinkError(lost)
        if not self._process.is_alive:
            raise LinkError(f"{self.where}: its process has ended: somebody or the system has ended it. Start again")

    @property
    def pid(self) -> int:
        """Number of the camera's process."""
        return self._process.pid

    def close(self) -> None:
        """End the process. May be called twice."""
        self.memory.end()
        if not self._process.wait(_END_S):
            self._process.kill()
        self.memory.close()


def main(name: str, request: CameraRequest, parent: int, *, system: System = LOCAL) -> None:
    """Run one camera until the program ends it or has ended.

    Args:
        name: Name of its memory.
        request: The camera.
        parent: Process id of the program.
        system: Clock, network and threads.
    """
    system.ignore_interrupts()  # the program handles them, and ends the camera
    system.give_way()
    memory = CameraMemory(request.kept, name)
    request = dataclasses.replace(request, system=system)
    over, video = system.event(), _Video(memory, system)

    def guard() -> None:
        """Complete the video and end this process with the program, although the camera may make it wait."""
        while not over.wait(_GUARD_S):
            if memory.ending or system.is_orphan(parent):
                video.close()
                if not over.wait(_RELEASE_S):
                    system.end()

    guarding = system.thread(guard, "camera guard")
    try:
        with source_of(request) as source, contextlib.closing(video):
            _run(source, memory, request, parent, video)
    except DualUR10Error as error:
        memory.lose(str(error))
    except Exception as error:  # of any kind: it may be another's code
        memory.lose(f"{request.where}: {error!r}")
    over.set()
    guarding.join()
    memory.close()


class _Video:
    """Video of a camera, as soon as the program asks for it. A failure of it is no failure of the camera.

    The thread that reads the camera adds to it. Any thread may close it: that one may wait for the camera.
    """

    def __init__(self, memory: CameraMemory, system: System) -> None:
        self._memory, self._lock, self._over = memory, system.lock(), False
        self._record: VideoRecord | None = None

    def add(self, exposure: Exposure) -> None:
        """Append an image, if there is to be a video and it is neither closed nor has failed."""
        with self._lock:
            if self._over or (wanted := self._memory.video) is None:
                return
            try:
                if self._record is None:
                    path, begin_s = wanted
                    height, width = exposure.image.shape[:2]
                    self._record = VideoRecord(Path(path), (height, width), begin_s)
                self._record.add(exposure)
            except DualUR10Error as error:
                self._fail(error)

    def close(self) -> None:
        """Complete the video. May be called twice."""
        with self._lock:
            if self._record is not None and not self._over:
                try:
                    self._record.close()
                except DualUR10Error as error:
                    self._fail(error)
            self._over = True

    def _fail(self, error: DualUR10Error) -> None:
        self._over = True
        self._memory.fail(str(error))


def _run(source: CameraSource, memory: CameraMemory, request: CameraRequest, parent: int, video: _Video) -> None:
    """Put the images of a camera into its memory.

    Raises:
        LinkError: The camera was lost, or returned no image.
        SettingsError: Its images are too small.
    """
    system = request.system
    own: tuple[int, int] | None = None
    last_s = -math.inf
    while not memory.ending and not system.is_orphan(parent):
        image, exposed_s = source.read()
        found = getattr(image, "shape", None)
        if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise LinkError(
                f"{request.where} returned {found or repr(image)[:80]}; expected is (height, width, 3) uint8"
            )
        height, width = image.shape[:2]
        if own is None:
            if request.observed:
                check_fits((height, width), request.size, request.where)
            own = height, width
        if (height, width) != own:
            raise LinkError(
                f"{request.where} has changed the size of its images from {own[1]} x {own[0]} to {width} x {height}: "
                "start again with the size that it is to have"
            )
        now_s = system.clock.now_s()
        if not -math.inf < exposed_s <= now_s + _AHEAD_S:
            raise LinkError(f"{request.where}: an image was exposed at {exposed_s} s, and now it is {now_s:.3f} s")
        if exposed_s <= last_s:
            continue  # the same image again
        last_s = exposed_s
        kept = resized(image, request.size) if request.observed else np.zeros((*request.kept, 3), np.uint8)
        memory.put(Exposure(kept, float(exposed_s)))
        video.add(Exposure(image, float(exposed_s)))  # at its own size


def ready(cameras: list[CameraProcess]) -> None:
    """Wait for the first image of several cameras that start at the same time.

    Raises:
        LinkError: One has none in time. All are closed.
    """
    with contextlib.ExitStack() as made:
        for camera in cameras:
            made.callback(camera.close)
        for camera in cameras:
            camera.wait_until_ready(camera.request.system.clock.now_s() + START_S)
        made.pop_all()
