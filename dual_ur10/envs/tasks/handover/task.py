"""Handover: one arm picks up a block and hands it to the other, which places it on its target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dual_ur10.assets.props import BLOCK, BLOCK_SIZE_M, TARGET
from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.tasks.geometry import PICKING, Number, length, numbers, ratio, required
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS, goal_values, gripper_values
from dual_ur10.envs.tasks.grasps import Grasped
from dual_ur10.envs.tasks.handover.goals import LIFTED_M, MEETING_RANGE_M, HandoverGoals, Situation
from dual_ur10.envs.tasks.handover.settings import HandoverSettings, block_pose, check_reach
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    OTHER_FLANGE_FIELDS,
    Field,
    ObservationLayout,
    arm_values,
    gripper_field,
    per_arm,
    pose_fields,
    pose_values,
    wrench_fields,
    wrench_values,
)
from dual_ur10.envs.tasks.staged import Progress, StagedTask, stage
from dual_ur10.envs.tasks.task import Outcome, SceneRequirements, Timing, duration_ratio
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits, reach_from_joint_m
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import rotate
from ur_core.tools.tool import strokes_m
from ur_core.types import Array, Rows

_TARGET, _BEFORE, _SHOULDERS = 1, 2, slice(3, 5)  # pairs of `HandoverGoals.to_block`, behind that of the transfer

STILL_M_S = 0.02
"""Speed below which the block counts as still."""

_PRECISION = 0.03  # further part of the term "finish" that a block exactly on its target earns
_FALLEN_M = -0.03  # height of the middle of a block that is no longer on the table
_BEYOND_M = BLOCK_SIZE_M[0] / 2  # from a shoulder farther than its tool: out of reach


Pair = Sequence[Number]


class HandoverMeasured(NamedTuple):
    """Poses at one instant; positions in the cell frame unless another is named.

    Attributes:
        block_m: (n, 3) position of the block.
        grasped: Both arms, block and target.
        now: Block and plan.
    """

    block_m: Array
    grasped: Grasped
    now: Situation


class Facts(NamedTuple):
    """Facts of one instant on which the stages depend, of each row; pairs are of giver and receiver.

    Attributes:
        between: True if the grip of the block is between the fingers.
        holds: True if the gripper holds the block.
        near: Nearness of the tool to its goal; less while fingers are not open that are to be open.
        shut: Closed fraction of fingers that are to be closed and have the grip between them; else 0.
        clear: Fraction to which the fingers are clear of the block.
        raised: Height of the block's middle above the table, 1 once it is lifted.
        carried: True if the giver holds the lifted block.
        presented: True if it does so at the transfer.
        placed: True if the block lies still on its target, and no gripper holds it.
        error: Error of its position from its target, 1 at the largest of a success.
        lost: True if it fell, or lies where no arm can reach it.
    """

    between: Pair
    holds: Pair
    near: Pair
    shut: Pair
    clear: Pair
    raised: Number
    carried: Number
    presented: Number
    placed: Number
    error: Number
    lost: Number


def facts_of(
    *,
    between: Pair,
    holds: Pair,
    closes: Pair,
    nearness: Pair,
    opened: Pair,
    closed: Pair,
    clear: Pair,
    height_m: Number,
    off_m: Number,
    laid: Number,
    error: Number,
    lost: Number,
) -> Facts:
    """Return the facts that follow from what is measured.

    Args:
        between: True if the grip of the block is between the fingers; of giver and receiver, like those that follow.
        holds: True if the gripper holds the block.
        closes: True if it is to be closed.
        nearness: Nearness of the tool to its goal.
        opened: Fraction to which the fingers are open; see `Grasped`.
        closed: Fraction to which they are closed.
        clear: Fraction to which they are clear of the block.
        height_m: Height of the block's middle.
        off_m: Distance of the block from the transfer.
        laid: True if the block lies still on its target.
        error: Error of its position from there, 1 at the largest of a success.
        lost: True if it is lost.
    """
    near = [near * (to + (1.0 - to) * (0.8 + 0.2 * by)) for near, to, by in zip(nearness, closes, opened, strict=True)]
    shut = [to * inside * by for to, inside, by in zip(closes, between, closed, strict=True)]
    raised = height_m / LIFTED_M
    carried = holds[0] & (raised > 1.0)
    presented = carried & (off_m < MEETING_RANGE_M)
    placed = laid & (holds[0] + holds[1] < 1)
    return Facts(between, holds, near, shut, clear, raised, carried, presented, placed, error, lost)


class Handover(StagedTask[HandoverSettings, HandoverMeasured, Facts]):
    """One arm picks up a block and hands it in the air to the other, which places it on a target.

    ## Description

    A block of 4 x 4 x 20 cm and 0.5 kg lies on the table on the side of the giver, its target on the side of the
    receiver. One arm alone cannot reach both: the giver grips one half of the block from above, lifts it and rotates
    its tool to the horizontal; the receiver grips the other half from the opposite side; the giver lets go and leaves;
    the receiver lowers the block onto its target and opens.

    The left gripper must hold the half at -x of the block's own x, the right gripper that at +x, each within 6 cm of
    the middle of its half. The block counts as presented within 0.05 m of its pose at the transfer, at
    (-0.1, -0.1, 0.35) m, where 0.1 rad of rotation count as 0.01 m.

    ## Action Space

    The action space is a `Box(-1.0, 1.0, (14,), float32)` with the default `action_mode="joint_delta"`: steps of the
    six joints of an arm from the last command, in fractions of the speed limit (1.2 rad/s) times the period (40 ms), and
    the opening of its gripper.

    The table shows the left arm; the right arm's numbers follow in the same order.

    | Num | Action | Control Min | Control Max | Name (in XML file) | Joint | Type (Unit) |
    |-----|--------|-------------|-------------|--------------------|-------|-------------|
    | 0 | step of the shoulder pan | -1 | 1 | left/shoulder_pan_joint | hinge | fraction of 0.048 (rad) |
    | 1 | step of the shoulder lift | -1 | 1 | left/shoulder_lift_joint | hinge | fraction of 0.048 (rad) |
    | 2 | step of the elbow | -1 | 1 | left/elbow_joint | hinge | fraction of 0.048 (rad) |
    | 3 | step of the wrist 1 | -1 | 1 | left/wrist_1_joint | hinge | fraction of 0.048 (rad) |
    | 4 | step of the wrist 2 | -1 | 1 | left/wrist_2_joint | hinge | fraction of 0.048 (rad) |
    | 5 | step of the wrist 3 | -1 | 1 | left/wrist_3_joint | hinge | fraction of 0.048 (rad) |
    | 6 | opening of the gripper | -1 | 1 | left/gripper | tendon | -1 is 0, 1 is 0.085 (m) |

    ## Observation Space

    The observation space is a `Box(low, high, (158,), float64)` with the bounds of the table: 79 numbers of the left
    arm, which the table shows, then the same 79 of the right arm, with left and right exchanged. All of them can be
    measured on a real cell. Poses, forces and torques are in the arm's own `base` frame unless another is named;
    quaternions are (w, x, y, z). The weight of the gripper is subtracted from the force, which has the noise of
    `CellConfig.wrench_noise`.

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 6-11 | joint speeds | -10 | 10 | left/shoulder_pan_joint ... left/wrist_3_joint | speed (rad/s) |
    | 12-17 | commanded joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 18-20 | position of the flange | -2 | 2 | left/flange | position (m) |
    | 21-24 | orientation of the flange | -1.01 | 1.01 | left/flange | quaternion |
    | 25 | opening of the gripper | -0.1 | 0.1 | left/finger_1_joint ... left/finger_2_joint | position (m) |
    | 26-28 | force of the block on the gripper | -2000 | 2000 | left/wrench | force (N) |
    | 29-31 | torque of the block on the gripper about the flange | -2000 | 2000 | left/wrench | torque (N·m) |
    | 32-34 | position of the block | -10 | 10 | block/block | position (m) |
    | 35-38 | orientation of the block | -1.01 | 1.01 | block/block | quaternion |
    | 39-41 | position of the target | -10 | 10 | target/target | position (m) |
    | 42-45 | orientation of the target | -1.01 | 1.01 | target/target | quaternion |
    | 46-48 | position of the other flange in the frame of this one | -5 | 5 | right/flange | position (m) |
    | 49-52 | orientation of the other flange in the frame of this one | -1.01 | 1.01 | right/flange | quaternion |
    | 53 | opening of the other gripper | -0.1 | 0.1 | right/finger_1_joint ... right/finger_2_joint | position (m) |
    | 54 | role: 1 gives, -1 receives | -1.01 | 1.01 | - | sign |
    | 55 | elapsed fraction of the episode's time | -1.01 | 1.01 | - | ratio |
    | 56-58 | step from the commanded tool to its goal, in the cell frame | -20 | 20 | - | position (m) |
    | 59-61 | rotation of this step, along its axis | -2.01 | 2.01 | - | 2 sin(angle / 2) |
    | 62-64 | step to the goal, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio |
    | 65-67 | rotation to the goal, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio |
    | 68-70 | step from the tool to the commanded tool, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio |
    | 71-73 | rotation of this step, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio |
    | 74 | 1 if the grip of the object is between the fingers | 0 | 1 | - | 0 or 1 |
    | 75 | opening of the gripper, of the largest | -1.2 | 1.2 | - | ratio |
    | 76 | goal of the gripper: 0 closed, 1 open | 0 | 1 | - | ratio |
    | 77-78 | 0.01 m / (0.01 m + path left to the goal), and 0.03 / (0.03 + rotation left) | 0 | 1 | - | ratio |

    An agent of the two-agent environment observes its arm's numbers.

    With `observation="goals"` the observation space is a `Box(-1.0, 1.0, (64,), float32)`: 32 numbers of the left arm,
    then those of the right arm. A value x is shown as x / (u + abs(x)), in each unit u that the table names
    (`dual_ur10.envs.tasks.observation_layout.ConciseView`).

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | commanded joint positions, from home | -1 | 1 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) in 1 |
    | 6 | opening of the other gripper | -1 | 1 | right/finger_1_joint ... right/finger_2_joint | position (m) in 0.05 |
    | 7 | role: 1 gives, -1 receives | -1 | 1 | - | sign in 0.2 |
    | 8 | elapsed fraction of the episode's time | -1 | 1 | - | ratio in 0.5 |
    | 9-14 | step from the commanded tool to its goal, in the cell frame | -1 | 1 | - | position (m) in 0.2 and 0.01 |
    | 15-20 | rotation of this step, along its axis | -1 | 1 | - | 2 sin(angle / 2) in 0.5 and 0.03 |
    | 21-23 | step from the tool to the commanded tool, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio in 1 |
    | 24-26 | rotation of this step, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio in 1 |
    | 27 | 1 if the grip of the object is between the fingers | -1 | 1 | - | 0 or 1 in 0.2 |
    | 28 | opening of the gripper, of the largest | -1 | 1 | - | ratio in 0.5 |
    | 29 | goal of the gripper: 0 closed, 1 open | -1 | 1 | - | ratio in 0.2 |
    | 30-31 | 0.01 m / (0.01 m + path left to the goal), and 0.03 / (0.03 + rotation left) | -1 | 1 | - | ratio in 0.5 |

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of the parts of giver and receiver below, which are what their agents
    earn. A part has its largest value once its stage is passed, and measures progress until then. It is 0 before its
    stage begins, but for the receiver's part of *present*.

    Progress is mostly the nearness (`dual_ur10.envs.tasks.geometry.ToolSteps`) of a tool to its goal in the present phase
    (`dual_ur10.envs.tasks.handover.goals`).

    - *reach* (0.1): passed when the giver's grip of the block is between its fingers. Giver, 2: twice its squared
      nearness, which is small where an episode begins.
    - *grasp* (0.1): passed when the giver holds the block. Giver, 2: while the grip is between its fingers, its
      nearness, and the closed fraction of its gripper once that is its goal.
    - *lift* (0.1): passed when the giver holds the block with its middle more than 8 cm above the table. Giver, 2: while
      it holds the block, twice the fraction of that height.
    - *present* (0.1): passed when the lifted block is presented. Giver, 1.2: its nearness while it holds the lifted
      block. Receiver, 0.8: its nearness, from the first step on.
    - *mutual_grasp* (0.15): passed when both hold the lifted block. Giver, 1: its nearness while the block is presented.
      Receiver, 1: while the block is presented, 0.6 of its nearness, and 0.4 of the closed fraction of its gripper once
      that is its goal.
    - *release* (0.15): passed when the receiver holds the lifted block, and the giver has left it: its grip is no longer
      between the fingers. While the receiver holds the block: giver, 1.5: how far its fingers have opened, 1 once they
      are 7 mm wider than the block, and 0.5 of its nearness; receiver, 0.5: 0.5 of its nearness.
    - *place* (0.3): passed when the block lies still on its target, within `success_error_m` and `success_turn_rad`, and
      no gripper holds it. While the receiver holds it: giver, 0.4: 0.2 of how far its fingers have opened, and 0.2 of
      its nearness; receiver, 1.6: 1.3 times its nearness, once the giver has left the block. A receiver that has let
      the block go elsewhere: 0.2 / (1 + error / `success_error_m`).
    - *finish* (1.0): both. At a step that ends an episode with success, the number of its remaining steps, times
      1 + 0.03 (1 - error / `success_error_m`); otherwise 0. It replaces the reward of the remaining steps, so that hovering
      near the target earns no more than success.

    `info["stage"]` is the number of stages passed in their order, 0 to 7, and never falls in an episode. `info` also
    holds these values without noise:

    - `giver`: 0 left, 1 right.
    - `object_m` (3,): position of the block; `object_error_m`, `object_error_rad`: its error from the target.
    - `slip_m` (2,): displacement of each grip in its gripper since the grasp; after the release, its last value.

    `object_error_rad` is the angle between the long axes of block and target. The direction of the axis matters; the
    rotation about it does not (the receiver grips the block from below and places it upside down).

    `info["is_success"]` is true at the end of an episode in which all stages were passed in their order and the block
    lies on its target.

    ## Starting State

    Both arms are at rest with open grippers above the table. The block lies at (0, ±0.5) m on the giver's side along
    the cell's x, shifted by up to `object_range_m` along x and y and rotated by up to `object_turn_rad`. The target
    lies on the other side, shifted and rotated by up to `target_range_m` and `target_turn_rad`. With `giver="random"` every episode samples
    the giver.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "success": all stages were passed and the block has lain on its target for 0.5 s;
    - "block_fell": it fell from the table;
    - "block_out_of_reach": it lies where no arm can reach it;
    - "refused/<limit>": with `on_refusal="terminate"`, the safety gate refused a motion; see `info["safety"]`;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    After `duration_s`, 500 steps with the defaults, with the reason "time"; longer in proportion if the cell's speed
    limits are tighter than the task's. No time limit is registered
    with the id; `env.spec.max_episode_steps` is this number.

    ## Arguments

    | Parameter | Type | Default | Description |
    |-----------|------|---------|-------------|
    | `giver` | str | `"left"` | "left", "right" or "random": the arm that picks the block up |
    | `duration_s` | float | `20.0` | length of an episode at the task's own speed limits (s) |
    | `grip_force_n` | float | `60.0` | force of each finger, 20 to 235 (N) |
    | `object_range_m` | float | `0.02` | initial position of the block, ± along x and y (m) |
    | `object_turn_rad` | float | `0.5236` | initial yaw of the block, ± (rad) |
    | `target_range_m` | float | `0.03` | position of the target, ± along x and y (m) |
    | `target_turn_rad` | float | `0.3` | yaw of the target, ± (rad) |
    | `success_error_m` | float | `0.015` | largest distance from the target of a success (m) |
    | `success_turn_rad` | float | `0.15` | largest angle from the target of a success (rad) |

    Those of every environment are described in `dual_ur10.envs.core.options.EnvOptions`.

    ## Version History

    - v0: first version.
    """

    limits: MotionLimits = MotionLimits(
        speed_rad_s=(1.2,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.5
    )
    accepted: ClassVar[dict[str, str]] = {"role": "giver='random' changes it"}
    per_arm: ClassVar[tuple[str, ...]] = ("slip_m",)
    settings_type: ClassVar[type[HandoverSettings]] = HandoverSettings
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS,
        gripper_field(),
        *wrench_fields("block"),
        *pose_fields("block_base", "the block", "block/block"),
        *pose_fields("target_base", "the target", "target/target"),
        *OTHER_FLANGE_FIELDS,
        replace(gripper_field("other"), concise=(0.05,)),
        Field("role", 1, -1.01, 1.01, "sign", "role: 1 gives, -1 receives", concise=(0.2,)),
        Field("progress", 1, -1.01, 1.01, "ratio", "elapsed fraction of the episode's time", concise=(0.5,)),
        *GOAL_FIELDS,
    )

    def __init__(self, settings: HandoverSettings, cell: CellConfig, timing: Timing, n: int) -> None:
        duration_s = settings.duration_s * duration_ratio(type(self).limits, cell.capped(type(self).limits))
        super().__init__(settings, cell, timing, n, duration_s)
        mounts, tools = (cell.left, cell.right), cell.equipment.tools
        check_reach(settings, cell.scene)
        self._role: Array = np.ones((n, 2, 1))
        self._goals = HandoverGoals(n, mounts, 3, tools=tools)
        self._strokes_m = np.array(strokes_m(tools))[:, None]
        self._still_m = STILL_M_S * timing.period_s
        self._slip_from_m: Array = np.zeros((n, 2, 3))
        self._slip_m: Array = np.zeros((n, 2))
        up = [rotate(mount.quat, np.array([0.0, 0.0, mount.model.d_m[0]])) for mount in mounts]
        self._goals.to_block.others[:, _SHOULDERS, :3] = [m.position_m + by for m, by in zip(mounts, up, strict=True)]
        self._far_m = [
            reach_from_joint_m(mount.robot)[1] + (tool.tcp_m + _BEYOND_M)
            for mount, tool in zip(mounts, tools, strict=True)
        ]

    @classmethod
    def covered(cls, trained: HandoverSettings, settings: HandoverSettings) -> frozenset[str]:
        """Return the keywords whose values lie within the range that a training with other settings sampled."""
        giver = {"giver"} if {*settings.givers} <= {*trained.givers} else set()
        return super().covered(trained, settings) | giver

    @classmethod
    def requirements(cls, settings: HandoverSettings) -> SceneRequirements:
        """Return the requirements: two grippers and the block."""
        equipment = Equipment(grippers=True, props=(BLOCK, TARGET), grip_force_n=settings.grip_force_n)
        return SceneRequirements(equipment, closer=PICKING)

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample giver, block pose and target pose. The arms are above the table, with open grippers."""
        settings, givers = self.settings, self.settings.givers
        sampled = np.array([rng.uniform(-1.0, 1.0, 7) for rng in rngs]).reshape(len(rows), 7)
        giver = np.where(sampled[:, 6] < 0.0, givers[0], givers[-1])
        where = sampled[:, :3] * np.array([settings.object_range_m] * 2 + [settings.object_turn_rad])
        wanted = sampled[:, 3:6] * np.array([settings.target_range_m] * 2 + [settings.target_turn_rad])
        block, target = block_pose(where, giver), block_pose(wanted, 1 - giver)
        self.begin_rows(rows, giver)
        self._goals.begin(rows, giver)
        self._role[rows, giver], self._role[rows, 1 - giver] = 1.0, -1.0
        self._goals.to_block.others[rows, _BEFORE, :3] = block.position_m
        self._slip_m[rows] = 0.0
        return self.at_home(rows)._replace(
            objects={"block": np.concatenate(block, axis=1), "target": np.concatenate(target, axis=1)},
            sampled={"object": where, "target": wanted, "giver": giver},
        )

    def skip(self, rows: Rows, passed: Rows) -> None:
        """Continue with the block where it is in each gripper."""
        super().skip(rows, passed)
        self._slip_from_m[rows] = np.nan

    def measure(self, state: CellState) -> HandoverMeasured:
        """Compute the poses of all cells."""
        poses = np.concatenate([*state.objects["block"], *state.objects["target"]], axis=1).reshape(self.n, 2, 7)
        flanges = Poses(state.flange_m, required(state.flange_quat))
        grasped = self._goals.grasps(flanges, required(state.gripper_m), poses)
        return HandoverMeasured(poses[:, 0, :3].copy(), grasped, self._goals.situation(grasped))

    def observe(self, state: CellState, measured: HandoverMeasured, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 158)."""
        gripper_m = required(state.gripper_m)[..., None]
        grasped, in_bases = measured.grasped, measured.grasped.in_bases
        steps, closes = self._goals(measured.now, grasped, commanded_q_rad)
        return self.layout.join(
            {
                **arm_values(state, commanded_q_rad),
                **wrench_values(required(state.wrench)),
                **pose_values("block_base", in_bases[:, :, 0]),
                **pose_values("target_base", in_bases[:, :, 1]),
                **pose_values("other_flange", grasped.other_flange),
                **goal_values(steps, self._goals.commanded.nearby),
                **gripper_values(grasped.between, np.array(closes).T.reshape(-1, 2), gripper_m, self._strokes_m),
                "gripper_m": gripper_m,
                "other_gripper_m": gripper_m[:, ::-1],
                "role": self._role,
                "progress": per_arm(np.minimum(state.time_s / self.duration_s, 1.0)),
            }
        )

    # Stages: whether they are passed now, and the progress of giver and receiver.

    @stage(weight=0.1, earned=(2.0, 0.0))
    def reach(self, now: Facts) -> tuple[Number, Progress]:
        """Bring the giver's fingers around its grip."""
        return now.between[0], (now.near[0] * now.near[0], 0.0)

    @stage(weight=0.1, earned=(2.0, 0.0))
    def grasp(self, now: Facts) -> tuple[Number, Progress]:
        """Hold the block with the giver."""
        return now.holds[0], (0.5 * now.between[0] * (now.near[0] + now.shut[0]), 0.0)

    @stage(weight=0.1, earned=(2.0, 0.0))
    def lift(self, now: Facts) -> tuple[Number, Progress]:
        """Lift the block."""
        return now.carried, (now.holds[0] * ratio(now.raised), 0.0)

    @stage(weight=0.1, earned=(1.2, 0.8), early=(False, True))
    def present(self, now: Facts) -> tuple[Number, Progress]:
        """Bring the block to the transfer; the receiver waits at home, from the first step on."""
        return now.presented, (now.carried * now.near[0], now.near[1])

    @stage(weight=0.15)
    def mutual_grasp(self, now: Facts) -> tuple[Number, Progress]:
        """Hold the block with both."""
        gives, receives = now.holds
        taking = now.presented * (0.6 * now.near[1] + 0.4 * now.shut[1])
        both = gives & receives
        return both & (now.raised > 1.0), (now.presented * now.near[0], both + (1.0 - both) * taking)

    @stage(weight=0.15, earned=(1.5, 0.5))
    def release(self, now: Facts) -> tuple[Number, Progress]:
        """Open the giver's fingers, and leave the block to the receiver."""
        receives, left = now.holds[1], now.between[0] < 1
        giver = (0.5 * now.near[0] + now.clear[0]) / 1.5
        return left & receives & (now.raised > 1.0), (receives * giver, receives * now.near[1])

    @stage(weight=0.3, earned=(0.4, 1.6))
    def place(self, now: Facts) -> tuple[Number, Progress]:
        """Put the block down on its target, and open the receiver's fingers."""
        receives, left = now.holds[1], now.between[0] < 1
        giver = 0.5 * (now.near[0] + now.clear[0])
        carries, lies = (
            (receives & left) * (1.3 / 1.6) * now.near[1],
            (1.0 - receives) * (0.2 / 1.6) / (1.0 + now.error),
        )
        return now.placed, (receives * giver, carries + lies)

    def facts(self, state: CellState, measured: HandoverMeasured) -> Facts:
        """Compute the facts of this step."""
        grasped, now = measured.grasped, measured.now
        steps, closes = self._goals(now, grasped)
        self._goals.to_block.others[:, _BEFORE] = grasped.frames[:, 0]
        self._slip(grasped)
        self._error_m, self._error_rad = now.moved_m[:, _TARGET], now.axis_rad[:, _TARGET]
        _, error_m, still_m, *to_shoulders_m = numbers(now.moved_m.T)
        _, error_rad, *_ = numbers(now.axis_rad.T)
        near_target = (error_m < self.settings.success_error_m) & (error_rad < self.settings.success_turn_rad)
        far = (to_shoulders_m[0] > self._far_m[0]) & (to_shoulders_m[1] > self._far_m[1])
        return facts_of(
            between=self.by_role(grasped.between),
            holds=self.by_role(grasped.holding),
            closes=self.by_role(closes),
            nearness=self.by_role(steps.nearness),
            opened=self.by_role(grasped.opened),
            closed=self.by_role(grasped.closed),
            clear=self.by_role(grasped.cleared),
            height_m=now.height_m,
            off_m=now.off_m,
            laid=near_target & (still_m < self._still_m),
            error=error_m / self.settings.success_error_m,
            lost=far | (now.height_m < _FALLEN_M),
        )

    def _slip(self, grasped: Grasped) -> None:
        """Update the displacement of each grip in its gripper since the grasp."""
        if np.count_nonzero(grasped.holding):
            fresh = ~grasped.holding[..., None] | np.isnan(self._slip_from_m)
            np.copyto(self._slip_from_m, grasped.grip_in_tool_m, where=fresh)
            np.copyto(self._slip_m, length(grasped.grip_in_tool_m - self._slip_from_m), where=grasped.holding)
        else:
            self._slip_from_m[...] = grasped.grip_in_tool_m

    def quality(self, now: Facts) -> Number:
        """Return the factor of the term *finish*, which is larger for a smaller error."""
        return 1.0 + _PRECISION * ratio(1.0 - now.error)

    def lost(self, now: Facts) -> Number:
        """Return the rows whose block fell, or cannot be reached."""
        return now.lost

    def values(self, measured: HandoverMeasured) -> dict[str, Any]:
        """Return the values of `info`."""
        return {
            "giver": self.first.copy(),
            "object_m": measured.block_m,
            "object_error_m": self._error_m,
            "object_error_rad": self._error_rad,
            "slip_m": self._slip_m.copy(),
        }

    def failure(self, row: int, outcome: Outcome) -> str:
        """Return the name of the failure: the block fell from the table, or lies where no arm can reach it."""
        return "block_fell" if outcome.info["object_m"][row, 2] < _FALLEN_M else "block_out_of_reach"
