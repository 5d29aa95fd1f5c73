"""Facade for authors of tasks: all that one file with a task, its scripted policy and its settings needs.

    from dual_ur10.tasks import Outcome, Start, Task, register

    @register("MyLab/Reach-v0", scripted="ReachPolicy")
    class Reach(Task[ReachSettings, Array]): ...

It holds names only; each is documented where it is defined. Each module of this package is a task of the suite in such
a file, with its props and its script.
"""

from dual_ur10.assets.prop import HeldCapsule, Prop
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, home_q_rad
from dual_ur10.envs.core.configuration import ConfigurationReport, PairClearance, check_configuration
from dual_ur10.envs.tasks.geometry import (
    PICKING,
    FrameDistances,
    Goal,
    GoalSteps,
    Number,
    frame_of,
    numbers,
    ratio,
    toward,
)
from dual_ur10.envs.tasks.grasping import GraspingTask, Grip, Lead
from dual_ur10.envs.tasks.grasps import Grasped, Grasps
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    Field,
    ObservationLayout,
    arm_values,
    gripper_field,
    pose_fields,
    pose_values,
    wrench_fields,
    wrench_values,
)
from dual_ur10.envs.tasks.reach import check_reach, corners
from dual_ur10.envs.tasks.staged import Progress, StagedTask, stage, term
from dual_ur10.envs.tasks.task import Outcome, SceneRequirements, Task, Timing, check_numbers, gaussian
from dual_ur10.errors import SettingsError
from dual_ur10.policies.scripted.admittance import Admittance
from dual_ur10.policies.scripted.base import Fields, Script, ScriptedPolicy, Wish, on_table
from dual_ur10.policies.scripted.motions import Motions, Steps, least_jerk, pair, raised
from dual_ur10.policies.training.settings import Imitation, Reinforcement, TaskSettings
from dual_ur10.registration import register
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, pose, relative_to, rotation_angle, yaw_of, yaw_quat
from ur_core.kinematics.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, rotate
from ur_core.mjcf.camera import Camera
from ur_core.mjcf.gains import COMPLIANT, STIFF, Gains
from ur_core.tools.tool import Tool
from ur_core.types import Array, Mask, Rows

__all__ = [
    "ARM_FIELDS",
    "COMPLIANT",
    "HOME_Q_RAD",
    "PICKING",
    "STIFF",
    "Admittance",
    "Array",
    "Camera",
    "CellConfig",
    "CellState",
    "ConfigurationReport",
    "Equipment",
    "Field",
    "Fields",
    "FrameDistances",
    "Frames",
    "Gains",
    "Goal",
    "GoalSteps",
    "Grasped",
    "GraspingTask",
    "Grasps",
    "Grip",
    "HeldCapsule",
    "Imitation",
    "Lead",
    "Mask",
    "MotionLimits",
    "Motions",
    "Number",
    "ObservationLayout",
    "Outcome",
    "PairClearance",
    "Poses",
    "Progress",
    "Prop",
    "Reinforcement",
    "Rows",
    "SceneRequirements",
    "Script",
    "ScriptedPolicy",
    "SettingsError",
    "StagedTask",
    "Start",
    "Steps",
    "Task",
    "TaskSettings",
    "Timing",
    "Tool",
    "Wish",
    "arm_values",
    "check_configuration",
    "check_numbers",
    "check_reach",
    "compose",
    "corners",
    "frame_of",
    "gaussian",
    "gripper_field",
    "home_q_rad",
    "least_jerk",
    "numbers",
    "on_table",
    "pair",
    "pose",
    "pose_fields",
    "pose_values",
    "quat_conjugate",
    "quat_from_rotvec",
    "quat_multiply",
    "raised",
    "ratio",
    "register",
    "relative_to",
    "rotate",
    "rotation_angle",
    "stage",
    "term",
    "toward",
    "wrench_fields",
    "wrench_values",
    "yaw_of",
    "yaw_quat",
]


def __dir__() -> list[str]:
    return sorted(__all__)
