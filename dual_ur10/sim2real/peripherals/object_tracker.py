"""Trackers and placer of the objects that a task handles, as the cell file names them."""

from __future__ import annotations

import contextlib
import logging
import math
import reprlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.assets.prop import Prop
from dual_ur10.errors import (
    CellFileError,
    DualUR10Error,
    EmulatorError,
    LinkError,
    OperationRefusedError,
    SettingsError,
)
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import (
    AttachedTrackerEntry,
    EmulatedTrackerEntry,
    GivenTrackerEntry,
    OwnTrackerEntry,
    Tracker,
    keywords_of,
)
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import quat_from_rotvec
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.json_link import JsonLink
from ur_core.objects import load_object
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array, Closing, Vector3

log = logging.getLogger(__name__)

STALE_S: Final = 0.5
"""Largest age of a pose."""

RATE_HZ: Final = 60.0
"""Rate at which a camera is asked."""

_AHEAD_S: Final = 0.1  # by which a tracker of one's own may be ahead
_ANSWER_S: Final = 2.0
_UNIT: Final = 1e-3  # tolerance of a unit quaternion's length


class Flanges(NamedTuple):
    """Poses of both flanges in the cell frame: position_m (2, 3), and quat (2, 4), (w, x, y, z)."""

    position_m: Array
    quat: Array


class ObjectPose(NamedTuple):
    """Pose of the object, and when it was measured.

    Attributes:
        position_m: (3,) of its centre, in the cell frame.
        quat: (4,) its orientation, (w, x, y, z).
        measured_s: Time of the measurement, on the system's clock.
        joints: Positions of its joints, rad or m, by their names.
    """

    position_m: Array
    quat: Array
    measured_s: float
    joints: Mapping[str, float] = MappingProxyType({})


class ObjectTracker(Closing):
    """Source of the pose of one object, and of its joints. One of your own is named in the cell file."""

    @abstractmethod
    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """Return the newest pose. It does not wait.

        Args:
            now_s: Time of the system's clock.
            flanges: Poses of both flanges now.

        Raises:
            LinkError: The newest pose is older than `STALE_S`, or the tracker was lost.
        """

    def close(self) -> None:
        """Release all resources: by default, there are none. May be called twice."""


class FlangeTracker(ObjectTracker):
    """Tracker of an object that an arm holds: it follows the flange.

    Args:
        arm: "left" or "right".
        position_m: (3,) of the object in the frame of that arm's flange.
        quat: (4,) its orientation there.
    """

    def __init__(self, arm: str, position_m: Vector3, quat: Array) -> None:
        self._arm, self._position_m, self._quat = ARMS.index(arm), np.array(position_m), quat

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`. The pose is as new as those of the flanges."""
        flange = Poses(flanges.position_m[self._arm], flanges.quat[self._arm])
        return ObjectPose(*compose(flange, Poses(self._position_m, self._quat)), now_s)


class FixedTracker(ObjectTracker):
    """Tracker of an object that stays at the pose in the cell file.

    Args:
        position_m: (3,) in the cell frame.
        quat: (4,) its orientation.
    """

    def __init__(self, position_m: Vector3, quat: Array) -> None:
        self._position_m, self._quat = np.array(position_m), quat

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`."""
        return ObjectPose(self._position_m.copy(), self._quat.copy(), now_s)


class CheckedTracker(ObjectTracker):
    """Tracker of one's own, whose errors and whose poses that are none are those of a lost tracker.

    Args:
        tracker: The tracker.
        prop: Its object.
        where: Description of the tracker, for messages.
    """

    def __init__(self, tracker: ObjectTracker, prop: Prop, where: str) -> None:
        self.tracker, self._prop, self._where = tracker, prop, where

    def pose(self, now_s: float, flanges: Flanges) -> ObjectPose:
        """See `ObjectTracker`."""
        try:
            found = ObjectPose(*self.tracker.pose(now_s, flanges))
            position_m, quat = (np.asarray(each, dtype=np.float64) for each in found[:2])
            age_s, joints = float(now_s - found.measured_s), {name: float(at) for name, at in found.joints.items()}
        except Exception as error:  # of any kind: both arms must stop
            raise LinkError(f"{self._where}: {error!r}") from error
        if position_m.shape != (3,) or quat.shape != (4,) or not abs(float(np.linalg.norm(quat)) - 1.0) < _UNIT:
            raise LinkError(f"{self._where}: found {position_m} and {quat}; expected are (3,) m and a unit quaternion")
        if not (np.isfinite(position_m).all() and np.isfinite([*joints.values()]).all()):
            raise LinkError(f"{self._where}: found {position_m} and {joints}; expected are finite numbers")
        if set(joints) != set(self._prop.joints):
            expected = ", ".join(self._prop.joints) or "none"
            raise LinkError(f"{self._where}: found the joints {', '.join(joints) or 'none'}; expected are {expected}")
        if not -_AHEAD_S <= age_s <= STALE_S:  # a pose of another clock's time would never grow old
            raise LinkError(
                f"{self._where}: the pose is {age_s:.2f} s old; expected is at most {STALE_S:g} s, and no time to come"
            )
        return ObjectPose(position_m, quat, found.measured_s, joints)

    def close(self) -> None:
        """Close the tracker. May be called twice."""
        self.tracker.close()


class _Seen(BaseModel):
    """Answer of the camera: position, and orientation (w, x, y, z), in the cell frame."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    position_m: Annotated[list[float], Field(min_length=3, max_length=3)]
    quat: Annotated[list[float], Field(min_length=4, max_length=4)]
    joints: Annotated[dict[str, float], Field(max_length=1000)] = {}


