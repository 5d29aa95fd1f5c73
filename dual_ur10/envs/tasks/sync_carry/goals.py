"""Goals of both tools of a carry: where the reward leads them, and what agents observe of them.

A tool goes to its grip on the bar's reference at the end of the next motion. Before the path begins that is where the
bar lies, and as long as its gripper does not hold the bar it comes from behind (`dual_ur10.envs.tasks.tool_goals`).
The grip is `LEARNERS_ROOM_M` above the task's; welded, it is the task's.
The reward takes the reference now instead.
"""

from __future__ import annotations

from dual_ur10.assets.props import BAR_WIDTH_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool
from dual_ur10.envs.tasks.agent_observations import AgentObservations
from dual_ur10.envs.tasks.holding import LEARNERS_ROOM_M
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.envs.tasks.tool_goals import GOAL_FIELDS, GRIPPER_FIELDS, approach, goal_observations, rows
from dual_ur10.kernel import Struct
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.poses import Poses


def goal_fields(settings: CarrySettings) -> tuple[Field, ...]:
    """Return the fields of goals; with a rigid grasp there are no grippers."""
    return tuple(field for field in GOAL_FIELDS if not settings.rigid or field.name not in GRIPPER_FIELDS)


def goals(settings: CarrySettings, tools: tuple[Tool, Tool] = DEFAULT_TOOLS) -> Struct:
    """Return the goals' constants, for the kernel."""
    grip = settings.grip
    position = grip.position_m.copy()
    if not settings.rigid:
        position[:, 2] += LEARNERS_ROOM_M
    return Struct("CarryGoals", approach=approach(BAR_WIDTH_M, tools), grips=rows(Poses(position, grip.quat)))


def agent_observations(
    settings: CarrySettings,
    layout: ObservationLayout,
    own: ObservationLayout,
    mounts: tuple[ArmMount, ArmMount],
    tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
) -> AgentObservations:
    """Return the function that adds the goals' fields to what each arm observes; see `goal_observations`."""
    return goal_observations(
        "CarryAgents",
        "carry_agents",
        layout,
        own,
        mounts,
        BAR_WIDTH_M,
        {"bar": "bar_base_m", "ahead": "ahead_base_m"},
        tools,
        goals=goals(settings, tools),
        grip_m=settings.grip.position_m,
    )
