"""One or two servo arms without encoders on a serial line, which follow joint trajectories open-loop.

Nothing measures these arms: their state is what was commanded. They are no UR10, so that the safety gate knows neither
their shape nor what stands around them; the limits here are all that is checked. Keep their workspace free.
"""

from __future__ import annotations

import binascii
import contextlib
import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import DualUR10Error, LinkError, OperationRefusedError, SettingsError, TrajectoryError
from dual_ur10.sim2real.serial_arm.protocol import (
    BAUD,
    CAPACITY,
    STOP_S,
    WATCHDOG_S,
    MotionState,
    Point,
    Request,
    Status,
    pack_point,
    pack_start,
)
from dual_ur10.sim2real.serial_arm.serial_line import SerialLine, SerialTransport
from dual_ur10.sim2real.trajectory.goal import END_SPEED_RAD_S, GoalState
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode, too_long
from dual_ur10.sim2real.trajectory.reduction import BOUND_RAD, reduce_points
from ur_core.files import write_text
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.processes.system import LOCAL, System
from ur_core.processes.transport import Transport
from ur_core.types import Array

log = logging.getLogger(__name__)

START_TOLERANCE_RAD: Final = 1e-3
"""Largest difference of a trajectory's first point from the last commanded position."""

_MOST_BYTES: Final = 64 * 1024
_POLL_S: Final = 0.1
_LATE_S: Final = 1.0
_ROUNDING_RAD: Final = 2e-6  # numbers travel in microradians


class LastCommand(NamedTuple):
    """Content of the file.

    Attributes:
        q_rad: Commanded joint positions, (6,) of each arm: at the end of the last motion, or at the beginning of one
            that has not ended.
        settled: True if that motion has ended.
        boot: Number of the device's start, then.
    """

    q_rad: tuple[tuple[float, ...], ...]
    settled: bool
    boot: int


class CommandedPositions:
    """File of one device in the user's state folder. It is replaced as a whole, and never deleted.

    Args:
        device: Number of the device.
        arms: Number of its arms.
        system: State folder and date.

    Attributes:
        path: The file.

    Raises:
        SettingsError: There is no state folder.
    """

    def __init__(self, device: int, arms: int, system: System) -> None:
        self._arms, self._system = arms, system
        self.path = system.state_folder() / f"serial-arm-{device:08x}.json"

    def read(self) -> LastCommand | None:
        """Return the content, or None if nothing was ever commanded.

        Raises:
            SettingsError: It cannot be read. It stays as it is.
        """
        try:
            with self.path.open("rb") as file:
                values = json.loads(file.read(_MOST_BYTES))
            found = LastCommand(tuple(_six(row) for row in values["q_rad"]), values["settled"], values["boot"])
            if len(found.q_rad) != self._arms or type(found.settled) is not bool or type(found.boot) is not int:
                raise ValueError(f"it is not that of {self._arms} arm(s)")
            return found
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise SettingsError(
                f"{self.path}, the last commanded position of this arm, cannot be read ({error}): look where the arm "
                "stands, move the file away, and declare the position"
            ) from error

    def write(self, commanded: LastCommand) -> None:
        """Replace the content.

        Raises:
            DualUR10Error: It cannot be written. The old content stays.
        """
        values = {**commanded._asdict(), "when_utc": f"{self._system.clock.utc():%Y-%m-%d %H:%M:%S}"}
        try:
            write_text(self.path, json.dumps(values) + "\n")
        except DualUR10Error as error:
            raise DualUR10Error(f"{error}: nothing moves while the position cannot be kept. Make room there") from error


def _six(row: Any) -> tuple[float, ...]:
    numbers = tuple(float(each) for each in row)
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise ValueError("a row is not six numbers")
    return numbers


@dataclass(frozen=True)
class SerialLimits:
    """Limits of the arms.

    Attributes:
        position_rad: Largest joint position, both ways: what a servo with a range of 300° turns.
        speed_rad_s: Largest joint speed: half of what a loaded bus servo reaches.
    """

    position_rad: float = 2.6
    speed_rad_s: float = 1.5

    def __post_init__(self) -> None:
        for name in ("position_rad", "speed_rad_s"):
            if not 0.0 < getattr(self, name) <= 10.0:
                raise SettingsError(
                    f"{name} of a serial arm is {getattr(self, name)!r}: allowed is above 0, at most 10"
                )


