"""CupOnTray: both arms carry a tray on which a cup stands. Props, task and scripted policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import dual_ur10.tasks as ur

HANDLE_M, LYING_M, CUP_M = 0.04, 0.02, 0.1  # width of the handles; height of the tray on the table; that of the cup
GOAL_M = 0.15  # height of the middle of all goals above that
LOADS_KG = (0.6, 0.6)  # half of tray and cup for each arm
DOWN = (0.0, 1.0, -1.0, 0.0)  # orientation of a tool that grips a handle from above

TRAY = ur.Prop(
    name="tray",
    mjcf="""
<mujoco>
  <default><geom type="box" friction="0.5 0.005 0.00001" rgba="0.70 0.72 0.75 1"/></default>
  <worldbody><body><freejoint/>
    <geom size="0.15 0.18 0.01" pos="0 0 -0.01" mass="0.7"/>
    <geom size="0.02 0.07 0.02" pos="0 0.25 0" mass="0.15" rgba="0.93 0.58 0.16 1"/>
    <geom size="0.02 0.07 0.02" pos="0 -0.25 0" mass="0.15" rgba="0.93 0.58 0.16 1"/>
  </body></worldbody>
</mujoco>""",
    held=(ur.HeldCapsule((-0.04, 0, 0), (0.28, 0, 0), 0.03), ur.HeldCapsule((0.04, 0, 0), (-0.28, 0, 0), 0.03)),
)
CUP = ur.Prop(
    name="cup",
    mjcf=f"""
<mujoco>
  <worldbody><body><freejoint/>
    <geom type="cylinder" size="0.03 {CUP_M / 2}" mass="0.2" friction="0.5 0.005 0.0001" rgba="0.85 0.25 0.20 1"/>
  </body></worldbody>
</mujoco>""",
)
GOAL = ur.Prop(
    name="goal",
    mjcf="""
<mujoco>
  <worldbody><body mocap="true">
    <geom type="box" size="0.16 0.19 0.001" pos="0 0 -0.022" group="2" contype="0" conaffinity="0"
          rgba="0.2 0.7 0.3 0.3"/>
  </body></worldbody>
