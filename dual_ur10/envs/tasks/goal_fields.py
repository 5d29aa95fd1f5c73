"""Fields of an observation that lead a tool to its goal.

They follow from what is measured and from the commanded joint positions, with the same goals to which the reward leads.
Fingers close once tool and goal agree within 10 mm and 0.08 rad.
"""

from __future__ import annotations

from typing import Any, Final

from dual_ur10.envs.tasks.geometry import NEAR, NEAR_M, Nearby, ToolSteps
from dual_ur10.envs.tasks.observation_layout import Field
from ur_core.types import Array, Mask

_STEP: Final = f"saturated: x / ({NEAR_M:g} m + abs(x))"
_TURN: Final = f"saturated: x / ({NEAR:g} + abs(x))"
_CHORD: Final = "2 sin(angle / 2)"

GOAL_FIELDS: Final = (
    Field(
        "goal_step_m",
        3,
        -20.0,
        20.0,
        "position (m)",
        "step from the commanded tool to its goal, in the cell frame",
        concise=(0.2, 0.01),
    ),
    Field("goal_rotation", 3, -2.01, 2.01, _CHORD, "rotation of this step, along its axis", concise=(0.5, 0.03)),
    Field("goal_step_saturated", 3, -1.0, 1.0, "ratio", f"step to the goal, {_STEP}"),
    Field("goal_rotation_saturated", 3, -1.0, 1.0, "ratio", f"rotation to the goal, {_TURN}"),
    Field("lag_saturated", 3, -1.0, 1.0, "ratio", f"step from the tool to the commanded tool, {_STEP}", concise=(1.0,)),
    Field("lag_rotation_saturated", 3, -1.0, 1.0, "ratio", f"rotation of this step, {_TURN}", concise=(1.0,)),
    Field("between", 1, 0.0, 1.0, "0 or 1", "1 if the grip of the object is between the fingers", concise=(0.2,)),
    Field("opening", 1, -1.2, 1.2, "ratio", "opening of the gripper, of the largest", concise=(0.5,)),
    Field("goal_opening", 1, 0.0, 1.0, "ratio", "goal of the gripper: 0 closed, 1 open", concise=(0.2,)),
    Field(
        "goal_closeness",
        2,
        0.0,
        1.0,
        "ratio",
        f"{NEAR_M:g} m / ({NEAR_M:g} m + path left to the goal), and {NEAR:g} / ({NEAR:g} + rotation left)",
        concise=(0.5,),
    ),
)
"""Last fields of the tasks with objects."""

GRIPPER_FIELDS: Final = ("between", "opening", "goal_opening")
"""Those of them that need a gripper."""


def goal_values(steps: ToolSteps, nearby: Nearby) -> dict[str, Array]:
    """Return the values of `GOAL_FIELDS` that need no gripper, of the commanded tools."""
    move, turn, lag, lag_turn = nearby.saturated.swapaxes(0, 2).swapaxes(1, 2)
    return {
        "goal_step_m": steps.move_m,
        "goal_rotation": steps.turn,
        "goal_step_saturated": move,
        "goal_rotation_saturated": turn,
        "lag_saturated": lag,
        "lag_rotation_saturated": lag_turn,
        "goal_closeness": nearby.closeness,
    }


def gripper_values(between: Mask, closes: Mask, opening_m: Array, stroke_m: Array) -> dict[str, Any]:
    """Return the values of `GRIPPER_FIELDS`.

    Args:
        between: (n, 2) True for a grip that is between the fingers.
        closes: (n, 2) True for a gripper that is to be closed.
        opening_m: (n, 2, 1) widths between the fingers.
        stroke_m: (2, 1) the largest of each gripper.
    """
    return {"between": between[..., None], "opening": opening_m / stroke_m, "goal_opening": ~closes[..., None]}
