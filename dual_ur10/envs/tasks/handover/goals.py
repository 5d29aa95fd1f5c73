"""Goals of both tools in each phase of a handover: where the reward leads them, and what agents observe of it.

The phases follow from the present alone: who holds the block, and where it is.

| phase | condition | goal of the giver's tool | goal of the receiver's tool |
|-------|-----------|--------------------------|-----------------------------|
| pick | no gripper holds the block, far from its target | its grip | home |
| lift | the giver alone holds it, low | up | home |
| present | the giver alone holds it, lifted | its grip at the transfer | home |
| take | the giver alone holds it, at the transfer | the same | its grip |
| release | the receiver holds it, the giver has not left | the same; behind, once clear | its grip at the transfer |
| place | the receiver holds it, the giver has left | behind its grip at the transfer | its grip on the target |
| leave | no gripper holds the block, near its target | the same | behind, once clear |

A tool that goes to a grip goes to a point behind it first, along its own z: up to `APPROACH_M`, in proportion to how
far it is beside the line, how far it is turned (`LEVER_M`), and for the receiver how far the block is from the
transfer. So the fingers pass the block on both sides, and a straight step to the goal never pushes the block.

Fingers are clear of the block at `CLEAR_M`. The giver has left it once its grip is no longer between its fingers.

Goals of the grippers: the giver's is to close in "pick" and the receiver's in "take", once tool and goal agree within
`_THERE_M` and `_THERE`; both stay closed until the giver has to open in "release", and the receiver at the target.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.assets.gripper import OPENING_M, TCP_M
from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.tasks.agent_observations import AgentObservations
from dual_ur10.envs.tasks.handover.settings import (
    APPROACH_M,
    GRIPS,
    MEETING_M,
    laid_quat,
    presented_quat,
)
from dual_ur10.envs.tasks.handover.stages import CLEAR_M, LEVER_M, LIFTED_M, MEETING_RANGE_M, WIDTH_M
from dual_ur10.envs.tasks.holding import TCP_LEVER, grasp_limits
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.kernel import Struct
from dual_ur10.kinematics import flange_pose_quat
from dual_ur10.kinematics.forward import links
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses, compose
from dual_ur10.kinematics.rotations import quat_to_matrix, rotate
from dual_ur10.types import Array

_CARRIED_M: Final = LIFTED_M + 0.05  # height of the block's middle to which it is lifted before it is turned
_LEAVE_M: Final = 0.1  # from the target: a block that nobody holds there is not picked up again
_THERE_M: Final = 0.01  # of the goal: there fingers close or open
_THERE: Final = 0.08  # the same of its rotation
_KEEP: Final = 3.0  # times these: fingers that have begun to close go on
_ROOM_M: Final = 0.007  # that a learner's fingers need above the table, beside that below the giver's grip
_ASIDE: Final = 1.5  # m behind the grip for each m beside the line
_SLACK_M: Final = 0.01  # of such an error, at which a goal is not behind its grip
_ARRIVED_M: Final = 0.02  # from the transfer: within it the receiver goes to the block itself
# Distances and rotations at which the terms of a nearness have fallen to their halves.
_SCALES_M: Final = np.array([0.03, 0.3])
_SCALES: Final = np.array([0.2, 1.0])
# Lengths of steps of which half is left when they are saturated.
_NEAR_M: Final = 0.01
_NEAR: Final = 0.03

GOAL_FIELDS: Final = (
    Field("goal_step_m", 3, -20.0, 20.0, "position (m)", "step from the commanded tool to its goal, in the cell frame"),
    Field("goal_rotation", 3, -2.01, 2.01, "2 sin(angle / 2)", "the same of its rotation, along the axis"),
    Field("goal_step_saturated", 3, -1.0, 1.0, "ratio", f"x / ({_NEAR_M:g} m + |x|) of this step"),
    Field("goal_rotation_saturated", 3, -1.0, 1.0, "ratio", f"x / ({_NEAR:g} + |x|) of this rotation"),
    Field("lag_saturated", 3, -1.0, 1.0, "ratio", "the same of the step from the tool to the commanded tool"),
    Field("lag_rotation_saturated", 3, -1.0, 1.0, "ratio", "the same of its rotation"),
    Field("between", 1, 0.0, 1.0, "0 or 1", "its grip of the block is between its fingers"),
    Field("opening", 1, -1.2, 1.2, "ratio", "opening of the gripper, of the largest"),
    Field("goal_opening", 1, 0.0, 1.0, "0 or 1", "goal of the gripper: 0 closed, 1 open"),
    Field(
        "goal_closeness", 2, 0.0, 1.0, "ratio", f"{_NEAR_M:g} m / ({_NEAR_M:g} m + way left); the same of the rotation"
    ),
)
"""Fields that agents observe beside those of their arms."""


def goals(mounts: tuple[ArmMount, ArmMount]) -> Struct:
    """Return the goals' constants, for the kernel."""
    grips, presented, laid = np.zeros((2, 2, 12)), np.zeros((2, 12)), np.zeros((2, 12))
    for giver in (0, 1):
        position, quat = GRIPS[giver].position_m.copy(), GRIPS[giver].quat
        position[giver, 2] += _ROOM_M
        grips[giver] = _rows(Poses(position, quat))
        receiver = Poses(position[1 - giver], quat[1 - giver])
        laid[giver] = _rows(compose(Poses(np.zeros(3), laid_quat(np.array(0.0))), receiver))
        presented[giver] = _rows(Poses(MEETING_M, presented_quat(giver)))
    frames = Frames(mounts)
    found = [flange_pose_quat(q, mount.dh) for q, mount in zip(home_q_rad(mounts), mounts, strict=True)]
    quat = frames.quat_to_cell(np.stack([each[1] for each in found]))
    flange_m = frames.position_to_cell(np.stack([each[0] for each in found]))
    return Struct(
        "HandoverGoals",
        tcp_m=TCP_M,
        leave_m=_LEAVE_M,
        clear_m=CLEAR_M,
        lifted_m=LIFTED_M,
        carried_m=_CARRIED_M,
        meeting_m=MEETING_RANGE_M,
        back_m=APPROACH_M,
        lever_m=LEVER_M,
        aside=_ASIDE,
        slack_m=_SLACK_M,
        arrived_m=_ARRIVED_M,
        there_m=_THERE_M,
        there=_THERE,
        keep=_KEEP,
        scales_m=_SCALES_M,
        scales=_SCALES,
        grip_m=np.stack([each.position_m for each in GRIPS]),
        grips=grips,
        presented=presented,
        laid=laid,
        home=_rows(Poses(flange_m + rotate(quat, TCP_LEVER), quat)),
    )


