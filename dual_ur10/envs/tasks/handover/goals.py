"""Goals of both tools in each phase of a handover: where the reward leads them, and what is observed of it.

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

Tools come to grips from behind (`dual_ur10.envs.tasks.geometry.Goal`); the receiver comes from the farther behind, the
farther the block is from the transfer. The giver has left the block once its grip is no longer between its fingers.

Goals of the grippers: the giver's is to close in "pick" and the receiver's in "take", where they have arrived; both
stay closed until the giver has to open in "release", and the receiver at the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple, TypeVar

import numpy as np

from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.assets.settings import DEFAULT_TOOLS, home_q_rad
from dual_ur10.envs.tasks.geometry import (
    APPROACH_M,
    KEEP,
    LEVER_M,
    TOOL,
    FrameDistances,
    Goal,
    GoalSteps,
    Number,
    ToolSteps,
    frame_of,
    numbers,
)
from dual_ur10.envs.tasks.grasps import Grasped, Grasps
from dual_ur10.envs.tasks.handover.settings import GRIPS, MEETING_M, laid_quat, presented_quat
from dual_ur10.envs.tasks.staged import Cases
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import rotate
from ur_core.tools.tool import Tool, levers_m
from ur_core.types import Array, Rows

_T = TypeVar("_T")

WIDTH_M: Final = BLOCK_SIZE_M[1]
"""Width of the block between the fingers."""

LIFTED_M: Final = 0.08
"""Height of the block's middle above the table at which it counts as lifted."""

MEETING_RANGE_M: Final = 0.05
"""Distance from the transfer within which the block counts as presented."""

_CARRIED_M: Final = LIFTED_M + 0.05  # height of the block's middle to which it is lifted before it is turned
_LEAVE_M: Final = 0.1  # from the target: a block that nobody holds there is not picked up again
_ROOM_M: Final = 0.007  # that a learner's fingers need above the table, beside that below the giver's grip
_ARRIVED_M: Final = 0.02  # from the transfer: within it the receiver goes to the block itself

GIVER, RECEIVER = 0, 1
_BLOCK, _TARGET, _CELL = range(3)  # frames of goals


class GoalCase(NamedTuple):
    """Conditions on which the goals depend; the arms are by side.

    Attributes:
        right_gives: The right arm is the giver.
        between: Each gripper's grip of the block is between its fingers: left, right.
        holds: It holds the block.
        narrow: Its fingers would not be clear of the block.
        lifted: The block is lifted.
        met: It is near the transfer.
        arrived: It is at the transfer.
        near_target: It is near its target.
    """

    right_gives: bool
    left_between: bool
    right_between: bool
    left_holds: bool
    right_holds: bool
    left_narrow: bool
    right_narrow: bool
    lifted: bool
    met: bool
    arrived: bool
    near_target: bool


class Plan(NamedTuple):
    """Goals of both arms, left and right.

    Attributes:
        goal: Numbers of the goals of the tools.
        rises: 1 for a tool that rises with the block; else 0.
        takes: 1 for a tool that comes to the block at the transfer; else 0.
        closes_within: A gripper is to be closed while `ToolSteps.away` is smaller.
        closes_beyond: Likewise, while it is not smaller.
    """

    goal: tuple[int, int]
    rises: tuple[float, float]
    takes: tuple[float, float]
    closes_within: tuple[float, float]
    closes_beyond: tuple[float, float]


class GripCondition(NamedTuple):
    """Conditions of one arm, in one case."""

    between: bool
    holds: bool
    narrow: bool


def phase_of(case: GoalCase) -> str:
    """Return the phase. A gripper that opens still encloses the block: only then may the block move."""
    giver, receiver = _grips(case)
    if receiver.holds:
        return "release" if giver.between else "place"
    if not giver.holds:
        return "leave" if case.near_target else "pick"
    if not case.lifted:
        return "lift"
    return "take" if case.met else "present"


