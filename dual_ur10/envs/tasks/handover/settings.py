"""Settings of `Handover`, and the poses of block, grips and target."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import lru_cache
from typing import Final, Literal, get_args

import numpy as np

from dual_ur10.assets.props import BLOCK_GRIP_M, BLOCK_GRIP_QUAT, BLOCK_SIZE_M
from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.tasks.geometry import APPROACH_M, flanges_of, lying
from dual_ur10.envs.tasks.task import check_numbers
from dual_ur10.errors import UnknownNameError, WorkspaceError
from ur_core.kinematics import try_nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, yaw_quat
from ur_core.kinematics.rotations import quat_multiply, quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import levers_m
from ur_core.types import Array

Giver = Literal["left", "right", "random"]

SIDE_M: Final = 0.5
"""Nominal distance of block and target from the middle, each on its arm's side, along the cell's y."""

MEETING_M: Final = np.array([-0.1, -0.1, 0.35])
"""Position of the block at the transfer, in the cell frame. It is off the middle, see `MEETING_YAW_RAD`."""

MEETING_YAW_RAD: Final = math.pi / 4
"""Yaw of the block at the transfer. The wrists of both arms are offset to the same side: along the cell's y the left
gripper would have to fold back onto its own forearm. So the grippers meet on a diagonal, a little to the right."""

GRIP_HEIGHT_M: Final = 0.006
"""Distance of the fingers' middle before the block's middle, so that the fingertips stay off the table."""

_HALF: Final = math.sqrt(0.5)
# Tools in the block's frame: the giver comes from above, along the block's -z, the receiver from the other side.
_GIVER_QUAT: Final = BLOCK_GRIP_QUAT
_RECEIVER_QUAT: Final = (0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class HandoverSettings:
    """Keywords of `Handover`, described there.

    Raises:
        UnknownNameError: `giver` is none of its names.
        SettingsError: Another value is not legal.
    """

    giver: Giver = "left"
    duration_s: float = 20.0
    grip_force_n: float = 60.0
    object_range_m: float = 0.02
    object_turn_rad: float = math.pi / 6
    target_range_m: float = 0.03
    target_turn_rad: float = 0.3
    success_error_m: float = 0.015
    success_turn_rad: float = 0.15

    def __post_init__(self) -> None:
        if self.giver not in get_args(Giver):
            raise UnknownNameError("giver", str(self.giver), get_args(Giver))
        check_numbers(
            self,
            ("duration_s", 0.1, 3600.0),
            ("object_range_m", 0.0, 0.3),
            ("object_turn_rad", 0.0, math.pi),
            ("target_range_m", 0.0, 0.3),
            ("target_turn_rad", 0.0, math.pi),
            ("success_error_m", 1e-6, 1.0),
            ("success_turn_rad", 1e-6, math.pi),
        )

    @property
    def givers(self) -> tuple[int, ...]:
        """Arms that may give, as indices of `ur_core.kinematics.ur10.ARMS`."""
        return (0, 1) if self.giver == "random" else (ARMS.index(self.giver),)


def _grips(giver: int) -> Poses:
    position, quat = np.zeros((2, 3)), np.zeros((2, 4))
    for arm in (0, 1):
        gives = arm == giver
        position[arm] = (2 * arm - 1) * BLOCK_GRIP_M, 0.0, GRIP_HEIGHT_M if gives else -GRIP_HEIGHT_M
        quat[arm] = _GIVER_QUAT if gives else _RECEIVER_QUAT
    return Poses(position, quat)


GRIPS: Final = tuple(_grips(giver) for giver in (0, 1))
"""Poses of both tools in the frame of the block that they grip, (2, 3) and (2, 4), by the index of the giver."""


def block_pose(where: Array, side: Array) -> Poses:
    """Return poses of blocks that lie on a side of the table, (n, 3) and (n, 4).

    Args:
        where: (n, 3) x and y (m) from the nominal position of a side, and yaw (rad).
        side: (n,) index of the arm on that side.
    """
    pose = lying(where, BLOCK_SIZE_M[2])
    pose.position_m[:, 1] += SIDE_M * (1 - 2 * side)
    return pose


def presented_quat(giver: int) -> Array:
    """Return the orientation, (4,), of the block at the transfer, with the cell's y from the right to the left arm."""
    tilt = np.array([_HALF, -_HALF if giver == 0 else _HALF, 0.0, 0.0])
    return quat_multiply(yaw_quat(np.array(MEETING_YAW_RAD)), tilt)