@dataclass(frozen=True)
class SerialResult:
    """End of a goal on a serial line, in the words of `dual_ur10.sim2real.trajectory`.

    Attributes:
        state: Final state: SUCCEEDED, PREEMPTED (canceled by the caller), ABORTED (the motion was begun and did not end
            as it should), or REJECTED (nothing has moved).
        code: Result code. PATH_TOLERANCE_VIOLATED: the motion broke off, so that the arms stand anywhere on the path.
        reason: Short name: "reached", "cancelled", "rejected", "stopped", "underrun", "goal tolerance" or "lost".
        text: Description with the remedy; "": none is needed.
        q_rad: (arms, 6) commanded joint positions at the end; None: unknown.
        state_is_commanded: Always true: nothing measures these arms.
    """

    state: GoalState
    code: ResultCode
    reason: str
    text: str = ""
    q_rad: Array | None = None
    state_is_commanded: bool = True


def execute(
    trajectory: JointTrajectory,
    port: str,
    *,
    limits: SerialLimits | None = None,
    bound_rad: float = BOUND_RAD,
    at_start: bool = False,
    canceled: Callable[[], bool] | None = None,
    feedback: Callable[[float, Array], None] | None = None,
    system: System = LOCAL,
    transport: Transport | None = None,
) -> SerialResult:
    """Follow a trajectory with the arms on a serial line.

    All points are sent before the motion begins; the firmware then follows them on its own clock. It stops by itself if
    it hears nothing for half a second.

    Args:
        trajectory: Trajectory of exactly the device's arms, from rest to rest.
        port: Name of the port, such as /dev/ttyACM0.
        limits: Limits of the arms; None: the defaults.
        bound_rad: Largest deviation of a joint at any time, if the trajectory has to be reduced to the cubics between
            36 points, the buffer of the firmware.
        at_start: The operator has seen that the arms stand at the first point: needed at the first use of a device,
            after it lost its power, and after a motion with an unknown end.
        canceled: Function that is called ten times a second; it returns True to stop the arms along the path.
        feedback: Function that is called as often with the time on the path and the commanded positions (arms, 6).
        system: Clock and state folder.
        transport: An open line; None: open the port.

    Raises:
        MissingExtraError: pyserial is not installed.
    """
    limits = SerialLimits() if limits is None else limits
    try:
        trajectory = fitted(trajectory, bound_rad)
        check(trajectory, limits)
        line = SerialLine(SerialTransport(port, BAUD) if transport is None else transport, system.clock, port)
    except (LinkError, TrajectoryError) as error:
        return _rejected(error)
    with line:
        try:
            motion = _LoadedMotion(line, trajectory, port, at_start, system)
        except (LinkError, OperationRefusedError, SettingsError, TrajectoryError) as error:
            return _rejected(error)
        return motion.run(canceled or (lambda: False), feedback or (lambda time_s, q_rad: None))


def _rejected(error: DualUR10Error) -> SerialResult:
    code = error.code if isinstance(error, TrajectoryError) else ResultCode.INVALID_GOAL
    return SerialResult(GoalState.REJECTED, ResultCode(code), "rejected", str(error))


def scaled(trajectory: JointTrajectory, rate: float) -> JointTrajectory:
    """Return a trajectory whose time passes at a rate above 0 and at most 1: slower on the same path.

    Raises:
        SettingsError: The rate is not legal.
    """
    if not 0.0 < rate <= 1.0:
        raise SettingsError(f"scaling is {rate!r}: it must be above 0 and at most 1")
    speeds, accelerations = trajectory.qd_rad_s, trajectory.qdd_rad_s2
    return JointTrajectory(
        trajectory.arms,
        trajectory.time_s / rate,
        trajectory.q_rad,
        None if speeds is None else speeds * rate,
        None if accelerations is None else accelerations * rate**2,
    )


def fitted(trajectory: JointTrajectory, bound_rad: float) -> JointTrajectory:
    """Return a trajectory that the firmware can hold and follow: cubics between few points.

    Raises:
        TrajectoryError: So few points deviate by more than the bound.
    """
    most = CAPACITY - (trajectory.time_s[0] > 0.0)  # the firmware begins at 0, where the arms are
    if len(trajectory) <= most and trajectory.qd_rad_s is not None and trajectory.qdd_rad_s2 is None:
        return trajectory
    return reduce_points(trajectory, most, bound_rad).trajectory