def plan_of(case: GoalCase) -> Plan:
    """Return the goals of both arms."""
    phase, (giver, receiver) = phase_of(case), _grips(case)
    gives, takes = phase, phase
    if phase == "release" and giver.between and giver.narrow:
        gives = "open"
    if phase == "take" and case.arrived:
        takes = "take here"
    if phase == "leave" and receiver.between and receiver.narrow:
        takes = "open"
    # Fingers close where their tool has arrived; those that have begun to go on at a larger error.
    closing = [(KEEP if grip.narrow else 1.0) if grip.between else NEVER for grip in (giver, receiver)]
    given = {"pick": closing[GIVER], "lift": ALWAYS, "present": ALWAYS, "take": ALWAYS}.get(phase, NEVER)
    taken = {"take": closing[RECEIVER], "release": ALWAYS}.get(phase, NEVER)
    by_side = _by_side(case)
    return Plan(
        by_side(_NUMBERS[GIVER, case.right_gives, gives], _NUMBERS[RECEIVER, case.right_gives, takes]),
        by_side(float(phase == "lift"), 0.0),
        by_side(0.0, float(phase == "take")),
        by_side(given, taken),
        by_side(math.inf, 1.0 if phase == "place" else math.inf),
    )


NEVER, ALWAYS = 0.0, math.inf


def _grips(case: GoalCase) -> tuple[GripCondition, GripCondition]:
    """Return the conditions of giver and receiver."""
    left = GripCondition(case.left_between, case.left_holds, case.left_narrow)
    right = GripCondition(case.right_between, case.right_holds, case.right_narrow)
    return (right, left) if case.right_gives else (left, right)


def _by_side(case: GoalCase) -> Callable[[_T, _T], tuple[_T, _T]]:
    """Return a function from values of giver and receiver to those of the left and the right arm."""
    return lambda giver, receiver: (receiver, giver) if case.right_gives else (giver, receiver)


def goals_of(giver: int, home: Poses) -> tuple[dict[str, Goal], dict[str, Goal]]:
    """Return the goals of giver and receiver, by phase or variant of one."""
    grips = [Poses(GRIPS[giver].position_m[arm], GRIPS[giver].quat[arm]) for arm in (giver, 1 - giver)]
    grips[GIVER] = Poses(grips[GIVER].position_m + np.array([0.0, 0.0, _ROOM_M]), grips[GIVER].quat)
    behind = Poses(np.array([0.0, 0.0, -APPROACH_M]), np.eye(4)[0])
    given, taken = (compose(Poses(MEETING_M, presented_quat(giver)), grip) for grip in grips)
    laid = compose(Poses(np.zeros(3), laid_quat(np.array(0.0))), grips[RECEIVER])
    wait = Goal(_CELL, Poses(home.position_m[1 - giver], home.quat[1 - giver]))
    show, retreat = Goal(_CELL, given), Goal(_CELL, compose(given, behind))
    return (
        {
            "pick": Goal(_BLOCK, grips[GIVER], approached=True),
            "lift": Goal(TOOL),
            "present": show,
            "take": show,
            "release": retreat,
            "open": Goal(_CELL, given, further_m=APPROACH_M),
            "place": retreat,
            "leave": retreat,
        },
        {
            "pick": wait,
            "lift": wait,
            "present": wait,
            "take": Goal(_CELL, taken, approached=True),
            "take here": Goal(_BLOCK, grips[RECEIVER], approached=True),
            "release": Goal(_CELL, taken),
            "place": Goal(_TARGET, laid, approached=True),
            "leave": Goal(_TARGET, compose(laid, behind)),
            "open": Goal(TOOL),
        },
    )


def _numbered() -> dict[tuple[int, int, str], int]:
    """Return the number of each goal by role, giver and name, in the order of `HandoverGoals`."""
    names = [tuple(goals) for goals in goals_of(0, Poses(np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))))]
    keys = [(role, giver, name) for giver in (0, 1) for role in (GIVER, RECEIVER) for name in names[role]]
    return {key: number for number, key in enumerate(keys)}


_NUMBERS: Final = _numbered()


class Situation(NamedTuple):
    """Block and plan of n handovers, whatever the tools do.

    Attributes:
        height_m: (n,) height of the block's middle above the table.
        off_m: (n,) distance of the block from the transfer, with its rotation.
        moved_m: (n, pairs) distances of the block from the transfer, its target, and further frames.
        axis_rad: (n, pairs) angles between the long axes.
        plan: Goals.
    """

    height_m: Number
    off_m: Number
    moved_m: Array
    axis_rad: Array
    plan: Plan


