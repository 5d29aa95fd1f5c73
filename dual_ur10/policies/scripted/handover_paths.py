"""Motions of both arms in a handover, from configurations and poses in the cell frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.assets.settings import DEFAULT_TOOLS, home_q_rad
from dual_ur10.envs.tasks.geometry import APPROACH_M, flanges_of
from dual_ur10.envs.tasks.handover.settings import GRIPS, MEETING_M, laid_quat, presented_quat
from dual_ur10.policies.scripted.free_motion import FreeMotion, Waypoint
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses, compose, relative_to
from ur_core.kinematics.rotations import quat_to_matrix, rotate
from ur_core.tools.tool import levers_m as tool_levers_m
from ur_core.types import Array

_ABOVE_M: Final = 0.08  # of the passing points above the block on the table
_APART_M: Final = 0.07  # by which both tools draw back from each other
_PASS_M_S: Final = 0.12  # speed at a passing point
_DROP_M: Final = 0.001  # height at which the block is let go, so that it is not pressed onto the table
_SLIPPED_M: Final = 0.02  # largest plausible slip of the block in the gripper
_ACCELERATION_RAD_S2: Final = 4.0
_JERK_RAD_S3: Final = 20.0
# Acceleration and jerk of a tool on a line, in m/s² and m/s³: down to the table, and elsewhere.
_DOWN: Final = (0.5, 1.5)
_LINE: Final = (0.8, 5.0)
_LEAST: Final = 0.05  # of the largest limit, for joints that hardly move on it
_PASS_RATIO: Final = 0.8  # of the speed limits, at passing points
_SMOOTH_S, _SMOOTH_PERIODS = 0.2, 2.0  # time over which jerk changes; the longer of s and actions
_DT_S: Final = 0.01


class ToolState(NamedTuple):
    """Pose and speed of a tool, in the cell frame.

    Attributes:
        pose: Pose of the tool, (3,) and (4,).
        along_m_s: Speed along the tool's own z.
    """

    pose: Poses
    along_m_s: float = 0.0

    def back(self, distance_m: float, along_m_s: float = 0.0) -> ToolState:
        """Return the tool drawn back along its own z, with a speed."""
        away = rotate(self.pose.quat, np.array([0.0, 0.0, -distance_m]))
        return ToolState(Poses(self.pose.position_m + away, self.pose.quat), along_m_s)


class Via(NamedTuple):
    """Point on the path of both arms; an arm without an entry does not move.

    Attributes:
        arms: State of the tool, or configuration at rest, (6,), by the index of the arm.
        line_m: Length of the straight line to this point, along the tools; 0: the fastest motion.
        most: Acceleration (m/s²) and jerk (m/s³) on that line.
    """

    arms: Mapping[int, ToolState | Array]
    line_m: float = 0.0
    most: tuple[float, float] = _LINE


class HandoverPaths:
    """Planner of the motions of a handover. Configurations are (2, 6), poses in the cell frame.

    Args:
        mounts: Poses of the bases, and kinematics of the arms.
        speed_rad_s: (12,) limits of the joint speeds.
        period_s: Time between two actions.
        higher_m: Extra distance of both grips from the fingertips, beyond that of the task.
        levers_m: (2, 3) tool centre points in the flange frames; None: those of the default tools.
    """

    def __init__(
        self,
        mounts: Sequence[ArmMount],
        speed_rad_s: Array,
        period_s: float,
        higher_m: float = 0.0,
        levers_m: Array | None = None,
    ) -> None:
        self._levers_m = tool_levers_m(DEFAULT_TOOLS) if levers_m is None else levers_m
        self._mounts, self._speed, self._higher_m = mounts, speed_rad_s, higher_m
        self._smooth_s = max(_SMOOTH_S, _SMOOTH_PERIODS * period_s)
        self._frames, self._home = Frames((mounts[0], mounts[1])), home_q_rad(mounts)

    def pick(self, q_rad: Array, giver: int, block: Poses) -> FreeMotion:
        """Plan the giver's motion down to its grip of a block on the table."""
        grip = ToolState(compose(block, self._grip(giver, giver)))
        return self._motion(q_rad, [Via({giver: grip.back(_ABOVE_M, _PASS_M_S)}), Via({giver: grip}, _ABOVE_M, _DOWN)])

    def meet(self, q_rad: Array, giver: int, tool: Poses) -> FreeMotion:
        """Plan how the giver, whose tool holds the block on the table, presents it, and the receiver approaches it."""
        receiver, block = 1 - giver, Poses(MEETING_M, presented_quat(giver))
        shown, grip = (ToolState(compose(block, self._grip(giver, arm))) for arm in (giver, receiver))
        vias = [
            Via({giver: ToolState(tool).back(_ABOVE_M, -_PASS_M_S)}, _ABOVE_M),
            Via({giver: shown, receiver: grip.back(APPROACH_M, _PASS_M_S)}),
            Via({receiver: grip}, APPROACH_M),
        ]
        return self._motion(q_rad, vias)

    def place(self, q_rad: Array, giver: int, tools: Poses, block: Poses, target: Poses) -> FreeMotion:
        """Plan how both tools draw back, the giver returns home and the receiver lowers the block onto its target.

        Args:
            q_rad: Configuration.
            giver: Index of the giver.
            tools: Poses of both tools, (2, ...).
            block: Pose of the block in the receiver's gripper, as measured.
            target: Pose of the target.
        """
        receiver = 1 - giver
        held = [ToolState(Poses(tools.position_m[arm], tools.quat[arm])) for arm in (0, 1)]
        grip = self._grip(giver, receiver)
        # Only the position along the block is measured; the fingers fix the rest.
        seen = relative_to(block, held[receiver].pose).position_m[0]
        grip.position_m[0] += np.clip(seen - grip.position_m[0], -_SLIPPED_M, _SLIPPED_M)
        yaw = 2 * np.arctan2(target.quat[3], target.quat[0])
        lower = np.array([*target.position_m[:2], BLOCK_SIZE_M[2] / 2 + _DROP_M])
        down = ToolState(compose(Poses(lower, laid_quat(yaw)), grip))
        vias = [
            Via({arm: tool.back(_APART_M, -_PASS_M_S) for arm, tool in enumerate(held)}, _APART_M),
            Via({giver: self._home[giver], receiver: down.back(_ABOVE_M, _PASS_M_S)}),
            Via({receiver: down}, _ABOVE_M, _DOWN),
        ]
        return self._motion(q_rad, vias)

    def leave(self, q_rad: Array, giver: int, tool: Poses) -> FreeMotion:
        """Plan how the receiver draws its tool back."""
        return self._motion(q_rad, [Via({1 - giver: ToolState(tool).back(_ABOVE_M)}, _ABOVE_M)])

    def to_cell(self, flanges: Poses) -> Poses:
        """Transform poses, (2, ...), from the arms' `base` frames to the cell frame."""
        return Poses(self._frames.position_to_cell(flanges.position_m), self._frames.quat_to_cell(flanges.quat))

    def _motion(self, q_rad: Array, vias: Sequence[Via]) -> FreeMotion:
        waypoints, q = [], q_rad
        for via in vias:
            before, q, qd = q, q.copy(), np.zeros((2, 6))
            for arm, goal in via.arms.items():
                # A free motion ends on the branch nearest to home, for any yaw of the block: others fold the wrist.
                near = q[arm] if via.line_m else self._home[arm]
                q[arm], qd[arm] = self._reached(arm, goal, near)
            qd *= min(1.0, _PASS_RATIO / float(np.abs(qd.reshape(12) / self._speed).max(initial=1e-9)))
            limits = _on_line(q - before, via) if via.line_m else (None, None)
            waypoints.append(Waypoint(q.reshape(12), qd.reshape(12), *limits))
        return FreeMotion(q_rad.reshape(12), waypoints, self._speed, _ACCELERATION_RAD_S2, _JERK_RAD_S3, self._smooth_s)

    def _grip(self, giver: int, arm: int) -> Poses:
        """Return the pose of one tool in the frame of the block that it grips, (3,) and (4,)."""
        grip = Poses(GRIPS[giver].position_m[arm].copy(), GRIPS[giver].quat[arm])
        return ToolState(grip).back(self._higher_m).pose

    def _reached(self, arm: int, goal: ToolState | Array, near_rad: Array) -> tuple[Array, Array]:
        """Return the configuration and joint speeds of one arm, (6,) each."""
        if not isinstance(goal, ToolState):
            return goal, np.zeros(6)
        before, after_it = (
            self._inverse(arm, goal.back(sign * goal.along_m_s * _DT_S).pose, near_rad) for sign in (1, -1)
        )
        if goal.along_m_s == 0.0:
            return before, np.zeros(6)
        return (before + after_it) / 2, (after_it - before) / (2 * _DT_S)

    def _inverse(self, arm: int, tool: Poses, near_rad: Array) -> Array:
        flange = flanges_of(tool, self._levers_m[arm])
        both = Poses(np.tile(flange.position_m, (2, 1)), np.tile(flange.quat, (2, 1)))
        position, quat = self._frames.position_to_base(both.position_m)[arm], self._frames.quat_to_base(both.quat)[arm]
        q: Array = nearest(position[None], quat_to_matrix(quat)[None], near_rad[None], self._mounts[arm].dh)[0]
        return q


def _on_line(change_rad: Array, via: Via) -> tuple[Array, Array]:
    """Return limits of acceleration and jerk, (12,) each, that keep all joints, (2, 6), on a straight line.

    Towards the table the tool decelerates gently, because the brake that the gate checks is softer than the hardest
    stop.
    """
    ratios = np.abs(change_rad).reshape(12) / via.line_m
    ratios = np.maximum(ratios, _LEAST * ratios.max())
    return via.most[0] * ratios, via.most[1] * ratios
