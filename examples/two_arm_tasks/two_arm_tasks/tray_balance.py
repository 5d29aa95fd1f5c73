"""TrayBalance: both arms carry a tray with a ball on it. Props, task and scripted policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import dual_ur10.tasks as ur

HANDLE_M, RADIUS_M, LYING_M = 0.04, 0.02, 0.02  # width of the handles; of the ball; height of the tray on the table
GOAL_M = 0.15  # height of the middle of all goals above that
LOADS_KG = (0.6, 0.6)  # half of the tray for each arm
DOWN = (0.0, 1.0, -1.0, 0.0)  # orientation of a tool that grips a handle from above

TRAY = ur.Prop(
    name="tray",
    mjcf="""
<mujoco>
  <default><geom type="box" mass="0.05" friction="0.5 0.005 0.00001" rgba="0.70 0.72 0.75 1"/></default>
  <worldbody><body><freejoint/>
    <geom size="0.15 0.18 0.01" pos="0 0 -0.01" mass="0.7"/>
    <geom size="0.15 0.005 0.003" pos="0 0.175 0.003"/>
    <geom size="0.15 0.005 0.003" pos="0 -0.175 0.003"/>
    <geom size="0.005 0.17 0.003" pos="0.145 0 0.003"/>
    <geom size="0.005 0.17 0.003" pos="-0.145 0 0.003"/>
    <geom size="0.02 0.07 0.02" pos="0 0.25 0" mass="0.15" rgba="0.93 0.58 0.16 1"/>
    <geom size="0.02 0.07 0.02" pos="0 -0.25 0" mass="0.15" rgba="0.93 0.58 0.16 1"/>
    <geom type="cylinder" size="0.02 0.0003" rgba="0.16 0.17 0.19 1" group="2" contype="0" conaffinity="0"/>
  </body></worldbody>
</mujoco>""",
    held=(ur.HeldCapsule((-0.04, 0, 0), (0.28, 0, 0), 0.03), ur.HeldCapsule((0.04, 0, 0), (-0.28, 0, 0), 0.03)),
)
BALL = ur.Prop(
    name="ball",
    mjcf="""
<mujoco>
  <worldbody><body><freejoint/>
    <geom type="sphere" size="0.02" mass="0.05" condim="6" friction="0.5 0.005 0.00001" rgba="0.85 0.25 0.20 1"/>
  </body></worldbody>
</mujoco>""",
)
GOAL = ur.Prop(
    name="goal",
    mjcf="""
<mujoco>
  <default><geom group="2" contype="0" conaffinity="0" rgba="0.2 0.7 0.3 0.3"/></default>
  <worldbody><body mocap="true">
    <geom type="box" size="0.16 0.19 0.001" pos="0 0 -0.022"/>
  </body></worldbody>
