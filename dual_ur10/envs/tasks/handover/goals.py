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

Tools come to grips as in `dual_ur10.envs.tasks.tool_goals`; the receiver comes from the farther behind, the farther the
block is from the transfer. The giver has left the block once its grip is no longer between its fingers.

Goals of the grippers: the giver's is to close in "pick" and the receiver's in "take", where they have arrived; both
stay closed until the giver has to open in "release", and the receiver at the target.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS, home_q_rad
from dual_ur10.assets.tool import Tool, levers_m
from dual_ur10.envs.tasks.agent_observations import AgentObservations
from dual_ur10.envs.tasks.handover.settings import GRIPS, MEETING_M, laid_quat, presented_quat
from dual_ur10.envs.tasks.handover.stages import LIFTED_M, MEETING_RANGE_M, WIDTH_M
from dual_ur10.envs.tasks.observation_layout import ObservationLayout
from dual_ur10.envs.tasks.tool_goals import approach, goal_observations, rows
from dual_ur10.kernel import Struct
from dual_ur10.kinematics import flange_pose_quat
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses, compose
from dual_ur10.kinematics.rotations import rotate

_CARRIED_M: Final = LIFTED_M + 0.05  # height of the block's middle to which it is lifted before it is turned
_LEAVE_M: Final = 0.1  # from the target: a block that nobody holds there is not picked up again
_ROOM_M: Final = 0.007  # that a learner's fingers need above the table, beside that below the giver's grip
_ARRIVED_M: Final = 0.02  # from the transfer: within it the receiver goes to the block itself


def goals(mounts: tuple[ArmMount, ArmMount], tools: tuple[Tool, Tool] = DEFAULT_TOOLS) -> Struct:
    """Return the goals' constants, for the kernel."""
    grips, presented, laid = np.zeros((2, 2, 12)), np.zeros((2, 12)), np.zeros((2, 12))
    for giver in (0, 1):
        position, quat = GRIPS[giver].position_m.copy(), GRIPS[giver].quat
        position[giver, 2] += _ROOM_M
        grips[giver] = rows(Poses(position, quat))
        receiver = Poses(position[1 - giver], quat[1 - giver])
        laid[giver] = rows(compose(Poses(np.zeros(3), laid_quat(np.array(0.0))), receiver))
        presented[giver] = rows(Poses(MEETING_M, presented_quat(giver)))
    frames = Frames(mounts)
    found = [flange_pose_quat(q, mount.dh) for q, mount in zip(home_q_rad(mounts), mounts, strict=True)]
    quat = frames.quat_to_cell(np.stack([each[1] for each in found]))
    flange_m = frames.position_to_cell(np.stack([each[0] for each in found]))
    return Struct(
        "HandoverGoals",
        approach=approach(WIDTH_M, tools),
        leave_m=_LEAVE_M,
        lifted_m=LIFTED_M,
        carried_m=_CARRIED_M,
        meeting_m=MEETING_RANGE_M,
        arrived_m=_ARRIVED_M,
        grip_m=np.stack([each.position_m for each in GRIPS]),
        grips=grips,
        presented=presented,
        laid=laid,
        home=rows(Poses(flange_m + rotate(quat, levers_m(tools)), quat)),
    )


def agent_observations(
    layout: ObservationLayout,
    own: ObservationLayout,
    mounts: tuple[ArmMount, ArmMount],
    tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
) -> AgentObservations:
    """Return the function that adds the goals' fields to what each arm observes; see `goal_observations`."""
    fields = {"block": "block_base_m", "target": "target_base_m", "role": "role"}
    return goal_observations(
        "HandoverAgents", "handover_agents", layout, own, mounts, WIDTH_M, fields, tools, goals=goals(mounts, tools)
    )
