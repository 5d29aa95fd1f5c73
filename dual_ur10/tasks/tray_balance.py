"""TrayBalance: both arms carry a tray with a ball on it. Props, task and scripted policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

import dual_ur10.tasks as ur

HANDLE_M, LYING_M = 0.04, 0.02  # width of the handles; height of the tray on the table
INSIDE_M = 0.14  # from the middle of the tray to its rim along x
LIFTED_M = LYING_M + 0.05  # height of a tray that is lifted
GOAL_M = 0.15  # height of the middle of all goals above that
LOADS_KG, BORNE_N = (0.6, 0.6), 1.5  # half of the tray for each arm; the least that each bears, an eighth
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


def ball(radius_m: float) -> ur.Prop:
    """Return a ball of 50 g."""
    return ur.Prop(
        name="ball",
        mjcf=f"""
<mujoco>
  <worldbody><body><freejoint/>
    <geom type="sphere" size="{radius_m}" mass="0.05" condim="6" friction="0.5 0.005 0.00001" rgba="0.85 0.25 0.20 1"/>
  </body></worldbody>
</mujoco>""",
    )


SMOOTH = 0.3  # of the measured velocity of the ball, in each step
BALL_SPEED = ur.Field(
    "ball_base_m_s", 3, -2.0, 2.0, "velocity (m/s)", "smoothed velocity of the ball from the tray", concise=(0.1,)
)


@dataclass(frozen=True)
class TraySettings:
    """Settings of TrayBalance, keywords of `gym.make`.

    Attributes:
        ball_radius_m: Radius of the ball.
        ball_range_m: Initial position of the ball on the tray, ± along x and y.
        object_range_m: Initial position of the tray, ± along x and y.
        target_range_m: Position of the goal, ± along each axis about a place above the table.
        target_turn_rad: Its yaw, ±.
        success_ball_m: Largest distance of the ball from the middle of the tray of a success.
        duration_s: Time of an episode.
    """

    ball_radius_m: float = 0.02
    ball_range_m: float = 0.05
    object_range_m: float = 0.02
    target_range_m: float = 0.08
    target_turn_rad: float = 0.2
    success_ball_m: float = 0.02
    duration_s: float = 30.0

    def __post_init__(self) -> None:
        ur.check_numbers(
            self,
            ("ball_radius_m", 0.01, 0.04),
            ("ball_range_m", 0.0, 0.13),
            ("object_range_m", 0.0, 0.05),
            ("target_range_m", 0.0, 0.1),
            ("target_turn_rad", 0.0, 0.3),
            ("success_ball_m", 1e-3, 0.1),
            ("duration_s", 0.1, 1000.0),
        )
        if self.ball_radius_m + self.ball_range_m > INSIDE_M:
            raise ur.SettingsError(
                f"ball_radius_m is {self.ball_radius_m:g} and ball_range_m {self.ball_range_m:g}: such a ball does not "
                f"fit the tray, whose rim is {INSIDE_M:g} m from its middle. Use ball_range_m="
                f"{INSIDE_M - self.ball_radius_m:g} or less"
            )


class TrayFacts(NamedTuple):
    """Facts of one instant on which the stages depend.

    Attributes:
        grasping: (n, 2) progress of each arm towards holding its handle.
        holds: (n, 2) True if the gripper holds its handle.
        height_m: (n,) height of the tray above where it lay.
        goal_m, goal_rad: (n,) distance and angle of the tray from its goal.
        ball_m: (n,) distance of the ball from the middle of the tray.
        shared: (n,) True if each gripper bears a part of the weight.
        fell: (n,) True if the ball is no longer on the tray.
    """

    grasping: ur.Array
    holds: ur.Mask
    height_m: ur.Array
    goal_m: ur.Array
    goal_rad: ur.Array
    ball_m: ur.Array
    shared: ur.Mask
    fell: ur.Mask


class TrayBalance(ur.GraspingTask[TraySettings, TrayFacts]):
    """Both arms lift a tray, bring the ball on it to rest in its middle, and carry it to a goal in the air.

    ## Description

    A tray of 1.2 kg with a ball of 50 g lies on the table. Both arms grip its handles, lift it, roll the ball to its
    middle by tilting the tray, and carry it to a goal without losing the ball. A level tray leaves the ball where it
    was. One arm alone cannot lift the tray, and passes no stage.

    ## Action Space

    {actions}

    ## Observation Space

    {observations}

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of both arms' parts, which their agents earn. It is 1 once its stage
    is passed, which is never lost, progress until then, and 0 before the stage begins.

    - *grasp* (0.2): passed when both grippers hold their handles. Each arm: half of the nearness of its tool to its
      handle, 0.2 for closing there, and 0.3 for holding it.
    - *lift* (0.2): passed when both hold the tray 5 cm above where it lay. Both: the fraction of that height.
    - *center* (0.2): passed when the ball is within `success_ball_m` of the middle. Both: its nearness to the middle.
    - *carry* (0.4): passed when the tray is within 10 mm and 0.05 rad of its goal, with the ball in its middle, and
      each arm bears 1.5 N or more. Both: the nearness of the tray to its goal, times that of the ball to the middle.
    - *finish* (1.0): at a step that ends an episode with success, the number of its remaining steps; otherwise 0.

    `info["stage"]` is the number of stages passed in their order, 0 to 4. `info` also holds, without noise, `ball_m`,
    the distance of the ball from the middle, `tray_m` and `tray_rad`, those of the tray from its goal, and `force_n`
    (2,), the force on each gripper.

    ## Starting State

    Both arms are at rest at home with open grippers. The tray lies at (0, 0) m, shifted by up to `object_range_m` along
    x and y, with the ball up to `ball_range_m` off its middle along each. The goal is up to `target_range_m` from
    (0, 0, 0.17) m along each axis, rotated by up to `target_turn_rad`.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "success": all stages were passed, and tray and ball have been at their goals for 1 s;
    - "ball_fell": the ball fell from the tray;
    - "refused/<limit>": with `on_refusal="terminate"`, the safety gate refused a motion; see `info["safety"]`;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    After `duration_s`, 750 steps with the defaults, with the reason "time". `env.spec.max_episode_steps` is this
    number; no time limit is registered with the id.

    ## Arguments

    {arguments}

    ## Version History

    - v0: first version.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = TraySettings
    per_arm: ClassVar[tuple[str, ...]] = ("force_n",)
    settled_s = 1.0
    ranges = ("object_range_m", "ball_range_m")
    observed = ("tray", "ball", "goal")
    further = (BALL_SPEED,)
    grips = (
        ur.Grip("tray", ur.pose((0.0, 0.28, 0.006), DOWN), HANDLE_M),
        ur.Grip("tray", ur.pose((0.0, -0.28, 0.006), DOWN), HANDLE_M),
    )

    def __init__(self, settings: TraySettings, cell: ur.CellConfig, timing: ur.Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        self.at_m, self.speed_m_s, self.level_rad = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        left, right = (grip.tool for grip in self.grips)
        places = {}
        for name, height_m, reach_m, turn_rad in (
            ("the handles", LYING_M, settings.object_range_m, 0.0),
            ("the goal", LYING_M + GOAL_M + settings.target_range_m, settings.target_range_m, settings.target_turn_rad),
        ):
            trays = ur.corners((0.0, 0.0, height_m), reach_m, turn_rad)
            places[name] = ur.pair(ur.compose(trays, left), ur.compose(trays, right))
        ur.check_reach(cell, places)

    @classmethod
    def requirements(cls, settings: TraySettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the tray, the ball and the goal."""
        near = ur.Camera("near", position_m=(0.75, 0.4, 0.65), target_m=(0.0, 0.0, 0.1))
        props = TRAY, ball(settings.ball_radius_m), GOAL
        equipment = ur.Equipment(grippers=True, props=props, grip_force_n=100.0, cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample the places of tray, ball and goal."""
        unit, settings = np.array([rng.uniform(-1.0, 1.0, 8) for rng in rngs]), self.settings
        column = np.ones((len(rows), 1))
        tray = np.concatenate([unit[:, :2] * settings.object_range_m, LYING_M * column], axis=1)
        ball = tray + np.concatenate([unit[:, 2:4] * settings.ball_range_m, settings.ball_radius_m * column], axis=1)
        goal = unit[:, 4:7] * settings.target_range_m + np.array([0.0, 0.0, LYING_M + GOAL_M])
        yaws = np.concatenate([0.0 * column, 0.0 * column, unit[:, 7:] * settings.target_turn_rad], axis=1).T
        places = zip((tray, ball, goal), yaws, strict=True)
        poses = [np.concatenate([at, ur.yaw_quat(yaw)], axis=1) for at, yaw in places]
        self.speed_m_s[rows], self.level_rad[rows] = 0.0, 0.0
        return self.start_at_home(rows, dict(zip(self.observed, poses, strict=True)))

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> TrayFacts:
        """Compute the facts of this step."""
        tray, ball = state.objects["tray"], state.objects["ball"]
        off, at_m = ur.relative_to(state.objects["goal"], tray), ur.relative_to(tray, ball).position_m
        goal_m, goal_rad = np.linalg.norm(off.position_m, axis=1), ur.rotation_angle(off.quat)
        ball_m, radius_m = np.linalg.norm(at_m[:, :2], axis=1), self.settings.ball_radius_m
        fell = np.abs(at_m[:, 2] - radius_m) > radius_m
        force_n = np.linalg.norm(self.forces_n(state), axis=2)
        self.shown = {"force_n": force_n, "ball_m": ball_m, "tray_m": goal_m, "tray_rad": goal_rad}
        height_m, grasping = tray.position_m[:, 2] - LYING_M, self.grasping(measured)
        shared = np.all(self.forces_n(state)[..., 2] < -BORNE_N, axis=1)
        return TrayFacts(grasping, measured.holding, height_m, goal_m, goal_rad, ball_m, shared, fell)

    def further_values(self, state: ur.CellState, measured: ur.Grasped) -> Mapping[str, ur.Array]:
        """Return the velocity of the ball in both bases."""
        at_m, elapsed_s = state.objects["ball"].position_m - state.objects["tray"].position_m, self.elapsed_s[:, None]
        lifted_s = elapsed_s * (state.objects["tray"].position_m[:, 2:] > LIFTED_M)
        moved_m_s = (at_m - self.at_m) / np.maximum(elapsed_s, 1e-6)
        self.speed_m_s += SMOOTH * (elapsed_s > 0.0) * (moved_m_s - self.speed_m_s)
        self.level_rad = (self.level_rad + LEVEL_RAD_M_S * lifted_s * at_m).clip(-TILT_RAD, TILT_RAD)
        begun = state.time_s[:, None] == 0.0  # a row that is seen again, as others begin, may be sensed otherwise
        self.at_m = np.where(begun | (elapsed_s > 0.0), at_m, self.at_m)
        return {BALL_SPEED.name: self.frames.vector_to_base(self.speed_m_s[:, None].clip(-2.0, 2.0))}

    def lead(self, state: ur.CellState, measured: ur.Grasped) -> ur.Lead:
        """Return the goals: the tray above where it lay, tilted until the ball is in its middle, then its goal."""
        tray, ball, goal = (state.objects[name] for name in self.observed)
        ball_m = ball.position_m - tray.position_m
        lifted = tray.position_m[:, 2:] > LIFTED_M
        tilt_rad = lifted * (POSITION_GAIN * ball_m + SPEED_GAIN * self.speed_m_s + self.level_rad)
        x, y, _ = tilt_rad.clip(-TILT_RAD, TILT_RAD).T
        still = np.hypot(*ball_m[:, :2].T) + np.hypot(*self.speed_m_s[:, :2].T) < 0.03
        above_m = np.where([True, True, False], tray.position_m, LYING_M + GOAL_M)
        carried = lifted & still[:, None]
        to = ur.Poses(np.where(carried, goal.position_m, above_m), np.where(carried, goal.quat, ur.yaw_of(tray.quat)))
        at_m, quat = ur.toward(ur.Poses(tray.position_m, ur.yaw_of(tray.quat)), to, AHEAD_M, AHEAD_RAD)
        tilt = ur.quat_from_rotvec(np.stack([y, -x, np.zeros(self.n)], axis=1))
        both = ur.pair(*[ur.Poses(at_m, ur.quat_multiply(tilt, quat))] * 2)
        return ur.Lead(self.bringing(measured, both), np.ones((self.n, 2), dtype=bool))

    @ur.stage(weight=0.2)
    def grasp(self, now: TrayFacts) -> tuple[ur.Number, ur.Progress]:
        """Hold both handles."""
        left, right = now.grasping.T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG, coupled=True)
    def lift(self, now: TrayFacts) -> tuple[ur.Number, ur.Progress]:
        """Lift the tray by 5 cm."""
        both = now.holds.all(axis=1)
        return both & (now.height_m > 0.05), both * ur.ratio(now.height_m / 0.05)

    @ur.stage(weight=0.2, load_kg=LOADS_KG, coupled=True)
    def center(self, now: TrayFacts) -> tuple[ur.Number, ur.Progress]:
        """Roll the ball to the middle of the tray."""
        both = now.holds.all(axis=1)
        return both & (now.ball_m < self.settings.success_ball_m), both * ur.gaussian(now.ball_m, margin=0.1)

    @ur.stage(weight=0.4, load_kg=LOADS_KG, coupled=True)
    def carry(self, now: TrayFacts) -> tuple[ur.Number, ur.Progress]:
        """Carry the tray to its goal, with the ball in its middle."""
        both, balanced = now.holds.all(axis=1), (now.ball_m < self.settings.success_ball_m) & now.shared
        near = ur.gaussian(now.goal_m + 0.1 * now.goal_rad, margin=0.3) * ur.gaussian(now.ball_m, margin=0.1)
        return both & balanced & (now.goal_m < 0.01) & (now.goal_rad < 0.05), both * near

    def lost(self, now: TrayFacts) -> ur.Number:
        """Return the rows whose ball fell from the tray."""
        return now.fell

    def failure(self, row: int, outcome: ur.Outcome) -> str:
        """Return the name of the failure."""
        return "ball_fell"

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


LEVEL_RAD_M_S = 0.15  # by which the tilt that keeps the ball where it is grows with its distance from the middle
AHEAD_M, AHEAD_RAD = 0.012, 0.03  # longest step of the tray that the goals of the tools show
LIFT_S, CENTER_S, CARRY_S = 2.0, 1.5, 4.0  # times of the script
POSITION_GAIN, SPEED_GAIN, TILT_RAD = 0.32, 0.34, 0.05  # of the tilt: rad/m, rad/(m/s), and its limit


class TrayScript(ur.Script):
    """Grips both handles and moves the tray with both arms; its tilt rolls the ball to the middle."""

    task = TrayBalance

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms, period_s = ur.Motions(self, fields), self.timing.period_s
        tray, goal = arms.pose("tray_base", LYING_M), arms.pose("goal_base")
        in_tray = ur.pair(*(grip.tool for grip in TrayBalance.grips))
        grips = ur.compose(tray, in_tray)
        yield from arms.move(ur.raised(grips, 0.1))
        yield from arms.line(grips)
        yield from arms.grip(-1.0, width_m=(HANDLE_M, HANDLE_M))
        up_m = np.array([0.0, 0.0, GOAL_M])
        yaw_rad = 2.0 * np.arctan2(goal.quat[3], goal.quat[0])
        for time_s in np.arange(1, 10_000) * period_s:
            lifted, carried = ur.least_jerk(np.array([time_s / LIFT_S, (time_s - LIFT_S - CENTER_S) / CARRY_S]))
            ball_m = arms.pose("ball_base").position_m - arms.pose("tray_base").position_m
            tilt_rad = POSITION_GAIN * ball_m + SPEED_GAIN * arms.vector(BALL_SPEED.name)[0]
            x, y, _ = lifted * tilt_rad.clip(-TILT_RAD, TILT_RAD)
            path_m = lifted * up_m + carried * (goal.position_m - tray.position_m - up_m)
            tilted = ur.Poses(tray.position_m + path_m, ur.quat_from_rotvec(np.array([y, -x, 0.0])))
            turned = ur.Poses(np.zeros(3), ur.yaw_quat(carried * yaw_rad))
            yield from arms.step(ur.compose(ur.compose(tilted, turned), in_tray))