def check(trajectory: JointTrajectory, limits: SerialLimits) -> None:
    """Check the whole path of a trajectory against the limits.

    Raises:
        TrajectoryError: It does not begin and end at rest, has no speeds, is too long, or leaves the limits.
    """
    if text := too_long(trajectory.duration_s):
        raise TrajectoryError(text)
    speeds = trajectory.qd_rad_s
    if speeds is None or len(trajectory) < 2:
        raise TrajectoryError(
            "the trajectory needs 2 points or more, with speeds: the firmware follows cubics. Give them"
        )
    for name, point in (("first", 0), ("last", -1)):
        fast = np.abs(speeds[point]) > END_SPEED_RAD_S
        if fast.any():
            arm, joint = np.argwhere(fast)[0]
            raise TrajectoryError(
                f"{trajectory.arms[arm]}/{JOINTS[joint]} has {speeds[point][arm, joint]:g} rad/s at the {name} point: "
                "the arms begin and end at rest. Set it to 0"
            )
    for point, (q, qd) in enumerate(zip(*_extremes(trajectory), strict=True)):
        for values, limit, unit in ((q, limits.position_rad, "rad"), (qd, limits.speed_rad_s, "rad/s")):
            if not values.max() <= limit:  # NaN, too, of numbers that overflow
                arm, joint = np.unravel_index(values.argmax(), values.shape)
                raise TrajectoryError(
                    f"{trajectory.arms[arm]}/{JOINTS[joint]} reaches {values.max():.4g} {unit} after point {point}, "
                    f"allowed are {limit:g}: change the trajectory"
                )


def _extremes(trajectory: JointTrajectory) -> tuple[Array, Array]:
    """Return the largest position and speed, both ways, of the cubic after each point but the last: (k - 1, arms, 6).

    Speed is exact. Position is bounded by the control points of the cubic as a Bézier curve.
    """
    q, width = trajectory.q_rad, np.diff(trajectory.time_s)[:, None, None]
    qd: Any = trajectory.qd_rad_s
    a, b, u, v = q[:-1], q[1:], qd[:-1], qd[1:]
    with np.errstate(all="ignore"):
        control = np.stack([a, a + u * width / 3, b - v * width / 3, b])
        # The speed is the parabola with the control values u, w and v; its peak is where its slope is zero.
        w = 3.0 * (b - a) / width - u - v
        curve = u - 2 * w + v
        s = np.nan_to_num(np.clip((u - w) / curve, 0.0, 1.0))
        between = (1 - s) ** 2 * u + 2 * s * (1 - s) * w + s**2 * v
    return np.abs(control).max(axis=0), np.abs(np.stack([u, between, v])).max(axis=0)