class CameraTracker(ObjectTracker):
    """Camera that a thread asks for the object's pose. The first pose is there once this object is made.

    Args:
        link: Connection to the camera; the tracker closes it.
        body: Name of the object.
        entry: Noise and delay of the camera.
        rate_hz: Rate of requests.
        system: Clock and threads.

    Raises:
        LinkError: The camera does not answer, or knows no such body.
    """

    def __init__(
        self,
        link: JsonLink,
        body: str,
        entry: EmulatedTrackerEntry,
        rate_hz: float = RATE_HZ,
        *,
        system: System = LOCAL,
    ) -> None:
        self._clock = system.clock
        self._link, self._body, self._entry, self._period_s = link, body, entry, 1.0 / rate_hz
        self.where = f"{link.where}, looking for {body!r}"
        self._lost = ""
        self._ended = system.event()
        with link.closed_on_error():
            self._pose = self._request()
        self._thread = system.thread(self._run, "object tracker")

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

    def _request(self) -> ObjectPose:
        seen_s = self._clock.now_s() - self._entry.delay_s
        noise = {name: getattr(self._entry, name) for name in ("noise_m", "noise_rad", "delay_s")}
        try:
            answer = self._link.ask("pose", body=self._body, **noise)
        except DualUR10Error as error:
            raise LinkError(
                f"{self.where}: {error}; expected is a pose: check that the cell runs, with the scene of this task"
            ) from error
        try:
            seen = _Seen.model_validate(answer)
        except ValidationError:
            seen = None
        if seen is None or abs(math.hypot(*seen.quat) - 1.0) >= _UNIT:
            raise LinkError(
                f"{self.where}: found {reprlib.repr(answer)}; expected are three coordinates and a unit quaternion: "
                "start the emulated cell again"
            )
        return ObjectPose(np.array(seen.position_m), np.array(seen.quat), seen_s, seen.joints)

    def _run(self) -> None:
        due_s = self._clock.now_s()
        while not self._ended.wait(max(0.0, due_s - self._clock.now_s())):
            due_s = max(due_s + self._period_s, self._clock.now_s())
            try:
                self._pose = self._request()
            except Exception as error:  # of any kind: the program must learn of it
                if not self._ended.is_set():
                    self._lost = str(error) if isinstance(error, LinkError) else f"{self.where}: {error!r}"
                    log.error("%s", self._lost)
                return

    def close(self) -> None:
        """End the thread and its connection. May be called twice."""
        self._ended.set()
        self._thread.join()
        self._link.close()


