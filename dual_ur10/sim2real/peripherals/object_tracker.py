"""Where the object is that a task handles, in a cell of controllers: what says so is named in the cell file."""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import Final, NamedTuple, Protocol

import numpy as np

from dual_ur10.errors import CellFileError, DualUR10Error, LinkError
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply, rotate
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config import cell_file_entries as entries
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.config.cell_file_entries import Three
from dual_ur10.sim2real.peripherals.object_placer import FaultInjectionClient
from dual_ur10.types import Array, Closing

log = logging.getLogger(__name__)

STALE_S: Final = 0.5
"""Poses older than this are an error."""

RATE_HZ: Final = 60.0
"""How often the emulated camera is asked."""

_ANSWER_S: Final = 2.0
_UNIT: Final = 1e-3  # by how much a quaternion's length may differ from 1


class Flanges(NamedTuple):
    """Poses of both flanges in the cell frame: position_m (2, 3), and quat (2, 4), (w, x, y, z)."""

    position_m: Array
    quat: Array


class ObjectPose(NamedTuple):
    """Where the object is.

    Attributes:
        position_m: (3,) of its centre, in the cell frame.
        quat: (4,) its orientation, (w, x, y, z).
        measured_s: When it was there, on the clock of `time.monotonic`.
    """

    position_m: Array
    quat: Array
    measured_s: float


class ObjectTracker(Protocol):
    """Something that knows where the object is."""

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """Where the object is, as far as is known. It does not wait.

        Args:
            now_s: Time of `time.monotonic`.
            flanges: Where both flanges are now.

        Raises:
            LinkError: What is known is older than `STALE_S`, or the tracker was lost.
        """
        ...

    def close(self) -> None:
        """Release everything. May be called twice."""
        ...


class AttachedTracker:
    """The object is held by an arm.

    Args:
        arm: "left" or "right".
        position_m: (3,) of the object in the frame of that arm's flange.
        quat: (4,) its orientation there.
    """

    def __init__(self, arm: str, position_m: Three, quat: Array) -> None:
        self._arm, self._position_m, self._quat = ARMS.index(arm), np.array(position_m), quat

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`: it is as new as the flanges' poses are."""
        position_m, quat = flanges.position_m[self._arm], flanges.quat[self._arm]
        return ObjectPose(position_m + rotate(quat, self._position_m), quat_multiply(quat, self._quat), now_s)

    def close(self) -> None:
        """There is nothing to release."""


class GivenTracker:
    """The object stands where the cell file says.

    Args:
        position_m: (3,) in the cell frame.
        quat: (4,) its orientation.
    """

    def __init__(self, position_m: Three, quat: Array) -> None:
        self._position_m, self._quat = np.array(position_m), quat

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`."""
        return ObjectPose(self._position_m.copy(), self._quat.copy(), now_s)

    def close(self) -> None:
        """There is nothing to release."""


class EmulatedTracker(Closing):
    """The camera of an emulated cell, asked by a thread. Its first pose is there once it is made.

    Args:
        emulator: Client of the cell. This object closes it.
        body: What is looked for.
        entry: Its noise and delay.
        rate_hz: How often it is asked.

    Raises:
        LinkError: There is no cell, or no such body in it.
    """

    def __init__(
        self, emulator: FaultInjectionClient, body: str, entry: entries.EmulatedTracker, rate_hz: float = RATE_HZ
    ) -> None:
        self._emulator, self._body, self._entry, self._period_s = emulator, body, entry, 1.0 / rate_hz
        self.where = f"emulated camera at {emulator.host}:{emulator.port}, looking for {body!r}"
        self._lost = ""
        self._ended = threading.Event()
        try:
            self._pose = self._look()
        except BaseException:
            emulator.close()
            raise
        self._thread = threading.Thread(target=self._run, name="object tracker", daemon=True)
        self._thread.start()

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`."""
        if self._lost:
            raise LinkError(self._lost)
        age_s = now_s - self._pose.measured_s
        if age_s > STALE_S:
            raise LinkError(
                f"{self.where}: the pose is {age_s:.2f} s old; expected is at most {STALE_S:g} s: check that the "
                "emulated cell runs and that this machine is not overloaded"
            )
        return self._pose

    def _look(self) -> ObjectPose:
        """Ask once.

        Raises:
            LinkError: There is no answer, or it is no pose.
        """
        seen_s = time.monotonic() - self._entry.delay_s
        noise = {name: getattr(self._entry, name) for name in ("noise_m", "noise_rad", "delay_s")}
        try:
            answer = self._emulator.ask("pose", body=self._body, **noise)
            position_m, quat = (np.array(answer[name], dtype=np.float64) for name in ("position_m", "quat"))
        except (DualUR10Error, TypeError, KeyError, ValueError) as error:
            raise LinkError(
                f"{self.where}: {error}; expected is a pose: check that the cell runs, with the scene of this task"
            ) from error
        values = (*position_m.flat, *quat.flat)
        fits = position_m.shape == (3,) and quat.shape == (4,)
        if not (fits and all(map(math.isfinite, values)) and abs(math.hypot(*quat.tolist()) - 1.0) < _UNIT):
            raise LinkError(
                f"{self.where}: found {answer!r}; expected are three coordinates and a unit quaternion: start the "
                "emulated cell again"
            )
        return ObjectPose(position_m, quat, seen_s)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._ended.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + self._period_s, time.monotonic())
            try:
                self._pose = self._look()
            except Exception as error:  # whatever it is, the program must hear of it
                if not self._ended.is_set():
                    self._lost = str(error) if isinstance(error, LinkError) else f"{self.where}: {error!r}"
                    log.error("%s", self._lost)
                return

    def close(self) -> None:
        """End the thread and its connection. May be called twice."""
        self._ended.set()
        self._thread.join()
        self._emulator.close()


def tracker_of(cell_file: CellFile, prop: str) -> ObjectTracker | None:
    """What the cell file says of where the object is.

    Args:
        cell_file: Of the cell. That of an emulated cell need not name a tracker: it has an exact camera.
        prop: What the task handles, such as "bar"; "" if nothing.

    Returns:
        The tracker, or None if there is nothing to track.

    Raises:
        CellFileError: The task handles something, and the file does not say where it is.
        SettingsError: What it says cannot be.
        LinkError: The emulated camera does not answer.
    """
    if not prop:
        return None
    entry = cell_file.tracker
    if isinstance(entry, entries.AttachedTracker):
        return AttachedTracker(entry.arm, entry.position_m, quat_from_rotvec(entry.rotation_rad))
    if isinstance(entry, entries.GivenTracker):
        return GivenTracker(entry.position_m, quat_from_rotvec(entry.rotation_rad))
    if cell_file.emulator is None:
        raise CellFileError(
            f"{cell_file.source}: this task handles a {prop}, and nothing says where it is: add a table [tracker] of "
            'kind "attached" or "given"' + (", or a table [emulator]" if cell_file.kind == "emulated" else "")
        )
    emulator = FaultInjectionClient(cell_file.left.host, cell_file.emulator.port, _ANSWER_S)
    return EmulatedTracker(emulator, prop, entry or entries.EmulatedTracker())
