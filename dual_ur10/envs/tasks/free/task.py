"""Free: both arms, their grippers and some objects on the table, without a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.props import BLOCK
from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.tasks.free.settings import FreeSettings
from dual_ur10.envs.tasks.geometry import PICKING, required
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    OTHER_FLANGE_FIELDS,
    Field,
    ObservationLayout,
    arm_values,
    gripper_field,
    pose_fields,
    pose_values,
    wrench_fields,
    wrench_values,
)
from dual_ur10.envs.tasks.task import Outcome, SceneRequirements, Task, Timing
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, relative_to
from ur_core.mjcf.gains import COMPLIANT
from ur_core.types import Array, Rows


def _fields(props: Sequence[Prop]) -> list[Field]:
    """Return the fields of the poses of those props whose poses are not fixed."""
    return [
        field
        for each in props
        if each.posed
        for field in pose_fields(f"{each.name}_base", f"the {each.name}", each.body, concise=True)
    ]


class Free(Task[FreeSettings, Poses]):
    """Scene without a task, for practice with a device and for demonstrations of one's own.

    ## Description

    Both arms stand at the table with open grippers. Objects lie on it: a block of 4 x 4 x 20 cm and 0.5 kg on the left
    side, and on demand a bar of 1.2 m and 4 kg across the middle, or props of your own. Nothing is to be done, and
    nothing ends but by the safety gate, the physics, or who runs the episode.

    What a gripper may carry counts for the distances of the safety gate also while the gripper is empty. So with the
    bar, of which each arm carries half, the arms keep farther apart.

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

    The observation space is a `Box(low, high, (94,), float64)` with the bounds of the table: 47 numbers of the left
    arm, which the table shows, then the same 47 of the right arm, with left and right exchanged. All of them can be
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
    | 26-28 | force of the object on the gripper | -2000 | 2000 | left/wrench | force (N) |
    | 29-31 | torque of the object on the gripper about the flange | -2000 | 2000 | left/wrench | torque (N·m) |
    | 32-34 | position of the block | -10 | 10 | block/block | position (m) |
    | 35-38 | orientation of the block | -1.01 | 1.01 | block/block | quaternion |
    | 39-41 | position of the other flange in the frame of this one | -5 | 5 | right/flange | position (m) |
    | 42-45 | orientation of the other flange in the frame of this one | -1.01 | 1.01 | right/flange | quaternion |
    | 46 | opening of the other gripper | -0.1 | 0.1 | right/finger_1_joint ... right/finger_2_joint | position (m) |

    Every object whose pose is not fixed has 7 numbers in the place of those of the block, in the order of `objects`.

    With `observation="goals"` the observation space is a `Box(-1.0, 1.0, (28,), float32)`: 14 numbers of the left arm,
    then those of the right arm. A value x is shown as x / (u + abs(x)), in the unit u that the table names
    (`dual_ur10.envs.tasks.observation_layout.ConciseView`). There is no goal: it shows the arms and the objects.

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | commanded joint positions, from home | -1 | 1 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) in 1 |
    | 6 | opening of the gripper | -1 | 1 | left/finger_1_joint ... left/finger_2_joint | position (m) in 0.05 |
    | 7-9 | position of the block | -1 | 1 | block/block | position (m) in 0.2 |
    | 10-13 | orientation of the block | -1 | 1 | block/block | quaternion in 0.5 |

    ## Rewards

    The reward is 0, and `info["is_success"]` is false. As in every environment a step in which the safety gate brakes
    costs 1, in simulation.

    ## Starting State

    Both arms are at rest with open grippers above the table. The block and the bar are shifted by up to `object_range_m`
    along x and y and rotated by up to `object_turn_rad`. Props of your own are where their MJCF has them.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "refused/<limit>": the safety gate refused a motion; `info["safety"]` gives the details;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    None, unless `max_episode_steps` is given.

    ## Arguments

    | Parameter | Type | Default | Description |
    |-----------|------|---------|-------------|
    | `objects` | tuple | `('block',)` | objects on the table: "block", "bar", "module:NAME" of a `Prop`, or a `Prop` |
    | `grip_force_n` | float | `60.0` | force of each finger, 20 to 235 (N) |
    | `object_range_m` | float | `0.02` | initial position of block and bar, ± along x and y (m) |
    | `object_turn_rad` | float | `0.1` | initial yaw of block and bar, ± (rad) |

    Those of every environment are described in `dual_ur10.envs.core.options.EnvOptions`.

    ## Version History

    - v0: first version.
    """

    limits: MotionLimits = MotionLimits(
        speed_rad_s=(1.2,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.5
    )
    weights: ClassVar[dict[str, float]] = {}
    settings_type: ClassVar[type[FreeSettings]] = FreeSettings
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS,
        replace(gripper_field(), concise=(0.05,)),
        *wrench_fields("object"),
        *_fields([BLOCK]),
        *OTHER_FLANGE_FIELDS,
        gripper_field("other"),
    )

    def __init__(self, settings: FreeSettings, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        self._frames = Frames((cell.left, cell.right))
        self._names = [each.name for each in settings.props if each.posed]

    @classmethod
    def layout_for(cls, settings: FreeSettings) -> ObservationLayout:
        """Return the fields of an observation, with the poses of the objects."""
        block = [field.name for field in _fields([BLOCK])]
        first = cls.layout.without(*block, *(field.name for field in OTHER_FLANGE_FIELDS), "other_gripper_m")
        return ObservationLayout(*first.fields, *_fields(settings.props), *OTHER_FLANGE_FIELDS, gripper_field("other"))

    @classmethod
    def requirements(cls, settings: FreeSettings) -> SceneRequirements:
        """Return the requirements: two grippers and the objects, which both arms may hold together."""
        equipment = Equipment(grippers=True, props=settings.props, grip_force_n=settings.grip_force_n)
        return SceneRequirements(equipment, 0.001, COMPLIANT, PICKING)

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample the poses of block and bar. The arms are above the table, with open grippers."""
        count = len(self.settings.props)
        samples = np.array([rng.uniform(-1.0, 1.0, (count, 3)) for rng in rngs]).reshape(len(rows), count, 3)
        return self.at_home(rows)._replace(objects=self.settings.places(samples))

    def measure(self, state: CellState) -> Poses:
        """Return the poses of the flanges in the cell frame."""
        return Poses(state.flange_m, required(state.flange_quat))

    def observe(self, state: CellState, measured: Poses, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 2 * layout.size)."""
        gripper_m = required(state.gripper_m)[..., None]
        other = relative_to(measured, Poses(measured.position_m[:, ::-1], measured.quat[:, ::-1]))
        values = {
            **arm_values(state, commanded_q_rad),
            **wrench_values(required(state.wrench)),
            "other_flange_m": other.position_m,
            "other_flange_quat": other.quat,
            "gripper_m": gripper_m,
            "other_gripper_m": gripper_m[:, ::-1],
        }
        for name in self._names:
            pose = state.objects[name]
            position = self._frames.position_to_base(np.repeat(pose.position_m[:, None], 2, axis=1))
            quat = self._frames.quat_to_base(np.repeat(pose.quat[:, None], 2, axis=1))
            values |= pose_values(f"{name}_base", np.concatenate([position, quat], axis=2))
        return self.layout.join(values)

    def evaluate(self, state: CellState, measured: Poses) -> Outcome:
        """Return no reward and no end."""
        never = np.zeros(self.n, dtype=bool)
        return Outcome(np.zeros((self.n, 2, 0)), never, never.copy(), {})