def laid_quat(yaw_rad: Array) -> Array:
    """Return orientations, (..., 4), of placed blocks: upside down, because the receiver grips them from below."""
    return quat_multiply(yaw_quat(yaw_rad), np.broadcast_to([0.0, 1.0, 0.0, 0.0], (*np.shape(yaw_rad), 4)))


@lru_cache(maxsize=64)
def check_reach(settings: HandoverSettings, scene: SceneSettings) -> None:
    """Refuse poses that an arm cannot reach.

    Raises:
        WorkspaceError: An arm cannot reach the block at its start, at the transfer, or at the target.
    """
    for giver in settings.givers:
        receiver = 1 - giver
        for arm, place, remedy, where in (
            (giver, "the block", "object_range_m or object_turn_rad", _corners(settings, giver, "object")),
            (receiver, "the target", "target_range_m or target_turn_rad", _corners(settings, receiver, "target")),
        ):
            blocks = block_pose(where, np.full(len(where), arm))
            if place == "the target":
                blocks = Poses(blocks.position_m, laid_quat(where[:, 2]))
            for k in _unreached(scene, giver, arm, blocks):
                x, y, yaw = *blocks.position_m[k, :2], where[k, 2]
                raise WorkspaceError(
                    f"the {ARMS[arm]} arm cannot reach {place} at ({x:g}, {y:g}) m, turned by {yaw:g} rad: choose a "
                    f"smaller {remedy}, or move the base"
                )
        meeting = Poses(MEETING_M[None], presented_quat(giver)[None])
        for arm in (0, 1):
            for _ in _unreached(scene, giver, arm, meeting):
                raise WorkspaceError(
                    f"the {ARMS[arm]} arm cannot reach the block where it is handed over, at "
                    f"({', '.join(f'{each:g}' for each in MEETING_M)}) m: move the base"
                )


def _corners(settings: HandoverSettings, arm: int, kind: str) -> Array:
    reach, turn = getattr(settings, f"{kind}_range_m"), getattr(settings, f"{kind}_turn_rad")
    return np.array([(x, y, yaw) for x, y in itertools.product((-reach, reach), repeat=2) for yaw in (-turn, turn)])


def _unreached(scene: SceneSettings, giver: int, arm: int, blocks: Poses) -> list[int]:
    """Return the indices of the blocks, (n, ...), that an arm cannot grip or approach."""
    grip, frames, mount = GRIPS[giver], Frames(scene.mounts), scene.mounts[arm]
    missed: set[int] = set()
    for back in (APPROACH_M, 0.0):
        offset = compose(Poses(grip.position_m[arm], grip.quat[arm]), Poses(np.array([0.0, 0.0, -back]), np.eye(4)[0]))
        flange = flanges_of(compose(blocks, offset), levers_m(scene.equipment.tools)[arm])
        both = [np.repeat(part[:, None], 2, axis=1) for part in flange]
        position, quat = frames.position_to_base(both[0])[:, arm], frames.quat_to_base(both[1])[:, arm]
        near = np.broadcast_to(home_q_rad(scene.mounts)[arm], (len(position), 6))
        _, reached = try_nearest(position, quat_to_matrix(quat), near, mount.dh)
        missed.update(np.flatnonzero(~reached).tolist())
    return sorted(missed)
