"""Where the TCP is, and where the joints have to be for that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from dual_ur10.sim2real.emulator.motion.arguments import checked_frame, six
from dual_ur10.sim2real.emulator.motion.reference import Reference
from dual_ur10.sim2real.emulator.motion.tool_kinematics import Frame, Pose, Tool, pose_of
from dual_ur10.types import Array


class Tooled(Reference):
    """A reference motion of an arm with a tool. See `Motion`."""

    @property
    def tcp(self) -> Pose:
        """Tool offset: pose of the TCP on the flange."""
        return self.tool.pose

    def set_tcp(self, pose: Iterable[Any]) -> None:
        """`set_tcp`: what is commanded from now on is meant for the TCP at this pose (6,) on the flange.

        Raises:
            MotionError: It is no pose.
        """
        numbers = six(pose, "the TCP")
        checked_frame(numbers, "the TCP")
        self.tool = Tool(numbers)

    def tcp_pose(self, q: Sequence[float] | Array) -> Pose:
        """Pose of the TCP at joint angles (6,)."""
        return pose_of(self.arm.tcp(q, self.tool))

    def flange_pose(self, q: Sequence[float] | Array) -> Pose:
        """Pose of the flange at joint angles (6,)."""
        return pose_of(self.arm.tcp(q, Tool()))

    def tcp_poses_and_speeds(self, q: Array, qd: Array) -> tuple[list[Pose], list[tuple[float, ...]]]:
        """Poses (6,) and speeds (6,), m/s and rad/s in base, of the TCP at joint angles and speeds (n, 6)."""
        frames, jacobian = self.arm.tcp_and_jacobian(q, self.tool)
        poses = [pose_of(Frame(*each)) for each in zip(*frames, strict=True)]
        return poses, [tuple(each) for each in (jacobian @ qd[..., None])[..., 0].tolist()]

    def tcp_speed(self, q: Sequence[float] | Array, qd: Sequence[float] | Array) -> tuple[float, ...]:
        """Speed (6,) of the TCP, m/s and rad/s in base."""
        return self.tcp_poses_and_speeds(np.array([q], dtype=np.float64), np.array([qd], dtype=np.float64))[1][0]

    def forward(self, q: Sequence[float] | Array, tcp: Sequence[float] | None = None) -> Pose:
        """`get_forward_kin`: pose of a TCP, or of the one set, at joint angles (6,).

        Raises:
            MotionError: These are no six finite numbers, or the TCP is no pose.
        """
        return pose_of(self.arm.tcp(six(q, "joint positions"), self._tool(tcp)))

    def inverse(
        self, pose: Iterable[Any], qnear: Sequence[float] | Array, tcp: Sequence[float] | None = None
    ) -> Array | None:
        """`get_inverse_kin`: joint angles (6,) nearest to `qnear` at a pose of a TCP, or of the one set; None: none.

        Raises:
            MotionError: An argument makes no sense.
        """
        target = checked_frame(pose, "the pose of get_inverse_kin")
        near = np.array(six(qnear, "qnear of get_inverse_kin"))
        q, ok = self.arm.joints(Frame(target.position[None], target.rotation[None]), near, self._tool(tcp))
        return q[0] if ok else None

    def _tool(self, tcp: Sequence[float] | None) -> Tool:
        if tcp is None or tcp is self.tool.pose:
            return self.tool
        checked_frame(tcp, "a TCP")
        return Tool(tcp)