</mujoco>""",
)


@dataclass(frozen=True)
class CupSettings:
    """Settings of CupOnTray, keywords of `gym.make`.

    Attributes:
        object_range_m: Initial position of the tray, ± along x and y; the cup is up to 3 times as far off its middle.
        target_range_m: Position of the goal, ± along each axis about a place above the table.
        target_turn_rad: Its yaw, ±.
        duration_s: Time of an episode.
    """

    object_range_m: float = 0.02
    target_range_m: float = 0.08
    target_turn_rad: float = 0.2
    duration_s: float = 20.0

    def __post_init__(self) -> None:
        ranges = ("object_range_m", 0.0, 0.03), ("target_range_m", 0.0, 0.1), ("target_turn_rad", 0.0, 0.3)
        ur.check_numbers(self, *ranges, ("duration_s", 0.1, 1000.0))


class Facts(NamedTuple):
    """Facts of one instant on which the stages depend.

    Attributes:
        grasping: (n, 2) progress of each arm towards holding its handle.
        holds: (n, 2) True if the gripper holds its handle.
        height_m: (n,) height of the tray above where it lay.
        goal_m, goal_rad: (n,) distance and angle of the tray from its goal.
        fell: (n,) True if the cup fell over, or from the tray.
    """

    grasping: ur.Array
    holds: ur.Mask
    height_m: ur.Array
    goal_m: ur.Array
    goal_rad: ur.Array
    fell: ur.Mask


@ur.register("TwoArm/CupOnTray-v0", scripted="CupScript")
class CupOnTray(ur.GraspingTask[CupSettings, Facts]):
    """Both arms lift a tray on which a cup stands, and carry it to a goal in the air.

    Success is a tray within 10 mm and 0.05 rad of its goal, in both grippers, with the cup upright on it, for half a
    second. One arm alone tilts the tray, and cannot succeed.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = CupSettings
    observed = ("tray", "cup", "goal")
    grips = (
        ur.Grip("tray", ur.pose((0.0, 0.28, 0.006), DOWN), HANDLE_M),
        ur.Grip("tray", ur.pose((0.0, -0.28, 0.006), DOWN), HANDLE_M),
    )

    @classmethod
    def requirements(cls, settings: CupSettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the tray, the cup and the goal."""
        near = ur.Camera("near", position_m=(0.75, 0.4, 0.65), target_m=(0.0, 0.0, 0.1))
        equipment = ur.Equipment(grippers=True, props=(TRAY, CUP, GOAL), grip_force_n=100.0, cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample the places of tray, cup and goal."""
        unit, settings = np.array([rng.uniform(-1.0, 1.0, 8) for rng in rngs]), self.settings
        column = np.ones((len(rows), 1))
        tray = np.concatenate([unit[:, :2] * settings.object_range_m, LYING_M * column], axis=1)
        cup = tray + np.concatenate([unit[:, 2:4] * 3 * settings.object_range_m, CUP_M / 2 * column], axis=1)
        goal = unit[:, 4:7] * settings.target_range_m + np.array([0.0, 0.0, LYING_M + GOAL_M])
        yaws = np.concatenate([0.0 * column, 0.0 * column, unit[:, 7:] * settings.target_turn_rad], axis=1).T
        poses = [
            np.concatenate([at, ur.yaw_quat(yaw)], axis=1) for at, yaw in zip((tray, cup, goal), yaws, strict=True)
        ]
        return self.start_at_home(rows, dict(zip(self.observed, poses, strict=True)))

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> Facts:
        """Compute the facts of this step."""
        tray, off = state.objects["tray"], ur.relative_to(state.objects["goal"], state.objects["tray"])
        cup = ur.relative_to(tray, state.objects["cup"])
        fell = (ur.rotation_angle(cup.quat) > 0.3) | (np.abs(cup.position_m[:, 2] - CUP_M / 2) > 0.02)
        goal_m, goal_rad = np.linalg.norm(off.position_m, axis=1), ur.rotation_angle(off.quat)
        self.shown = {"tray_m": goal_m, "tray_rad": goal_rad}
        return Facts(self.grasping(measured), measured.holding, tray.position_m[:, 2] - LYING_M, goal_m, goal_rad, fell)

    @ur.stage(weight=0.2)
    def grasp(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Hold both handles."""
        left, right = now.grasping.T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG, coupled=True)
    def lift(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Lift the tray by 5 cm."""
        both = now.holds.all(axis=1)
        return both & (now.height_m > 0.05), both * ur.ratio(now.height_m / 0.05)

    @ur.stage(weight=0.6, load_kg=LOADS_KG, coupled=True)
    def carry(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Carry the tray to its goal."""
        both = now.holds.all(axis=1)
        return both & (now.goal_m < 0.01) & (now.goal_rad < 0.05), both * ur.gaussian(now.goal_m, margin=0.2)

    def lost(self, now: Facts) -> ur.Number:
        """Return the rows whose cup fell."""
        return now.fell

    def failure(self, row: int, outcome: ur.Outcome) -> str:
        """Return the name of the failure."""
        return "cup_fell"

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


LIFT_S, CARRY_S = 2.0, 4.0  # times of the script


class CupScript(ur.Script):
    """Grips both handles, lifts the tray level, and carries it to its goal."""

    task = CupOnTray

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms = ur.Motions(self, fields)
        tray, goal = arms.pose("tray_base", LYING_M), arms.pose("goal_base")
        in_tray = ur.pair(*(grip.tool for grip in CupOnTray.grips))
        grips = ur.compose(tray, in_tray)
        yield from arms.move(ur.raised(grips, 0.1))
        yield from arms.line(grips)
        yield from arms.grip(-1.0)
        lifted_m = tray.position_m + np.array([0.0, 0.0, GOAL_M])
        yaw_rad = 2.0 * np.arctan(goal.quat[3] / goal.quat[0])
        for time_s in np.arange(1, 1 + round((LIFT_S + CARRY_S) / arms.period_s)) * arms.period_s:
            up, along = ur.least_jerk(np.array([time_s / LIFT_S, (time_s - LIFT_S) / CARRY_S]))
            at_m = tray.position_m + up * (lifted_m - tray.position_m) + along * (goal.position_m - lifted_m)
            yield from arms.step(ur.compose(ur.Poses(at_m, ur.yaw_quat(along * yaw_rad)), in_tray))