class _LoadedMotion:
    """Motion of one trajectory: checked and loaded when it is made."""

    def __init__(
        self, line: SerialLine, trajectory: JointTrajectory, port: str, at_start: bool, system: System
    ) -> None:
        self._line, self._trajectory, self._port = line, trajectory, port
        self._clock = system.clock
        self._info = line.hello(round(1e6 * self._clock.now_s()) & 0xFFFFFFFF)
        if trajectory.arms != self._info.arms:
            raise TrajectoryError(
                f"the trajectory is of {' and '.join(trajectory.arms)}, and the arms at {port} are "
                f"{' and '.join(self._info.arms)}: give points of exactly these",
                ResultCode.INVALID_JOINTS,
            )
        self._positions = CommandedPositions(self._info.device, len(self._info.arms), system)
        status = line.status()
        if status.state == MotionState.MOVING:
            raise TrajectoryError(f"the arms at {port} move already: stop them, or wait")
        self._start = self._checked_start(status, at_start)
        self._load()

    def _checked_start(self, status: Status, at_start: bool) -> Array:
        """Return the position (arms, 6) from which the arms begin.

        Raises:
            TrajectoryError: Nobody can know it, or the trajectory begins elsewhere.
        """
        first: Array = self._trajectory.q_rad[0].copy()
        here: Array = np.array(status.q_rad)
        noted = self._positions.read()
        # A motion that this program did not see end is remembered by the firmware.
        known = status.known and noted is not None and noted.boot == self._info.boot
        if known and noted is not None and noted.settled:
            known = bool(np.abs(here - noted.q_rad).max() <= _ROUNDING_RAD)
        if not known and not at_start:
            raise TrajectoryError(
                f"the position of the arms at {self._port} is unknown, as at the first use, after a loss of power, and "
                "after commands of another program: nothing measures them. Bring them to the first point of the "
                "trajectory, look at them, and declare that they stand there (at_start, --at-start)"
            )
        if not status.known:
            return first
        off = np.abs(first - here)
        if off.max() > START_TOLERANCE_RAD:
            arm, joint = np.unravel_index(off.argmax(), off.shape)
            raise TrajectoryError(
                f"the trajectory begins with {self._trajectory.arms[arm]}/{JOINTS[joint]} at {first[arm, joint]:.4f} "
                f"rad, and the arm was last commanded to {here[arm, joint]:.4f} rad, allowed is a difference of "
                f"{START_TOLERANCE_RAD:g}: begin there"
            )
        return here

    def _load(self) -> None:
        """Send all points.

        Raises:
            TrajectoryError: They do not fit into the buffer.
        """
        trajectory, capacity = self._trajectory, self._info.capacity
        speeds: Any = trajectory.qd_rad_s
        rows = list(zip(trajectory.time_s.tolist(), trajectory.q_rad, speeds, strict=True))
        if rows[0][0] == 0.0:
            rows.pop(0)
        rows.insert(0, (0.0, self._start, np.zeros_like(self._start)))
        if len(rows) > capacity:
            raise TrajectoryError(
                f"the trajectory has {len(rows)} points, and the firmware at {self._port} holds {capacity}: give fewer"
            )
        self._line.ask(Request.CLEAR)
        self._crc32, self._points = 0, len(rows)
        for index, (time_s, q, qd) in enumerate(rows):
            for number, name in enumerate(trajectory.arms):
                point = Point(ARMS.index(name), index, time_s, tuple(q[number].tolist()), tuple(qd[number].tolist()))
                payload = pack_point(point)
                self._line.ask(Request.POINT, payload)
                self._crc32 = binascii.crc32(payload, self._crc32)

    def run(self, canceled: Callable[[], bool], feedback: Callable[[float, Array], None]) -> SerialResult:
        """Follow the points, and return the result."""
        boot = self._info.boot
        try:
            self._positions.write(LastCommand(_rows(self._start), False, boot))
            self._line.ask(Request.START, pack_start(self._points, self._crc32))
        except OperationRefusedError as error:
            self._positions.write(LastCommand(_rows(self._start), True, boot))
            return _rejected(error)
        except LinkError as error:  # the request may have arrived
            return self._lost(str(error))
        except DualUR10Error as error:
            return _rejected(error)
        stopped, deadline_s = "", self._clock.now_s() + self._trajectory.duration_s + _LATE_S
        try:
            while True:
                status = self._line.status()
                if not status.known:
                    return self._lost(f"the device at {self._port} restarted during the motion")
                feedback(status.elapsed_s, np.array(status.q_rad))
                if status.state != MotionState.MOVING:
                    return self._ended(status, stopped)
                if not stopped:
                    stopped = "canceled" if canceled() else "late" if self._clock.now_s() > deadline_s else ""
                    if stopped:
                        self._line.ask(Request.STOP)
                self._clock.sleep(_POLL_S)
        except LinkError as error:
            return self._lost(str(error))
        except BaseException:  # such as an interrupt
            with contextlib.suppress(DualUR10Error):  # the watchdog of the firmware stops the arms, too
                self._line.ask(Request.STOP)
            raise

    def _ended(self, status: Status, stopped: str) -> SerialResult:
        q = np.array(status.q_rad)
        self._positions.write(LastCommand(_rows(q), True, self._info.boot))
        off = float(np.abs(q - self._trajectory.q_rad[-1]).max())
        if status.state == MotionState.DONE and off <= _ROUNDING_RAD:
            return SerialResult(GoalState.SUCCEEDED, ResultCode.SUCCESSFUL, "reached", q_rad=q)
        if stopped == "canceled":
            return SerialResult(GoalState.PREEMPTED, ResultCode.SUCCESSFUL, "cancelled", q_rad=q)
        if status.by_watchdog:
            text = f"the firmware at {self._port} heard nothing for too long, and stopped the arms on their path"
            return SerialResult(GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED, "underrun", text, q)
        text = f"the arms stopped {off:.4f} rad from the last point after {status.elapsed_s:.2f} s on the path"
        return SerialResult(GoalState.ABORTED, ResultCode.GOAL_TOLERANCE_VIOLATED, "goal tolerance", text, q)

    def _lost(self, found: str) -> SerialResult:
        text = (
            f"{found}. If the arms moved, they stop by themselves on their path within {WATCHDOG_S + STOP_S:g} s: look "
            "where they stand before the next motion"
        )
        return SerialResult(GoalState.ABORTED, ResultCode.PATH_TOLERANCE_VIOLATED, "lost", text)


def _rows(q_rad: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in q_rad.tolist())