</mujoco>""",
)


@dataclass(frozen=True)
class TraySettings:
    """Settings of TrayBalance, keywords of `gym.make`.

    Attributes:
        ball_range_m: Initial position of the ball on the tray, ± along x and y.
        object_range_m: Initial position of the tray, ± along x and y.
        target_range_m: Position of the goal, ± along each axis about a place above the table.
        target_turn_rad: Its yaw, ±.
        success_ball_m: Largest distance of the ball from the middle of the tray of a success.
        duration_s: Time of an episode.
    """

    ball_range_m: float = 0.05
    object_range_m: float = 0.02
    target_range_m: float = 0.08
    target_turn_rad: float = 0.2
    success_ball_m: float = 0.02
    duration_s: float = 30.0

    def __post_init__(self) -> None:
        ranges = ("ball_range_m", 0.0, 0.1), ("object_range_m", 0.0, 0.05), ("target_range_m", 0.0, 0.1)
        more = ("target_turn_rad", 0.0, 0.3), ("success_ball_m", 1e-3, 0.1), ("duration_s", 0.1, 1000.0)
        ur.check_numbers(self, *ranges, *more)


class Facts(NamedTuple):
    """Facts of one instant on which the stages depend.

    Attributes:
        near: (n, 2) nearness of each tool to its grip.
        holds: (n, 2) True if the gripper holds its handle.
        height_m: (n,) height of the tray above where it lay.
        goal_m, goal_rad: (n,) distance and angle of the tray from its goal.
        ball_m: (n,) distance of the ball from the middle of the tray.
        fell: (n,) True if the ball is no longer on the tray.
    """

    near: ur.Array
    holds: ur.Mask
    height_m: ur.Array
    goal_m: ur.Array
    goal_rad: ur.Array
    ball_m: ur.Array
    fell: ur.Mask


@ur.register("TwoArm/TrayBalance-v0", scripted="TrayScript")
class TrayBalance(ur.GraspingTask[TraySettings, Facts]):
    """Both arms lift a tray with a ball on it, roll the ball to its middle, and carry it to a goal in the air.

    Success is a tray within 10 mm and 0.05 rad of its goal, in both grippers, with the ball within 20 mm of its middle,
    for a second. A level tray leaves the ball where it was. One arm alone cannot succeed.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = TraySettings
    settled_s = 1.0
    ranges = ("object_range_m", "ball_range_m")
    observed = ("tray", "ball", "goal")
    grips = (
        ur.Grip("tray", ur.pose((0.0, 0.28, 0.006), DOWN), HANDLE_M),
        ur.Grip("tray", ur.pose((0.0, -0.28, 0.006), DOWN), HANDLE_M),
    )

    @classmethod
    def requirements(cls, settings: TraySettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the tray, the ball and the goal."""
        near = ur.Camera("near", position_m=(0.75, 0.4, 0.65), target_m=(0.0, 0.0, 0.1))
        equipment = ur.Equipment(grippers=True, props=(TRAY, BALL, GOAL), grip_force_n=100.0, cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample the places of tray, ball and goal."""
        unit, settings = np.array([rng.uniform(-1.0, 1.0, 8) for rng in rngs]), self.settings
        column = np.ones((len(rows), 1))
        tray = np.concatenate([unit[:, :2] * settings.object_range_m, LYING_M * column], axis=1)
        ball = tray + np.concatenate([unit[:, 2:4] * settings.ball_range_m, RADIUS_M * column], axis=1)
        goal = unit[:, 4:7] * settings.target_range_m + np.array([0.0, 0.0, LYING_M + GOAL_M])
        yaws = np.concatenate([0.0 * column, 0.0 * column, unit[:, 7:] * settings.target_turn_rad], axis=1).T
        poses = [
            np.concatenate([at, ur.yaw_quat(yaw)], axis=1) for at, yaw in zip((tray, ball, goal), yaws, strict=True)
        ]
        return self.start_at_home(rows, dict(zip(self.observed, poses, strict=True)))

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> Facts:
        """Compute the facts of this step."""
        tray, ball = state.objects["tray"], state.objects["ball"]
        off, at_m = ur.relative_to(state.objects["goal"], tray), ur.relative_to(tray, ball).position_m
        near = ur.gaussian(np.linalg.norm(measured.grip_in_tool_m, axis=2), margin=0.3)
        goal_m, goal_rad = np.linalg.norm(off.position_m, axis=1), ur.rotation_angle(off.quat)
        ball_m, fell = np.linalg.norm(at_m[:, :2], axis=1), np.abs(at_m[:, 2] - RADIUS_M) > RADIUS_M
        self.shown = {"ball_m": ball_m, "tray_m": goal_m, "tray_rad": goal_rad}
        return Facts(near, measured.holding, tray.position_m[:, 2] - LYING_M, goal_m, goal_rad, ball_m, fell)

    @ur.stage(weight=0.2)
    def grasp(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Hold both handles."""
        left, right = (0.5 * (now.near + now.holds)).T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG, coupled=True)
    def lift(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Lift the tray by 5 cm."""
        both = now.holds.all(axis=1)
        return both & (now.height_m > 0.05), both * ur.ratio(now.height_m / 0.05)

    @ur.stage(weight=0.2, load_kg=LOADS_KG, coupled=True)
    def center(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Roll the ball to the middle of the tray."""
        both = now.holds.all(axis=1)
        return both & (now.ball_m < self.settings.success_ball_m), both * ur.gaussian(now.ball_m, margin=0.1)

    @ur.stage(weight=0.4, load_kg=LOADS_KG, coupled=True)
    def carry(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Carry the tray to its goal, with the ball in its middle."""
        both = now.holds.all(axis=1) & (now.ball_m < self.settings.success_ball_m)
        return both & (now.goal_m < 0.01) & (now.goal_rad < 0.05), both * ur.gaussian(now.goal_m, margin=0.2)

    def lost(self, now: Facts) -> ur.Number:
        """Return the rows whose ball fell from the tray."""
        return now.fell

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


LIFT_S, CENTER_S, CARRY_S = 2.0, 1.5, 4.0  # times of the script
POSITION_GAIN, SPEED_GAIN, TILT_RAD = 0.32, 0.34, 0.05  # of the tilt: rad/m, rad/(m/s), and its limit
SPEED_FILTER = 0.3


class TrayScript(ur.Script):
    """Grips both handles and moves the tray with both arms; its tilt rolls the ball to the middle."""

    task = TrayBalance

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms, period_s = ur.Motions(self, fields), self.timing.period_s
        tray, goal, ball_m = arms.pose("tray_base", LYING_M), arms.pose("goal_base"), self.ball(arms)
        in_tray = ur.pair(*(grip.tool for grip in TrayBalance.grips))
        grips = ur.compose(tray, in_tray)
        yield from arms.move(ur.raised(grips, 0.1))
        yield from arms.line(grips)
        yield from arms.grip(-1.0)
        up_m, speed_m_s = np.array([0.0, 0.0, GOAL_M]), np.zeros(2)
        yaw_rad = 2.0 * np.arctan2(goal.quat[3], goal.quat[0])
        for time_s in np.arange(1, 10_000) * period_s:
            lifted, carried = ur.least_jerk(np.array([time_s / LIFT_S, (time_s - LIFT_S - CENTER_S) / CARRY_S]))
            before_m, ball_m = ball_m, self.ball(arms)
            speed_m_s = speed_m_s + SPEED_FILTER * ((ball_m - before_m) / period_s - speed_m_s)
            x, y = lifted * (POSITION_GAIN * ball_m + SPEED_GAIN * speed_m_s).clip(-TILT_RAD, TILT_RAD)
            path_m = lifted * up_m + carried * (goal.position_m - tray.position_m - up_m)
            tilted = ur.Poses(tray.position_m + path_m, ur.quat_from_rotvec(np.array([y, -x, 0.0])))
            turned = ur.Poses(np.zeros(3), ur.yaw_quat(carried * yaw_rad))
            yield from arms.step(ur.compose(ur.compose(tilted, turned), in_tray))

    def ball(self, arms: ur.Motions) -> ur.Array:
        """Return the position of the ball relative to the tray, x and y of the cell, (2,)."""
        return (arms.pose("ball_base").position_m - arms.pose("tray_base").position_m)[:2]