def agent_observations(
    layout: ObservationLayout, own: ObservationLayout, constants: Struct, mounts: tuple[ArmMount, ArmMount]
) -> AgentObservations:
    """Return the function that adds `GOAL_FIELDS` to what each arm observes.

    Args:
        layout: Fields of an arm in a joint observation.
        own: Fields of an agent's observation.
        constants: Those of `goals`.
        mounts: Mounts of both arms.
    """
    frames = Frames(mounts)
    begins = {
        name: layout.indices([field])[0]
        for name, field in (
            ("commanded", "commanded_q_rad"),
            ("flange", "flange_base_m"),
            ("gripper", "gripper_m"),
            ("block", "block_base_m"),
            ("target", "target_base_m"),
            ("role", "role"),
        )
    }
    return AgentObservations(
        "HandoverAgents",
        "handover_agents",
        layout.size,
        own.size,
        opening_m=OPENING_M,
        near_m=_NEAR_M,
        near=_NEAR,
        links=np.stack([links(mount.dh) for mount in mounts]),
        base_m=frames.base_m,
        to_base=np.ascontiguousarray(frames.rotation),
        grips=grasp_limits(WIDTH_M),
        goals=constants,
        **begins,
    )


def _rows(poses: Poses) -> Array:
    matrix = quat_to_matrix(poses.quat)
    return np.concatenate([poses.position_m, matrix.reshape(*matrix.shape[:-2], 9)], axis=-1)