def trackers_of(cell_file: CellFile, props: Sequence[Prop], system: System = LOCAL) -> dict[str, ObjectTracker]:
    """Return the trackers that a cell file names for the props of a task, by their names.

    Args:
        cell_file: Cell file. That of an emulated cell need not name trackers: it has an exact camera.
        props: Props of the task. Those that nothing tracks have the pose of the start.
        system: Clock, network and threads.

    Raises:
        CellFileError: Nothing tracks some of them.
        SettingsError: A tracker of one's own cannot be made.
        LinkError: The camera does not answer.
    """
    entries = {each.prop: each for each in cell_file.tracker}
    wanted = [each for each in props if each.tracked]
    missing = [each.name for each in wanted if each.name not in entries] if cell_file.emulator is None else []
    if missing:
        raise CellFileError(
            f"{cell_file.source}: this task handles {', '.join(missing)}, and nothing says where "
            f"{'it is' if len(missing) == 1 else 'they are'}: add a table [[tracker]] for each, with "
            f'prop = "{missing[0]}" and the kind "attached", "given" or "own"'
            + (", or a table [emulator]" if cell_file.kind == "emulated" else "")
        )
    found: dict[str, ObjectTracker] = {}
    with contextlib.ExitStack() as made:
        for prop in wanted:
            found[prop.name] = _tracker_of(cell_file, prop, entries.get(prop.name), system)
            made.callback(found[prop.name].close)
        made.pop_all()
    return found


def _tracker_of(cell_file: CellFile, prop: Prop, entry: Tracker | None, system: System) -> ObjectTracker:
    if isinstance(entry, AttachedTrackerEntry):
        return FlangeTracker(entry.arm, entry.position_m, quat_from_rotvec(entry.rotation_rad))
    if isinstance(entry, GivenTrackerEntry):
        return FixedTracker(entry.position_m, quat_from_rotvec(entry.rotation_rad))
    if isinstance(entry, OwnTrackerEntry):
        tracker = load_object(entry.tracker, f"the tracker of the prop {prop.name!r}")
        try:
            made = tracker(prop.name, **keywords_of(entry.options))
        except TypeError as error:
            raise SettingsError(
                f"{cell_file.source}: the tracker {entry.tracker!r} cannot be made of the name of the prop and the "
                f"options {entry.options or '(none)'}: {error}"
            ) from error
        if not isinstance(made, ObjectTracker):
            raise SettingsError(f"{cell_file.source}: {entry.tracker!r} is no subclass of {ObjectTracker.__qualname__}")
        return CheckedTracker(made, prop, f"the tracker {entry.tracker} of the prop {prop.name!r}")
    if cell_file.emulator is None:
        raise CellFileError(f"{cell_file.source}: the camera of an emulated cell needs the table [emulator]")
    link = JsonLink("emulated camera", cell_file.left.host, cell_file.emulator.port, _ANSWER_S, system=system)
    return CameraTracker(link, prop.name, entry or EmulatedTrackerEntry(prop=prop.name), system=system)


class ObjectPlacer(Closing):
    """Client that puts objects of a task at poses, and their joints at positions, at rest.

    Args:
        link: Connection to the service; the placer closes it.
    """

    def __init__(self, link: JsonLink) -> None:
        self._link = link

    def place(self, name: str, position_m: Sequence[float], quat: Sequence[float]) -> None:
        """Put an object at a pose in the cell frame.

        Args:
            name: Name of the prop.
            position_m: (3,) of its centre.
            quat: (4,) its orientation (w, x, y, z).

        Raises:
            EmulatorError: There is no object, it cannot be put there, or there was no answer.
        """
        pose = {
            "prop": name,
            "position_m": [float(each) for each in position_m],
            "quat": [float(each) for each in quat],
        }
        self._ask(f"the {name} was not placed", "place", **pose)

    def set_joints(self, values: Mapping[str, float]) -> None:
        """Put joints of objects at positions, rad or m, by their names.

        Raises:
            EmulatorError: There is no such joint, or there was no answer.
        """
        self._ask(f"the joints {', '.join(values)} were not set", "set_joints", values=dict(values))

    def _ask(self, finding: str, do: str, **values: Any) -> None:
        try:
            self._link.ask(do, **values)
        except (LinkError, OperationRefusedError) as error:
            raise EmulatorError(f"{finding}: {error}") from error

    def close(self) -> None:
        """End the connection. May be called twice."""
        self._link.close()


def placer_of(cell_file: CellFile, system: System = LOCAL) -> ObjectPlacer | None:
    """Return the placer that a cell file names, or None if a person places the objects."""
    entry = cell_file.emulator
    if entry is None:
        return None
    return ObjectPlacer(JsonLink("object placer", cell_file.left.host, entry.port, system=system))