class HandoverGoals:
    """Grasps of n handovers, and the goals of their tools.

    Args:
        n: Number of handovers.
        mounts: Mounts of the arms.
        further: Number of further frames that the block is compared with.
        tools: Tools of the arms.

    Attributes:
        grasps: Measurement of the grasps of block and target.
        to_block: Distances of the block from the transfer and its target, and from further frames.
        steps: Steps of the tools.
        commanded: Steps of the commanded tools.
    """

    def __init__(
        self,
        n: int,
        mounts: tuple[ArmMount, ArmMount],
        further: int = 0,
        *,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        self._giver: Rows = np.zeros(n, dtype=np.intp)
        self._grip_m: Array = np.zeros((n, 2, 3))
        self.grasps = Grasps(Frames(mounts), self._grip_m, WIDTH_M, 2, tools=tools)
        self.to_block = FrameDistances(n, 2, [_BLOCK] * (2 + further))
        meeting = Poses(np.tile(MEETING_M, (2, 1)), np.stack([presented_quat(giver) for giver in (0, 1)]))
        self._presented = frame_of(meeting)
        home = _home(mounts, tools)
        goals = [goal for giver in (0, 1) for role in goals_of(giver, home) for goal in role.values()]
        self.steps = GoalSteps(n, 2, goals)
        self.commanded = GoalSteps(n, 2, goals, mounts, tcp_m=[tool.tcp_m for tool in tools])
        self._plan = Cases(GoalCase, plan_of)
        self.begin(np.arange(n), self._giver)

    def begin(self, rows: Rows, giver: Rows) -> None:
        """Begin handovers with these givers."""
        self._giver[rows] = giver
        self._grip_m[rows] = _GRIP_M.take(giver, axis=0)
        self.to_block.others[rows, 0] = self._presented.take(giver, axis=0)

    def situation(self, grasped: Grasped) -> Situation:
        """Return block and plan, from the grasps of block and target."""
        self.to_block.others[:, 1] = grasped.frames[:, _TARGET]
        moved_m, chord, axis_rad = self.to_block(grasped.frames)
        (height_m,) = numbers(grasped.frames[:, _BLOCK, 2:3].T)
        (away_m, error_m, *_), (turned, *_) = numbers(moved_m.T), numbers(chord.T)
        off_m = away_m + LEVER_M * turned
        (right_gives,) = numbers(self._giver[None] > 0)
        left_between, right_between = numbers(grasped.between.T)
        left_holds, right_holds = numbers(grasped.holding.T)
        left_narrow, right_narrow = numbers((grasped.cleared < 1.0).T)
        case = GoalCase(
            right_gives,
            left_between,
            right_between,
            left_holds,
            right_holds,
            left_narrow,
            right_narrow,
            height_m > LIFTED_M,
            off_m < MEETING_RANGE_M,
            off_m < _ARRIVED_M,
            error_m < _LEAVE_M,
        )
        return Situation(height_m, off_m, moved_m.copy(), axis_rad.copy(), self._plan(case))

    def __call__(
        self, now: Situation, grasped: Grasped, commanded_q_rad: Array | None = None
    ) -> tuple[ToolSteps, tuple[Number, Number]]:
        """Return the steps to the goals, and True for a gripper, left and right, that is to be closed.

        Args:
            now: Block and plan.
            grasped: Grasps of block and target.
            commanded_q_rad: Joint positions of the commanded tools, whose steps are wanted; None: those of the tools.
        """
        plan, higher_m = now.plan, _CARRIED_M - now.height_m
        follow, tools = self.steps, grasped.tools
        if commanded_q_rad is not None:
            follow, tools = self.commanded, commanded_q_rad
            follow.actual[...] = grasped.tools
        rise_m = [rises * higher_m for rises in plan.rises]
        steps = follow(tools, grasped.frames, plan.goal, rise_m, [takes * now.off_m for takes in plan.takes])
        left, right = (
            (away < within) | (away >= beyond)
            for away, within, beyond in zip(numbers(steps.away.T), plan.closes_within, plan.closes_beyond, strict=True)
        )
        return steps, (left, right)


_GRIP_M: Final = np.stack([each.position_m for each in GRIPS])


def _home(mounts: tuple[ArmMount, ArmMount], tools: tuple[Tool, Tool]) -> Poses:
    """Return the poses of both tools at home, in the cell frame."""
    frames = Frames(mounts)
    found = [flange_pose_quat(q, mount.dh) for q, mount in zip(home_q_rad(mounts), mounts, strict=True)]
    quat = frames.quat_to_cell(np.stack([each[1] for each in found]))
    flange_m = frames.position_to_cell(np.stack([each[0] for each in found]))
    return Poses(flange_m + rotate(quat, levers_m(tools)), quat)
