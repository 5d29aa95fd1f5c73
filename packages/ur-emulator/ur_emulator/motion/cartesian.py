"""Trajectories of the TCP. The joint positions follow from the pose in closed form."""

from __future__ import annotations

from abc import abstractmethod
from typing import Final

import numpy as np

from ur_core.errors import UnreachableError
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.types import Array
from ur_emulator.motion.paths import Path
from ur_emulator.motion.tool_kinematics import ArmKinematics, Frame, Tcp
from ur_emulator.motion.trajectories import (
    ACCELERATION_LIMIT_RAD_S2,
    TIME_EPSILON_S,
    Trajectory,
    Trapezoid,
)

ACCELERATION_LIMIT: Final = 40.0
"""Greatest acceleration of the TCP, m/s² and rad/s². A choice of this project: controllers accept more than an arm can
follow.
"""

RAMP_RAD_S2: Final = 0.5 * ACCELERATION_LIMIT_RAD_S2
"""Greatest acceleration of the joints for a ramp of the TCP's speed. The rest is for the curvature of their path."""

SPEED_LIMIT: Final = 5.0
"""Greatest speed of the TCP, m/s and rad/s. The joints' limits are usually reached first."""


class PoseTrajectory(Trajectory):
    """Trajectory given by poses of the TCP.

    Args:
        arm: Kinematics of the arm.
        tool: Pose of the TCP on the flange.
        near: (6,) joint positions at the start.
    """

    governed = True

    def __init__(self, arm: ArmKinematics, tool: Tcp, near: Array) -> None:
        self.arm, self.tool, self.near = arm, tool, near
        self._reached = near

    @abstractmethod
    def poses(self, times: Array) -> Frame:
        """Return poses (n) of the TCP at times (n,)."""

    def positions(self, step: float, counts: Array) -> Array:
        """Return joint positions (n, 6); see `Trajectory`."""
        q, ok = self.arm.joints(self.poses(self.t + step * counts), self.near, self.tool)
        if not ok:
            raise UnreachableError("the arm does not reach the next pose on its path")
        self._reached = q[-1]
        return q

    def commit(self, time: float) -> None:
        """Advance by `time`."""
        self.t += time
        self.near = self._reached


class PoseMove(PoseTrajectory):
    """Move along a path, from rest to rest.

    Translation in m and rotation in rad have the same numbers `speed` and `acceleration`; the one that takes longer
    leads. UR publishes only the former.

    Args:
        arm: Kinematics of the arm.
        tool: Pose of the TCP on the flange.
        near: (6,) joint positions at the start.
        path: Path of the TCP.
        end: (6,) joint positions at the end.
        acceleration: m/s² and rad/s².
        speed: m/s and rad/s.
        time: Duration, s; overrides `acceleration` and `speed` if above 0.
        blend_m: Blend radius.
    """

    def __init__(
        self,
        arm: ArmKinematics,
        tool: Tcp,
        near: Array,
        path: Path,
        end: Array,
        acceleration: float,
        speed: float,
        time: float = 0.0,
        blend_m: float = 0.0,
    ) -> None:
        super().__init__(arm, tool, near)
        self.path, self.end, self.blend_m = path, end, blend_m
        distance = max(path.length_m, path.angle_rad)
        most = ACCELERATION_LIMIT
        if (turned := float(np.abs(end - near).max())) > 0.0:
            most = min(most, RAMP_RAD_S2 * distance / turned)
        if time > 0.0:
            self.profile = Trapezoid.timed(distance, time, SPEED_LIMIT, most)
        else:
            self.profile = Trapezoid(distance, min(speed, SPEED_LIMIT), min(acceleration, most))
        self.duration = self.profile.duration

    def poses(self, times: Array) -> Frame:
        """Return poses (n) of the TCP at times (n,)."""
        return self.path.at(np.array([self.profile.fraction(t) for t in times.tolist()]))


class PoseBlend(PoseTrajectory):
    """Move that starts before the previous one has ended: displacements add up, rotations are composed.

    Args:
        main: The move, which starts at the end of `ending`.
        ending: The previous move.
    """

    def __init__(self, main: PoseMove, ending: PoseMove) -> None:
        super().__init__(main.arm, main.tool, ending.near)
        self.main, self.ending, self.pace = main, ending, ending.pace

    def poses(self, times: Array) -> Frame:
        """Return poses (n) of the TCP at times (n,)."""
        position, rotation = self.main.poses(times - self.t + self.main.t)
        late, turned = self.ending.poses(times - self.t + self.ending.t)
        end = self.ending.path.end
        return Frame(position + (late - end.position), turned @ end.rotation.T @ rotation)

    def commit(self, time: float) -> None:
        """Advance by `time`."""
        super().commit(time)
        self.main.t += time
        self.ending.t += time
        self.main.near = self.near

    @property
    def finished(self) -> bool:
        """True once the arm has stopped."""
        return self.main.finished and self.ending.finished


