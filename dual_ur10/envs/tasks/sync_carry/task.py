"""SyncCarry: both arms grasp a bar, carry it along a path, and put it down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from dual_ur10.assets.props import BAR, BAR_MASS_KG, BAR_WELDS
from dual_ur10.assets.settings import Equipment, home_q_rad
from dual_ur10.envs.tasks.geometry import APPROACH_M, PICKING, FrameDistances, flanges_of, length, required
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS, GRIPPER_FIELDS, goal_values, gripper_values
from dual_ur10.envs.tasks.grasps import Grasped
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
from dual_ur10.envs.tasks.sync_carry.goals import AHEAD, BAR_POSE, PATH_FIELDS, POSES, REFERENCE, CarryGoals
from dual_ur10.envs.tasks.sync_carry.path import CarryPath
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings, bar_pose, ideal_relative, path_rate
from dual_ur10.envs.tasks.task import Outcome, SceneRequirements, Task, Timing, gaussian
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.mjcf.gains import COMPLIANT
from ur_core.tools.tool import levers_m, strokes_m
from ur_core.types import Array, Mask, Rows

_GRASP_S = {True: 1.5, False: 5.0}  # time before the path begins: rigid, friction
_SETTLE_S = 1.0  # time after it
_LOAD_S = 1.0  # in which the declared load ramps up before the lift, and down after it
_LOST_M = 0.15  # distance of a bar from its reference at which it is lost
_LOAD_RATIO = 0.25  # of the load, that each arm must carry

# Distance at which a term is 0.1: bar to its reference, its angle, relative position, internal force.
_MARGINS = np.array([0.03, 0.1, 0.005, 30.0])


class CarryMeasured(NamedTuple):
    """Poses and forces at one instant; positions in the cell frame unless another is named.

    Attributes:
        clock_s: (n,) time on the path, negative before it begins.
        bar_m: (n, 3) position of the bar.
        grasped: Both arms, the bar, its reference now, and that at the end of the next motion.
        force_n: (n, 2, 3) force of the bar on each gripper.
    """

    clock_s: Array
    bar_m: Array
    grasped: Grasped
    force_n: Array


class SyncCarry(Task[CarrySettings, CarryMeasured]):
    """Both arms grasp a bar by its ends, carry it along a path and put it down, together.

    ## Description

    A bar of 1.2 m and 4 kg lies on the table. Along its reference path it is lifted by 0.25 m, moved sideways and
    forward, rotated about the vertical (±20°), tilted (±10°), rotated about its length (±15°) and lowered.
    The largest speed is 0.225 m/s. Both flanges must keep their distance and angle while they move on different curves:
    their relative motion compresses the bar or pulls it out of the fingers.

    The path begins 5 s after the episode does, so that there is time to grasp; with `grasp="rigid"` the grippers are
    welded to the bar from the start and the path begins after 1.5 s. If the cell's speed limits are too tight for the
    path, its clock runs more slowly, for both arms.

    ## Action Space

    The action space is a `Box(-1.0, 1.0, (14,), float32)` with the default `action_mode="joint_delta"`: steps of the
    six joints of an arm from the last command, in fractions of the speed limit (1 rad/s) times the period (40 ms), and the
    opening of its gripper. With `grasp="rigid"` there are no openings: `Box(-1.0, 1.0, (12,), float32)`.

    The table shows the left arm; the right arm's numbers follow in the same order.

    | Num | Action | Control Min | Control Max | Name (in XML file) | Joint | Type (Unit) |
    |-----|--------|-------------|-------------|--------------------|-------|-------------|
    | 0 | step of the shoulder pan | -1 | 1 | left/shoulder_pan_joint | hinge | fraction of 0.040 (rad) |
    | 1 | step of the shoulder lift | -1 | 1 | left/shoulder_lift_joint | hinge | fraction of 0.040 (rad) |
    | 2 | step of the elbow | -1 | 1 | left/elbow_joint | hinge | fraction of 0.040 (rad) |
    | 3 | step of the wrist 1 | -1 | 1 | left/wrist_1_joint | hinge | fraction of 0.040 (rad) |
    | 4 | step of the wrist 2 | -1 | 1 | left/wrist_2_joint | hinge | fraction of 0.040 (rad) |
    | 5 | step of the wrist 3 | -1 | 1 | left/wrist_3_joint | hinge | fraction of 0.040 (rad) |
    | 6 | opening of the gripper | -1 | 1 | left/gripper | tendon | -1 is 0, 1 is 0.085 (m) |

    ## Observation Space

    The observation space is a `Box(low, high, (170,), float64)` with the bounds of the table: 85 numbers of the left
    arm, which the table shows, then the same 85 of the right arm, with left and right exchanged. All of them can be
    measured on a real cell. Poses, forces and torques are in the arm's own `base` frame unless another is named;
    quaternions are (w, x, y, z). The weight of the gripper is subtracted from the force, which has the noise of
    `CellConfig.wrench_noise`. With `grasp="rigid"` the four fields of the gripper are absent: 81 numbers per arm.

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 6-11 | joint speeds | -10 | 10 | left/shoulder_pan_joint ... left/wrist_3_joint | speed (rad/s) |
    | 12-17 | commanded joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 18-20 | position of the flange | -2 | 2 | left/flange | position (m) |
    | 21-24 | orientation of the flange | -1.01 | 1.01 | left/flange | quaternion |
    | 25 | opening of the gripper | -0.1 | 0.1 | left/finger_1_joint ... left/finger_2_joint | position (m) |
    | 26-28 | force of the bar on the gripper | -2000 | 2000 | left/wrench | force (N) |
    | 29-31 | torque of the bar on the gripper about the flange | -2000 | 2000 | left/wrench | torque (N·m) |
    | 32-34 | position of the bar | -10 | 10 | bar/bar | position (m) |
    | 35-38 | orientation of the bar | -1.01 | 1.01 | bar/bar | quaternion |
    | 39-41 | position of the bar's reference now | -10 | 10 | - | position (m) |
    | 42-45 | orientation of the bar's reference now | -1.01 | 1.01 | - | quaternion |
    | 46-48 | position of the bar's reference at the end of the next motion | -10 | 10 | - | position (m) |
    | 49-52 | orientation of the bar's reference at the end of the next motion | -1.01 | 1.01 | - | quaternion |
    | 53-55 | position of the other flange in the frame of this one | -5 | 5 | right/flange | position (m) |
    | 56-59 | orientation of the other flange in the frame of this one | -1.01 | 1.01 | right/flange | quaternion |
    | 60 | time until the path begins, negative | -10 | 10 | - | time (s) |
    | 61 | completed fraction of the path | -1.01 | 1.01 | - | ratio |
    | 62-64 | step from the commanded tool to its goal, in the cell frame | -20 | 20 | - | position (m) |
    | 65-67 | rotation of this step, along its axis | -2.01 | 2.01 | - | 2 sin(angle / 2) |
    | 68-70 | step to the goal, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio |
    | 71-73 | rotation to the goal, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio |
    | 74-76 | step from the tool to the commanded tool, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio |
    | 77-79 | rotation of this step, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio |
    | 80 | 1 if the grip of the object is between the fingers | 0 | 1 | - | 0 or 1 |
    | 81 | opening of the gripper, of the largest | -1.2 | 1.2 | - | ratio |
    | 82 | goal of the gripper: 0 closed, 1 open | 0 | 1 | - | ratio |
    | 83-84 | 0.01 m / (0.01 m + path left to the goal), and 0.03 / (0.03 + rotation left) | 0 | 1 | - | ratio |

    An agent of the two-agent environment observes its arm's numbers.

    With `observation="goals"` the observation space is a `Box(-1.0, 1.0, (62,), float32)`: 31 numbers of the left arm,
    then those of the right arm. A value x is shown as x / (u + abs(x)), in each unit u that the table names
    (`dual_ur10.envs.tasks.observation_layout.ConciseView`). With
    `grasp="rigid"` the three fields of the gripper are absent: 28 numbers per arm.

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | commanded joint positions, from home | -1 | 1 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) in 1 |
    | 6 | time until the path begins, negative | -1 | 1 | - | time (s) in 1 |
    | 7 | completed fraction of the path | -1 | 1 | - | ratio in 0.5 |
    | 8-13 | step from the commanded tool to its goal, in the cell frame | -1 | 1 | - | position (m) in 0.2 and 0.01 |
    | 14-19 | rotation of this step, along its axis | -1 | 1 | - | 2 sin(angle / 2) in 0.5 and 0.03 |
    | 20-22 | step from the tool to the commanded tool, saturated: x / (0.01 m + abs(x)) | -1 | 1 | - | ratio in 1 |
    | 23-25 | rotation of this step, saturated: x / (0.03 + abs(x)) | -1 | 1 | - | ratio in 1 |
    | 26 | 1 if the grip of the object is between the fingers | -1 | 1 | - | 0 or 1 in 0.2 |
    | 27 | opening of the gripper, of the largest | -1 | 1 | - | ratio in 0.5 |
    | 28 | goal of the gripper: 0 closed, 1 open | -1 | 1 | - | ratio in 0.2 |
    | 29-30 | 0.01 m / (0.01 m + path left to the goal), and 0.03 / (0.03 + rotation left) | -1 | 1 | - | ratio in 0.5 |

    ## Rewards

    The reward is the weighted sum of terms between 0 and 1, each the mean over the arms; each raw term is in `info` as
    `reward/<term>`. The terms from *position* on count only while both grippers hold the bar, and those after it as far as
    the bar is where it belongs: arms that stand still keep their distance, too.

    - *reach* (0.6): squared nearness of the tool to its goal (`dual_ur10.envs.tasks.geometry.ToolSteps`), which is its grip on the bar's
      reference now, from behind until the gripper holds the bar.
    - *grasp* (0.2): 1 if the gripper holds the bar; until then half of its closed fraction, once to close is its goal.
    - *position* (0.05): 0.1^((distance of the bar to its reference / 30 mm)²).
    - *orientation* (0.05): *position* times 0.1^((angle of the bar from its reference / 0.1 rad)²).
    - *synchrony* (0.05): *position* times 0.1^((error of the position of one flange in the frame of the other / 5 mm)²).
    - *squeeze* (0.05): *position* times 0.1^((internal force along the bar / 30 N)²).

    `info` also holds these values without noise:

    - `slip_m` (2,): displacement of each grip in its gripper since the path began.
    - `squeeze_n`: half the difference of the forces on both grippers along the bar, positive if the arms press towards
      each other; `lateral_n`: the same across the bar.
    - `load_share` (2,): fraction of the load that each arm carries.
    - `relative_error_m`, `relative_error_rad`: error of the right flange's pose in the left flange's frame.
    - `object_error_m`, `object_error_rad`: error of the bar's pose from its reference; `object_m` (3,): its position;
      `object_reference_m` (3,): that of the reference.
    - `clock_s`: time on the path, negative before it begins.

    `info["is_success"]` is true at the end of an episode if all of these hold: the bar followed its path in position and
    angle, as root mean square and at the end, when it lies on the table again; it slipped in no gripper by more than
    `success_slip_m`; both grippers hold it; and each arm carried at least a quarter of the load on average. One arm
    alone cannot succeed.

    ## Starting State

    The bar lies at (0, 0) along the cell's y, shifted by up to `object_range_m` along x and y and rotated by up to
    `object_turn_rad`. The arms are at rest, with open grippers 0.1 m above the bar's nominal grips, or on the grips.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "bar_lost": the bar is more than 0.15 m away from its reference, because it was dropped or never lifted;
    - "refused/<limit>": with `on_refusal="terminate"`, the safety gate refused a motion; see `info["safety"]`;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    One second after the end of the path, 900 steps with the defaults, with the reason "success" or "time". No time limit
    is registered with the id; `env.spec.max_episode_steps` is this number.

    ## Arguments

    | Parameter | Type | Default | Description |
    |-----------|------|---------|-------------|
    | `duration_s` | float | `30.0` | length of the path: 30 or 60 (s) |
    | `grasp` | str | `"friction"` | "friction", or "rigid": welded to the bar |
    | `payload` | str | `"known"` | "known": each arm's load is declared to its simulated controller; or "unknown" |
    | `grip_force_n` | float | `100.0` | force of each finger, 20 to 235 (N) |
    | `path_speed` | bool | `False` | observe the velocity of both grips on the bar's reference, without which a policy that corrects a part of its error in each step lags behind |
    | `object_range_m` | float | `0.02` | initial position of the bar, ± along x and y (m) |
    | `object_turn_rad` | float | `0.05` | initial yaw of the bar, ± (rad) |
    | `success_error_m` | float | `0.01` | largest root mean square distance of the bar to its path of a success (m) |
    | `success_turn_rad` | float | `0.05` | largest root mean square angle of the bar from its path of a success (rad) |
    | `success_slip_m` | float | `0.005` | largest slip of a success (m) |

    Those of every environment are described in `dual_ur10.envs.core.options.EnvOptions`.

    ## Version History

    - v0: first version.
    """

    couples: ClassVar[bool] = True
    ramp_kg_s: ClassVar[float] = BAR_MASS_KG / 2 / _LOAD_S
    limits: MotionLimits = MotionLimits(
        speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.0
    )
    accepted: ClassVar[dict[str, str]] = {
        "actions of another seed": "the path is the same in every episode, and a bar that is gripped a little beside "
        "its middle still succeeds",
    }
    weights: ClassVar[dict[str, float]] = {
        "reach": 0.6,
        "grasp": 0.2,
        "position": 0.05,
        "orientation": 0.05,
        "synchrony": 0.05,
        "squeeze": 0.05,
    }
    per_arm: ClassVar[tuple[str, ...]] = ("slip_m", "load_share")
    settings_type: ClassVar[type[CarrySettings]] = CarrySettings
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS,
        gripper_field(),
        *wrench_fields("bar"),
        *pose_fields("bar_base", "the bar", "bar/bar"),
        *pose_fields("reference_base", "the bar's reference now"),
        *pose_fields("ahead_base", "the bar's reference at the end of the next motion"),
        *OTHER_FLANGE_FIELDS,
        Field("time_to_path_s", 1, -10.0, 10.0, "time (s)", "time until the path begins, negative", concise=(1.0,)),
        Field("progress", 1, -1.01, 1.01, "ratio", "completed fraction of the path", concise=(0.5,)),
        *GOAL_FIELDS,
    )

    def __init__(self, settings: CarrySettings, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        tools = cell.equipment.tools
        self._frames = Frames((cell.left, cell.right))
        self._path = CarryPath(settings.duration_s)
        self._rate = path_rate(settings, cell.scene, self.limits)
        self._grip = settings.grip
        self._grasp_s = _GRASP_S[settings.rigid] / self._rate
        self.duration_s = self._grasp_s + settings.duration_s / self._rate + _SETTLE_S
        self.horizon = self._steps = math.ceil(self.duration_s / timing.period_s - 1e-9)
        mounts = (cell.left, cell.right)
        self._goals = CarryGoals(n, settings, mounts, tools)
        self._strokes_m = np.array(strokes_m(tools))[:, None]
        self._to_bar = FrameDistances(n, POSES, (BAR_POSE,))
        self._ideal_m = ideal_relative(self._grip, tools).position_m
        self._bar = Poses(np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)))
        self._when = np.array([0.0, timing.ahead_s])
        self._count = np.zeros(n, dtype=np.int64)
        self._load: Array = np.zeros((n, 2))  # to declare: half the bar for each arm, while it is off the table
        # Of the episode so far, since the bar is lifted.
        self._worst_slip: Array = np.zeros(n)
        self._squares: Array = np.zeros((n, 2))
        self._carried: Array = np.zeros((n, 2))
        self._slip_from_m: Array = np.zeros((n, 2, 3))

    @classmethod
    def layout_for(cls, settings: CarrySettings) -> ObservationLayout:
        """Return the fields of an observation; with a rigid grasp there are no grippers."""
        layout = ObservationLayout(*cls.layout.fields, *PATH_FIELDS) if settings.path_speed else cls.layout
        return layout.without("gripper_m", *GRIPPER_FIELDS) if settings.rigid else layout

    @classmethod
    def requirements(cls, settings: CarrySettings) -> SceneRequirements:
        """Return the requirements: two grippers and the bar. A friction grip needs a physics step of 1 ms."""
        equipment = Equipment(
            grippers=True,
            props=(BAR,),
            welds=BAR_WELDS if settings.rigid else (),
            grip_force_n=settings.grip_force_n,
        )
        return SceneRequirements(equipment, 0.002 if settings.rigid else 0.001, COMPLIANT, PICKING)

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample the bar's pose. The grippers are open above its nominal position, or welded to it."""
        settings = self.settings
        reach = np.array([settings.object_range_m] * 2 + [settings.object_turn_rad])
        where = np.array([rng.uniform(-reach, reach) for rng in rngs]).reshape(len(rows), 3)
        bar = bar_pose(where)
        self._bar.position_m[rows], self._bar.quat[rows] = bar
        at = bar if settings.rigid else bar_pose(np.zeros((len(rows), 3)))
        tool = compose(Poses(at.position_m[:, None], at.quat[:, None]), self._grip)
        if not settings.rigid:
            tool.position_m[..., 2] += APPROACH_M
        flange = flanges_of(tool, levers_m(self.cell.equipment.tools))
        position, quat = self._frames.position_to_base(flange.position_m), self._frames.quat_to_base(flange.quat)
        mounts = self.cell.left, self.cell.right
        home = home_q_rad(mounts)
        configurations = [
            nearest(position[:, arm], quat_to_matrix(quat[:, arm]), home[arm], mount.dh)
            for arm, mount in enumerate(mounts)
        ]
        for values in (self._count, self._load, self._worst_slip, self._squares, self._carried):
            values[rows] = 0
        opening = None if settings.rigid else np.tile(strokes_m(self.cell.equipment.tools), (len(rows), 1))
        objects = {"bar": np.concatenate(bar, axis=1)}
        return Start(np.stack(configurations, axis=1), opening, objects, sampled={"object": where})

    def measure(self, state: CellState) -> CarryMeasured:
        """Compute poses, references and forces of all cells."""
        clock = (state.time_s[:, None] + self._when - self._grasp_s) * self._rate
        poses = np.empty((self.n, POSES, 7))
        poses[:, BAR_POSE, :3], poses[:, BAR_POSE, 3:] = state.objects["bar"]
        poses[:, REFERENCE:, :3], poses[:, REFERENCE:, 3:] = self._path(clock, self._bar)
        grasped = self._goals.measure(Poses(state.flange_m, required(state.flange_quat)), state.gripper_m, poses)
        force = self._frames.vector_to_cell(required(state.wrench)[..., :3])
        return CarryMeasured(clock[:, 0], poses[:, BAR_POSE, :3].copy(), grasped, force)

    def observe(self, state: CellState, measured: CarryMeasured, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 170), or (n, 162) with a rigid grasp; `path_speed` adds 12."""
        clock, grasped = measured.clock_s, measured.grasped
        in_bases, wanted = grasped.in_bases, self._goals(grasped, commanded_q_rad)
        values = {
            **arm_values(state, commanded_q_rad),
            **wrench_values(required(state.wrench)),
            **pose_values("bar_base", in_bases[:, :, BAR_POSE]),
            **pose_values("reference_base", in_bases[:, :, REFERENCE]),
            **pose_values("ahead_base", in_bases[:, :, AHEAD]),
            **pose_values("other_flange", grasped.other_flange),
            **goal_values(wanted.steps, self._goals.commanded.nearby),
            "time_to_path_s": per_arm(np.minimum(clock, 0.0)),
            "progress": per_arm(np.minimum(np.maximum(clock / self._path.duration_s, 0.0), 1.0)),
        }
        if self.settings.path_speed:
            values["path_m_s"], values["path_rad_s"] = self._goals.speeds(grasped, self.timing.ahead_s)
        if not self.settings.rigid:
            values["gripper_m"] = gripper_m = required(state.gripper_m)[..., None]
            values.update(gripper_values(grasped.between, wanted.closes, gripper_m, self._strokes_m))
        return self.layout.join(values)

    def evaluate(self, state: CellState, measured: CarryMeasured) -> Outcome:
        """Evaluate reward terms, success and end."""
        clock, grasped, settings = measured.clock_s, measured.grasped, self.settings
        holding, begun = grasped.holding, measured.clock_s > 0.0
        both: Mask = holding[:, 0] & holding[:, 1]
        bar_m, bar_rad = self._bar_errors(grasped)
        apart_m = length(grasped.other_flange[:, 0, :3] - self._ideal_m)
        inner = (measured.force_n[:, 0] - measured.force_n[:, 1]) / 2.0
        along = grasped.frames[:, BAR_POSE, 4::3]  # the bar's own y, the second column of its rotation
        internal_n = np.vecdot(inner, along)
        slip_m, load_n = self._carry(measured, begun, both)
        self._count += 1
        errors = np.empty((self.n, len(_MARGINS)))
        errors[:, 0], errors[:, 1], errors[:, 2], errors[:, 3] = bar_m, bar_rad, apart_m, internal_n
        followed = errors[:, :2]
        self._squares += followed * followed * begun[:, None]
        over = self._count >= self._steps
        lost = begun & (bar_m > _LOST_M)
        success = over & ~lost
        if np.count_nonzero(success):
            there = (bar_m <= settings.success_error_m) & (bar_rad <= settings.success_turn_rad)
            success &= there & self._carried_well(begun & both)
        wanted = self._goals(grasped)
        terms = np.empty((self.n, 2, len(self.weights)))
        closes, holds = wanted.closes.astype(np.float64), holding.astype(np.float64)
        nearness = wanted.steps.nearness
        np.multiply(nearness * nearness, np.maximum(0.8 + 0.2 * grasped.opened, closes), out=terms[..., 0])
        np.maximum(0.5 * (closes * grasped.closed), holds, out=terms[..., 1])
        precise = gaussian(errors, _MARGINS) * both[:, None]
        precise[:, 1:] *= precise[:, :1]
        terms[..., 2:] = precise[:, None]
        info = {
            "slip_m": slip_m,
            "squeeze_n": internal_n,
            "lateral_n": length(inner - internal_n[:, None] * along),
            "load_share": load_n / np.maximum(load_n[:, :1] + load_n[:, 1:], 1e-9),
            "relative_error_m": apart_m,
            "relative_error_rad": 2.0 * np.arcsin(np.minimum(length(grasped.other_flange[:, 0, 4:]), 1.0)),
            "object_error_m": bar_m,
            "object_error_rad": bar_rad,
            "object_m": measured.bar_m,
            "object_reference_m": grasped.frames[:, REFERENCE, :3].copy(),
            "clock_s": clock,
        }
        return Outcome(terms, success, over & ~lost, info, lost)

    def _bar_errors(self, grasped: Grasped) -> tuple[Array, Array]:
        """Return the distance and the angle of the bar from its reference, (n,) each."""
        self._to_bar.others[:, 0] = grasped.frames[:, REFERENCE]
        moved_m, chord, _ = self._to_bar(grasped.frames)
        return moved_m[:, 0].copy(), 2.0 * np.arcsin(np.minimum(0.5 * chord[:, 0], 1.0))

    def _carry(self, measured: CarryMeasured, begun: Mask, both: Mask) -> tuple[Array, Array]:
        """Update slips and loads since the lift; return those now, (n, 2) each."""
        clock, grip_m = measured.clock_s, measured.grasped.grip_in_tool_m
        if np.count_nonzero(begun) < self.n:
            np.copyto(self._slip_from_m, grip_m, where=~begun[:, None, None])
        slip_m = length(grip_m - self._slip_from_m)
        self._worst_slip = np.maximum(self._worst_slip, np.maximum(slip_m[:, 0], slip_m[:, 1])) * begun
        load_n = np.maximum(-measured.force_n[..., 2], 0.0)
        under_way = clock < self.settings.duration_s
        self._carried += load_n * (begun & under_way)[:, None]
        due = (clock > -_LOAD_S) & under_way & both
        self._load[...] = (due * (BAR_MASS_KG / 2))[:, None]
        return slip_m, load_n

    def failure(self, row: int, outcome: Outcome) -> str:
        """Return the name of the only failure: the bar was dropped, or never lifted."""
        return "bar_lost"

    def _carried_well(self, held: Mask) -> Mask:
        """Return a mask, (n,), of bars that both grippers hold, that followed their path, and whose load was shared."""
        steps = np.maximum(self._count - self._grasp_s / self.timing.period_s, 1.0)
        settings = self.settings
        carried = self._carried / np.maximum(np.add.reduce(self._carried, axis=1, keepdims=True), 1e-9)
        result: Mask = held & (carried.min(axis=1) >= _LOAD_RATIO)
        limits = np.array([settings.success_error_m, settings.success_turn_rad])
        result &= np.logical_and.reduce(self._squares <= limits * limits * steps[:, None], axis=1)
        result &= self._worst_slip <= settings.success_slip_m
        return result

    def load_kg(self) -> Array | None:
        """Return half of the bar for each arm, from before the lift until it is put down; None: the load is unknown."""
        return None if self.settings.payload == "unknown" else self._load
