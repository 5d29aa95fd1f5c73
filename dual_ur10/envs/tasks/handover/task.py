"""Handover: one arm picks up a block and hands it to the other, which places it on its target."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dual_ur10.assets.props import BLOCK, BLOCK_SIZE_M, TARGET
from dual_ur10.assets.settings import DEFAULT_TOOLS, Equipment, home_q_rad
from dual_ur10.assets.tool import Tool, strokes_m
from dual_ur10.envs.tasks.agent_observations import AgentObservations
from dual_ur10.envs.tasks.handover.goals import agent_observations, goals
from dual_ur10.envs.tasks.handover.settings import GRIPS, HandoverSettings, check_reach, lying
from dual_ur10.envs.tasks.handover.stages import PLACED, STAGES, STILL_M_S, WIDTH_M, Stages
from dual_ur10.envs.tasks.holding import PICKING, Grasped, Grasps, required
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
from dual_ur10.envs.tasks.task import Outcome, SceneRequirements, Task, Timing, duration_ratio
from dual_ur10.envs.tasks.tool_goals import GOAL_FIELDS
from dual_ur10.kernel import RowLoop, Struct
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.rotations import rotate
from dual_ur10.sim2real.config.cell import CellConfig, CellState, Start
from dual_ur10.sim2real.control.limits import MotionLimits, reach_from_joint_m
from dual_ur10.types import Array, Rows

SETTLED_S = 0.5
"""Time that the block must lie on its target before an episode ends with success."""

_FALLEN_M = -0.03  # height of the middle of a block that is no longer on the table
_BEYOND_M = BLOCK_SIZE_M[0] / 2  # from a shoulder farther than its tool: out of reach


class HandoverMeasured(NamedTuple):
    """Poses at one instant; positions in the cell frame unless another is named.

    Attributes:
        poses: (n, 14) pose of the block, then of the target: position and quaternion.
        grasped: Both arms and the block; the poses and rotations are those of block and target.
    """

    poses: Array
    grasped: Grasped


class Handover(Task[HandoverSettings, HandoverMeasured]):
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

    The observation space is a `Box(low, high, (112,), float64)` with the bounds of the table: 56 numbers of the left
    arm, which the table shows, then the same 56 of the right arm, with left and right exchanged. All of them can be
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
    | 32-34 | position of the block | -10 | 10 | block | position (m) |
    | 35-38 | orientation of the block | -1.01 | 1.01 | block | quaternion |
    | 39-41 | position of the target | -10 | 10 | target | position (m) |
    | 42-45 | orientation of the target | -1.01 | 1.01 | target | quaternion |
    | 46-48 | position of the other flange in the frame of this one | -5 | 5 | right/flange | position (m) |
    | 49-52 | orientation of the other flange in the frame of this one | -1.01 | 1.01 | right/flange | quaternion |
    | 53 | opening of the other gripper | -0.1 | 0.1 | right/finger_1_joint ... right/finger_2_joint | position (m) |
    | 54 | role: 1 gives, -1 receives | -1.01 | 1.01 | - | sign |
    | 55 | elapsed fraction of the episode's time | -1.01 | 1.01 | - | ratio |

    An agent of the two-agent environment observes its arm's 56 numbers, and behind them 23 of the goal of its tool,
    which follow from the joint observation: `dual_ur10.envs.tasks.tool_goals.GOAL_FIELDS`.

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of the parts of giver and receiver below, which are what their agents
    earn. A part has its largest value once its stage is passed, and measures progress until then. It is 0 before its
    stage begins, but for the receiver's part of *present*.

    Progress is mostly the nearness (`dual_ur10.envs.tasks.tool_goals`) of a tool to its goal in the present phase
    (`dual_ur10.envs.tasks.handover.goals`).

    - *reach* (0.1): passed when the giver's grip of the block is between its fingers. Giver, 2: twice its nearness.
    - *grasp* (0.1): passed when the giver holds the block. Giver, 2: while the grip is between its fingers, its
      nearness, and the closed fraction of its gripper once that is its goal.
    - *lift* (0.1): passed when the giver holds the block with its middle more than 8 cm above the table. Giver, 2: while
      it holds the block, twice the fraction of that height.
    - *present* (0.1): passed when the lifted block is presented. Giver, 1: its nearness while it holds the lifted
      block. Receiver, 1: its nearness, from the first step on.
    - *mutual_grasp* (0.15): passed when both hold the lifted block. Giver, 1: its nearness while the block is presented.
      Receiver, 1: while the block is presented, 0.6 of its nearness, and 0.4 of the closed fraction of its gripper once
      that is its goal.
    - *release* (0.15): passed when the receiver holds the lifted block, and the giver has left it: its grip is no longer
      between the fingers. While the receiver holds the block: giver, 1.5: how far its fingers have opened, 1 once they
      are 7 mm wider than the block, and 0.5 of its nearness; receiver, 0.5: 0.5 of its nearness.
    - *place* (0.3): passed when the block lies still on its target, within `success_error_m` and `success_turn_rad`, and
      no gripper holds it. While the receiver holds it: giver, 0.4: 0.2 of how far its fingers have opened, and 0.2 of
      its nearness; receiver, 1.6: 1.3 times its nearness, once the giver has left the block.
    - *finish* (1.0): both. At a step that ends an episode with success, the number of its remaining steps; otherwise 0.
      It replaces the reward of the remaining steps, so that hovering near the target earns no more than success.

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
    - "refused/<limit>": the safety gate refused a motion; `info["safety"]` gives the details;
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
    weights: ClassVar[dict[str, float]] = {
        "reach": 0.1,
        "grasp": 0.1,
        "lift": 0.1,
        "present": 0.1,
        "mutual_grasp": 0.15,
        "release": 0.15,
        "place": 0.3,
        "finish": 1.0,
    }
    stages: ClassVar[tuple[str, ...]] = STAGES
    settings_type: ClassVar[type[HandoverSettings]] = HandoverSettings
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS,
        gripper_field(),
        *wrench_fields("block"),
        *pose_fields("block_base", "the block", "block"),
        *pose_fields("target_base", "the target", "target"),
        *OTHER_FLANGE_FIELDS,
        gripper_field("other"),
        Field("role", 1, -1.01, 1.01, "sign", "role: 1 gives, -1 receives"),
        Field("progress", 1, -1.01, 1.01, "ratio", "elapsed fraction of the episode's time"),
    )

    def __init__(self, settings: HandoverSettings, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        mounts, tools = (cell.left, cell.right), cell.equipment.tools
        check_reach(settings, cell.scene)
        self.duration_s = settings.duration_s * duration_ratio(type(self).limits, self.limits)
        self.horizon = self._steps = max(1, math.ceil(self.duration_s / timing.period_s - 1e-9))
        self._settled_steps = max(1, math.ceil(SETTLED_S / timing.period_s - 1e-9))
        self._giver = np.zeros(n, dtype=np.int64)
        # Each arm's role, and for each role the index of its arm among the arms of all cells. The second swaps arms and
        # roles in either direction.
        self._role: Array = np.ones((n, 2, 1))
        self._by_role: Rows = np.zeros((n, 2), dtype=np.intp)
        self._grip_m: Array = np.zeros((n, 2, 3))
        self._grasps = Grasps(Frames(mounts), self._grip_m, WIDTH_M, 2, tools)
        # Of the episode so far.
        self._stages = Stages(n, tools)
        self._count = np.zeros(n, dtype=np.int64)
        self._settled = np.zeros(n, dtype=np.int64)
        self._before_m: Array = np.zeros((n, 3))  # position of the block in the last step
        self._slip_m: Array = np.zeros((n, 2))
        self._input, self._output = np.zeros((n, 72)), np.zeros((n, 4))
        self._agents = self.agents_for(settings, mounts, tools)
        struct = Struct(
            "Handover",
            n=n,
            still_m=STILL_M_S * timing.period_s,
            success_error_m=settings.success_error_m,
            far_m=np.array(
                [
                    reach_from_joint_m(mount.robot)[1] + (tool.tcp_m + _BEYOND_M)
                    for mount, tool in zip(mounts, tools, strict=True)
                ]
            ),
            fallen_m=_FALLEN_M,
            shoulders_m=np.array(
                [mount.position_m + rotate(mount.quat, np.array([0.0, 0.0, mount.model.d_m[0]])) for mount in mounts]
            ),
            goals=goals(mounts, tools),
            giver=self._giver,
            input=self._input,
            before_m=self._before_m,
            slip_from_m=np.zeros((n, 6)),
            slip_m=self._slip_m,
            facts=self._stages.facts,
            output=self._output,
        )
        self._evaluate = RowLoop("handover_evaluate", struct, n, 1)

    @classmethod
    def requirements(cls, settings: HandoverSettings) -> SceneRequirements:
        """Return the requirements: two grippers and the block."""
        equipment = Equipment(grippers=True, props=(BLOCK, TARGET), grip_force_n=settings.grip_force_n)
        return SceneRequirements(equipment, 0.002, "stiff", PICKING)

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample giver, block pose and target pose. The arms are above the table, with open grippers."""
        settings, givers = self.settings, self.settings.givers
        sampled = np.array([rng.uniform(-1.0, 1.0, 7) for rng in rngs]).reshape(len(rows), 7)
        giver = np.where(sampled[:, 6] < 0.0, givers[0], givers[-1])
        where = sampled[:, :3] * np.array([settings.object_range_m] * 2 + [settings.object_turn_rad])
        wanted = sampled[:, 3:6] * np.array([settings.target_range_m] * 2 + [settings.target_turn_rad])
        block, target = lying(where, giver), lying(wanted, 1 - giver)
        self._giver[rows] = giver
        self._role[rows, giver], self._role[rows, 1 - giver] = 1.0, -1.0
        self._by_role[rows] = 2 * rows[:, None] + np.stack([giver, 1 - giver], axis=1)
        self._grip_m[rows] = np.stack([grips.position_m for grips in GRIPS])[giver]
        for counts in (self._stages.passed, self._count, self._settled):
            counts[rows] = 0
        self._before_m[rows] = block.position_m
        self._slip_m[rows] = 0.0
        return Start(
            np.broadcast_to(home_q_rad((self.cell.left, self.cell.right)), (len(rows), 2, 6)).copy(),
            np.tile(strokes_m(self.cell.equipment.tools), (len(rows), 1)),
            objects={"block": np.concatenate(block, axis=1), "target": np.concatenate(target, axis=1)},
            sampled={"object": where, "target": wanted, "giver": giver},
        )

    def measure(self, state: CellState) -> HandoverMeasured:
        """Compute the poses of all cells."""
        poses = np.concatenate([*state.objects["block"], *state.objects["target"]], axis=1)
        return HandoverMeasured(poses, self._grasps(state, poses))

    def observe(self, state: CellState, measured: HandoverMeasured, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 112)."""
        gripper_m = required(state.gripper_m)[..., None]
        in_bases = measured.grasped.in_bases
        return self.layout.join(
            {
                **arm_values(state, commanded_q_rad),
                **wrench_values(required(state.wrench)),
                **pose_values("block_base", in_bases[..., :7]),
                **pose_values("target_base", in_bases[..., 7:]),
                **pose_values("other_flange", measured.grasped.other_flange),
                "gripper_m": gripper_m,
                "other_gripper_m": gripper_m[:, ::-1],
                "role": self._role,
                "progress": per_arm(np.minimum(state.time_s / self.duration_s, 1.0)),
            }
        )

    @classmethod
    def agent_layout_for(cls, settings: HandoverSettings) -> ObservationLayout:
        """Return the fields of an arm, and those of its goal."""
        return cls.layout.extended(*GOAL_FIELDS)

    @classmethod
    def agents_for(
        cls,
        settings: HandoverSettings,
        mounts: tuple[ArmMount, ArmMount],
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> AgentObservations:
        """Return the function that assembles the agents' observations from joint ones."""
        return agent_observations(cls.layout, cls.agent_layout_for(settings), mounts, tools)

    def observe_agents(self, observation: Array) -> Array:
        """Return each agent's own observation, (n, 2, 79), from those of both, (n, 112)."""
        return self._agents(observation)

    def evaluate(self, state: CellState, measured: HandoverMeasured) -> Outcome:
        """Evaluate stages, reward terms, success and end."""
        flanges = state.flange_m.reshape(self.n, 6), required(state.flange_quat).reshape(self.n, 8)
        parts = (measured.poses, measured.grasped.values[:, :42], required(state.gripper_m), *flanges)
        np.concatenate(parts, axis=1, out=self._input)
        self._evaluate()
        found, stages = self._output.copy(), self._stages
        target_rad = np.arctan2(found[:, 1], found[:, 2])
        now_placed = (stages.facts[:, PLACED] > 0.0) & (target_rad < self.settings.success_turn_rad)
        stages.facts[:, PLACED] = now_placed
        stages.check()
        stages.advance()
        self._count += 1
        placed = (stages.passed == len(self.stages)) & now_placed
        self._settled = (self._settled + 1) * placed
        lost = found[:, 3] > 0.0
        terminal = lost | (self._settled >= self._settled_steps)
        over = self._count >= self._steps
        info: dict[str, Any] = {
            "stage": stages.passed.copy(),
            "giver": self._giver.copy(),
            "object_m": measured.poses[:, :3].copy(),
            "object_error_m": found[:, 0],
            "object_error_rad": target_rad,
            "slip_m": self._slip_m.copy(),
        }
        earned = np.empty((self.n, 2, len(self.weights)))
        earned[..., :-1] = stages.terms.reshape(2 * self.n, -1).take(self._by_role, axis=0)
        finish = np.maximum(self._steps - self._count, 0) * (terminal & ~lost)
        earned[..., -1] = finish[:, None]
        return Outcome(earned, placed & ~lost & (terminal | over), over & ~terminal, info, terminal)

    def failure(self, row: int, outcome: Outcome) -> str:
        """Return the name of the failure: the block fell from the table, or lies where no arm can reach it."""
        return "block_fell" if outcome.info["object_m"][row, 2] < _FALLEN_M else "block_out_of_reach"