class PoseBrake(PoseTrajectory):
    """Straight braking from a speed of the TCP to rest.

    Args:
        arm: Kinematics of the arm.
        tool: Pose of the TCP on the flange.
        near: (6,) joint positions at the start.
        twist: (6,) speed at the start, m/s and rad/s.
        time: Duration, s.
    """

    def __init__(self, arm: ArmKinematics, tool: Tcp, near: Array, twist: Array, time: float) -> None:
        super().__init__(arm, tool, near)
        self._start, self._twist, self.duration = arm.tcp(near, tool), twist, time

    def poses(self, times: Array) -> Frame:
        """Return poses (n) of the TCP at times (n,)."""
        t = np.minimum(times, self.duration)
        if self.duration > 0.0:
            t = t - t * t / (2 * self.duration)
        return _moved(self._start, np.multiply.outer(t, self._twist))


class SpeedPose(PoseTrajectory):
    """Acceleration to a speed of the TCP, which is then held.

    Args:
        arm: Kinematics of the arm.
        tool: Pose of the TCP on the flange.
        near: (6,) joint positions at the start.
        twist: (6,) speed at the start, m/s and rad/s.
    """

    streamed = True
    duration = float("inf")

    def __init__(self, arm: ArmKinematics, tool: Tcp, near: Array, twist: Array) -> None:
        super().__init__(arm, tool, near)
        self._start, self._twist, self._target = arm.tcp(near, tool), twist, twist
        self._change = np.zeros((2, 6))  # rows: acceleration of translation, of rotation
        self._reached_s = np.zeros(2)
        self._timed = False

    def aim(self, twist: Array, acceleration: float, acceleration_rad_s2: float, ticks: int) -> None:
        """Set a new speed (6,). The command returns after `ticks`, or at 0 once the speed is reached."""
        self._target = twist
        self._timed, self.ticks_left = ticks > 0, ticks
        self._change, self._reached_s = self._ramp_to(twist, acceleration, acceleration_rad_s2)
        self.t = 0.0

    def ramp(self, twist: Array, acceleration: float, acceleration_rad_s2: float) -> Array:
        """Return the acceleration (6,) with which `aim` would begin."""
        start: Array = self._ramp_to(twist, acceleration, acceleration_rad_s2)[0].sum(axis=0)
        return start

    def _ramp_to(self, twist: Array, acceleration: float, acceleration_rad_s2: float) -> tuple[Array, Array]:
        change, accelerations, times = twist - self._twist, np.zeros((2, 6)), np.zeros(2)
        for row, (part, limit) in enumerate(((slice(0, 3), acceleration), (slice(3, 6), acceleration_rad_s2))):
            size = float(np.linalg.norm(change[part]))
            times[row] = size / limit
            if size > 0.0:
                accelerations[row, part] = change[part] * (limit / size)
        return accelerations, times

    def _ramps(self, times: Array) -> Array:
        """Return the time (n, 2) for which translation and rotation have accelerated."""
        ramps: Array = np.minimum(times[:, None], self._reached_s)
        return ramps

    def poses(self, times: Array) -> Frame:
        """Return poses (n) of the TCP at times (n,)."""
        ramps = self._ramps(times)
        displacement = (
            np.multiply.outer(times, self._twist) + (times[:, None] * ramps - 0.5 * ramps * ramps) @ self._change
        )
        return _moved(self._start, displacement)

    def commit(self, time: float) -> None:
        """Advance by `time`."""
        # Restart from the present state, so that the rotation needs no more than one tick's rotation vector.
        now = np.array([time])
        position, rotation = self.poses(now)
        self._start = Frame(position[0], rotation[0])
        self._twist = self._twist + self._ramps(now)[0] @ self._change
        self._reached_s = self._reached_s - time
        for row, part in enumerate((slice(0, 3), slice(3, 6))):
            if self._reached_s[row] <= TIME_EPSILON_S:
                self._reached_s[row] = 0.0
                self._twist[part] = self._target[part]
        self.near = self._reached

    @property
    def returns(self) -> bool:
        """True once the command returns to its program."""
        return self.ticks_left <= 0 if self._timed else not self._reached_s.any()


def _moved(start: Frame, displacement: Array) -> Frame:
    """Return poses (n) displaced by (n, 6): a displacement and a rotation vector in base."""
    rotation = quat_to_matrix(quat_from_rotvec(displacement[:, 3:])) @ start.rotation
    return Frame(start.position + displacement[:, :3], rotation)
