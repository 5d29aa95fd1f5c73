"""Reference motion of a TCP: its pose, kinematic queries, force mode and freedrive."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ur_core.errors import MotionError
from ur_core.types import Array
from ur_emulator.motion.arguments import checked_frame, number, six
from ur_emulator.motion.compliance import (
    FORCE_DAMPING,
    FREE_DAMPING,
    FREE_FRICTION,
    SPEED_CAP,
    Compliance,
)
from ur_emulator.motion.reference import ZEROS, Reference
from ur_emulator.motion.servo import Servo
from ur_emulator.motion.tool_kinematics import Frame, Tcp, UrPose, pose_of


class ToolMotion(Reference):
    """Reference motion of an arm with a tool, whose TCP can be compliant. See `Motion`.

    Raises:
        MotionError: An argument of a method is invalid.
    """

    _force_damping: float = 0.025
    _force_gain: float = 1.0
    _free: bool = False

    @property
    def tcp(self) -> UrPose:
        """Pose of the TCP on the flange."""
        return self.tool.pose

    def set_tcp(self, pose: Iterable[Any]) -> None:
        """`set_tcp`: use the TCP at this pose (6,) on the flange for later commands."""
        numbers = six(pose, "the TCP")
        checked_frame(numbers, "the TCP")
        self.tool = Tcp(numbers)

    def tcp_pose(self, q: Sequence[float] | Array) -> UrPose:
        """Return the pose of the TCP at joint angles (6,)."""
        return pose_of(self.arm.tcp(q, self.tool))

    def flange_pose(self, q: Sequence[float] | Array) -> UrPose:
        """Return the pose of the flange at joint angles (6,)."""
        return pose_of(self.arm.tcp(q, Tcp()))

    def tcp_speed(self, q: Sequence[float] | Array, qd: Sequence[float] | Array) -> tuple[float, ...]:
        """Return the speed (6,) of the TCP, m/s and rad/s in base."""
        return self.arm.pose_and_speed(np.array(q, dtype=np.float64), np.array(qd, dtype=np.float64), self.tool)[1]

    def forward(self, q: Sequence[float] | Array, tcp: Sequence[float] | None = None) -> UrPose:
        """`get_forward_kin`: return the pose of a TCP, by default the one that is set, at joint angles (6,)."""
        return pose_of(self.arm.tcp(six(q, "joint positions"), self._tool(tcp)))

    def inverse(
        self, pose: Iterable[Any], qnear: Sequence[float] | Array, tcp: Sequence[float] | None = None
    ) -> Array | None:
        """`get_inverse_kin`: return the joint angles (6,) nearest to `qnear` at a pose, or None if unreachable."""
        target = checked_frame(pose, "the pose of get_inverse_kin")
        near = np.array(six(qnear, "qnear of get_inverse_kin"))
        q, ok = self.arm.joints(Frame(target.position[None], target.rotation[None]), near, self._tool(tcp))
        return q[0] if ok else None

    # Force mode and free drive.

    def force_mode(
        self, frame: Iterable[Any], selection: Sequence[Any], wrench: Iterable[Any], kind: int, limits: Iterable[Any]
    ) -> None:
        """`force_mode`: let the TCP yield in the selected axes until the arm exerts a wrench.

        Args:
            frame: (6,) compliance frame, in base.
            selection: (6,) true in compliant axes.
            wrench: (6,) wrench that the arm exerts on the environment in them, N and N m.
            kind: UR's type. 1: the frame is rotated so that its y axis points from the TCP to its origin. 2: it is
                used as given. 3: it is rotated so that its x axis is the direction of the TCP's speed.
            limits: (6,) greatest speeds in compliant axes, m/s and rad/s, capped at 0.5 m/s and 1 rad/s by this
                project. Those of the other axes are ignored: the arm follows its path there.
        """
        at = checked_frame(frame, "the frame of force_mode")
        wanted = np.clip(six(wrench, "the wrench of force_mode"), -1e4, 1e4)
        axes = np.array([float(bool(each)) for each in six(selection, "the selection of force_mode")])
        caps = np.minimum(np.abs(six(limits, "the limits of force_mode")), SPEED_CAP)
        if kind not in (1, 2, 3):
            raise MotionError(f"the type of force_mode is {kind!r}: it must be 1, 2 or 3")
        if self.fault is None:
            damping = FORCE_DAMPING * ((1 + 9 * self._force_damping) / max(self._force_gain, 1e-3))
            self._compliance = Compliance(at, kind, axes, axes * wanted, caps, damping, np.zeros(6))
            self._free = False

    def end_force_mode(self) -> None:
        """`end_force_mode`: make the TCP stiff. A motion that goes on does so from the present position."""
        if self._compliance is not None and not self._free:
            self._stiffen()

    def force_mode_settings(self, damping: float | None = None, gain_scaling: float | None = None) -> None:
        """`force_mode_set_damping`, 0 to 1, and `force_mode_set_gain_scaling`, 0 to 2, for the next force mode."""
        if damping is not None:
            self._force_damping = min(max(number(damping, "the damping of force mode"), 0.0), 1.0)
        if gain_scaling is not None:
            self._force_gain = min(max(number(gain_scaling, "the gain scaling of force mode"), 0.0), 2.0)

    def freedrive(self, free_axes: Sequence[Any] = (1,) * 6, feature: Iterable[Any] = (0.0,) * 6) -> None:
        """`freedrive_mode`: let the TCP follow the measured wrench. Without a wrench the arm stands.

        Args:
            free_axes: (6,) true in free axes.
            feature: (6,) frame of the axes, in base.
        """
        at = checked_frame(feature, "the feature of freedrive_mode")
        axes = np.array([float(bool(each)) for each in six(free_axes, "the free axes of freedrive_mode")])
        if self.fault is not None:
            return
        if self._trajectory is not None:
            self._handle.abort()
            self._brake(self.assumptions.program_stop_rad_s2)
        self._compliance = Compliance(at, 2, axes, np.zeros(6), SPEED_CAP, FREE_DAMPING, FREE_FRICTION)
        self._free = True

    def end_freedrive(self) -> None:
        """`end_freedrive_mode`: make the arm stiff again."""
        if self.free:
            self._stiffen()

    @property
    def free(self) -> bool:
        """True in freedrive."""
        return self._free and self._compliance is not None

    def _end_freedrive_for_command(self) -> None:
        if self.free:
            self._compliance = None

    def _stiffen(self) -> None:
        self._compliance = None
        if isinstance(self._trajectory, Servo):
            # The servoj law pulls the arm back to its target.
            self._trajectory.shift(self.q, self._rate + self._yield)
            self._offset = self._yield = ZEROS

    def _tool(self, tcp: Sequence[float] | None) -> Tcp:
        if tcp is None or tcp is self.tool.pose:
            return self.tool
        checked_frame(tcp, "a TCP")
        return Tcp(tcp)
