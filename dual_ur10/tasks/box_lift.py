"""BoxLift: both arms press a box without handles between them, lift it and place it. Props, task and script."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

import dual_ur10.tasks as ur

DEEP_M, HIGH_M, MASS_KG = 0.16, 0.2, 2.5  # of the box: sides along its y and z, and its mass
CONTACT_M = 0.02  # height of the fingertips above its middle
TIP_M = 0.019  # tool centre point to fingertip
YAW_RAD = np.radians(-30.0)  # of the line between the fingertips; along y the left arm would fold onto itself
START_M, PLACE_M = np.array([-0.15, 0.03, HIGH_M / 2]), np.array([-0.15, -0.13, HIGH_M / 2])  # middles of both ranges
LIFTED_M, OVER_GOAL_M, PRESSED_N, FREE_N = 0.08, 0.05, 20.0, 2.0  # distances and forces that stages count
DROPPED_M_S = 0.5  # speed of a box that falls

GOAL = ur.Prop(
    name="goal",
    mjcf=f"""
<mujoco>
  <worldbody><body mocap="true">
    <geom type="box" size="0.1 0.08 0.001" pos="0 0 {-HIGH_M / 2}" group="2" contype="0" conaffinity="0"
          rgba="0.2 0.7 0.3 0.4"/>
  </body></worldbody>
</mujoco>""",
)


def box(width_m: float) -> ur.Prop:
    """Return a box of a width along its x."""
    return ur.Prop(
        name="box",
        mjcf=f"""
<mujoco>
  <worldbody><body><freejoint/>
    <geom type="box" size="{width_m / 2} {DEEP_M / 2} {HIGH_M / 2}" mass="{MASS_KG}" friction="0.5 0.005 0.0001"
          rgba="0.72 0.53 0.35 1"/>
  </body></worldbody>
</mujoco>""",
    )


def tools_at(width_m: float, pressed_m: ur.Array | float = 0.0) -> ur.Poses:
    """Return the poses of both tools in the frame of the box, with closed fingertips at its faces.

    Args:
        width_m: Width of the box.
        pressed_m: (2,) distances inwards from there.
    """
    x_m = np.array([-1.0, 1.0]) * (width_m / 2 + TIP_M - pressed_m)
    quat = np.array([[0.0, 1.0, 0.0, 1.0], [1.0, 0.0, -1.0, 0.0]]) / np.sqrt(2.0)
    return ur.Poses(np.stack([x_m, np.zeros(2), np.full(2, CONTACT_M)], axis=1), quat)


def grips_of(width_m: float) -> tuple[ur.Grip, ur.Grip]:
    """Return the grips of closed grippers at the faces of a box of a width."""
    left, right = (ur.Grip("box", ur.Poses(*place), 0.0) for place in zip(*tools_at(width_m), strict=True))
    return left, right


@dataclass(frozen=True)
class BoxSettings:
    """Settings of BoxLift, keywords of `gym.make`.

    Attributes:
        width_m: Width of the box between the fingertips.
        object_range_m: Initial position of the box, ± along x and y.
        object_turn_rad: Its initial yaw, ±.
        target_range_m: Position of the goal, ± along x and y about a place 16 cm from that of the box.
        target_turn_rad: Its yaw, ±.
        success_error_m: Largest distance of the box from its goal of a success.
        success_turn_rad: Largest angle of the box from its goal of a success.
        duration_s: Time of an episode.
    """

    width_m: float = 0.2
    object_range_m: float = 0.02
    object_turn_rad: float = 0.1
    target_range_m: float = 0.03
    target_turn_rad: float = 0.1
    success_error_m: float = 0.015
    success_turn_rad: float = 0.05
    duration_s: float = 35.0

    def __post_init__(self) -> None:
        ur.check_numbers(
            self,
            ("width_m", 0.1, 0.26),
            ("object_range_m", 0.0, 0.04),
            ("object_turn_rad", 0.0, 0.2),
            ("target_range_m", 0.0, 0.04),
            ("target_turn_rad", 0.0, 0.2),
            ("success_error_m", 1e-3, 0.1),
            ("success_turn_rad", 1e-3, 0.5),
            ("duration_s", 0.1, 1000.0),
        )

    @property
    def places(self) -> tuple[tuple[str, ur.Array, float, float], ...]:
        """Names of box and goal, each with the middle and the ranges of its positions and yaws."""
        goal = "goal", PLACE_M, self.target_range_m, self.target_turn_rad
        return ("box", START_M, self.object_range_m, self.object_turn_rad), goal


class BoxFacts(NamedTuple):
    """Facts of one instant on which the stages depend.

    Attributes:
        grasping: (n, 2) progress of each gripper towards its face.
        at_face: (n, 2) True if the closed gripper is at its face.
        force_n: (n, 2) force with which each gripper presses the box towards the other.
        height_m: (n,) height of the box above where it stood.
        goal_m, goal_rad: (n,) distance and angle of the box from its goal.
        aside_m: (n,) horizontal part of that distance.
        lost: (n,) True if the box fell over, or from the table, or was dropped.
    """

    grasping: ur.Array
    at_face: ur.Mask
    force_n: ur.Array
    height_m: ur.Array
    goal_m: ur.Array
    goal_rad: ur.Array
    aside_m: ur.Array
    lost: ur.Mask


class BoxLift(ur.GraspingTask[BoxSettings, BoxFacts]):
    """Both arms press a box without handles between their closed fingers, lift it, and place it on a goal.

    ## Description

    A box of 2.5 kg is wider than a gripper opens. Both arms press their closed fingertips against two opposite faces,
    about 20 N each at least, and friction carries the box. They lift it, carry it to a goal on the table and let go of
    it. One arm alone cannot lift it, and passes no stage.

    ## Action Space

    {actions}

    ## Observation Space

    {observations}

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of both arms' parts, which their agents earn. It is 1 once its stage
    is passed, which is never lost, progress until then, and 0 before the stage begins.

    - *reach* (0.2): passed when both closed grippers are at the faces of the box. Each arm: half of the nearness of its
      gripper to its face, 0.2 for closing there, and 0.3 for being there.
    - *press* (0.2): passed when each presses with 20 N towards the other. Both: the lesser fraction of that.
    - *lift* (0.2): passed when the box is 8 cm above the table and over its goal to 5 cm, pressed with 10 N or more.
      Both: the fraction of that height, half of it times the nearness to the goal, while the box is pressed.
    - *place* (0.4): passed when the box is within `success_error_m` and `success_turn_rad` of its goal, and neither
      gripper exerts more than 2 N. Both: 0.8 of the nearness of the box to its goal, the rest when all is so.
    - *finish* (1.0): at a step that ends an episode with success, the number of its remaining steps; otherwise 0.

    `info["stage"]` is the number of stages passed in their order, 0 to 4. `info` also holds, without noise, `height_m`,
    the height of the box above where it stood, `goal_m` and `goal_rad`, its distance and angle from its goal, and
    `force_n` (2,), the force on each gripper.

    ## Starting State

    Both arms are at rest at home with open grippers. The box stands at (-0.15, 0.03) m with its x at -30 degrees, and
    its goal is at (-0.15, -0.13) m, each shifted by up to its range along x and y and rotated by up to its yaw.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "success": all stages were passed, and the box has stood on its goal for 0.5 s;
    - "box_fell": the box fell over, or from the table, or was dropped (0.5 m/s);
    - "refused/<limit>": with `on_refusal="terminate"`, the safety gate refused a motion; see `info["safety"]`;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    After `duration_s`, 875 steps with the defaults, with the reason "time". `env.spec.max_episode_steps` is this
    number; no time limit is registered with the id.

    ## Arguments

    {arguments}

    ## Version History

    - v0: first version.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = BoxSettings
    per_arm: ClassVar[tuple[str, ...]] = ("force_n",)
    observed = ("box", "goal")
    grips = grips_of(BoxSettings.width_m)

    def __init__(self, settings: BoxSettings, cell: ur.CellConfig, timing: ur.Timing, n: int) -> None:
        self.grips = grips_of(settings.width_m)  # type: ignore[misc]  # those of the class are of the default box
        super().__init__(settings, cell, timing, n)
        self.before_m = np.zeros(n)
        reached = {}
        for name, middle_m, range_m, turn_rad in settings.places:
            boxes = ur.Poses(*(part[:, None] for part in ur.corners(middle_m, range_m, turn_rad, YAW_RAD)))
            reached[f"the {name}"] = ur.raised(ur.compose(boxes, tools_at(settings.width_m, -BEHIND_M)), HEIGHT_M)
        ur.check_reach(cell, reached)

    @classmethod
    def requirements(cls, settings: BoxSettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the box and its goal."""
        near = ur.Camera("near", position_m=(0.75, 0.4, 0.6), target_m=(-0.1, 0.0, 0.1))
        equipment = ur.Equipment(grippers=True, props=(box(settings.width_m), GOAL), cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.STIFF)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample the places of box and goal."""
        unit = np.array([rng.uniform(-1.0, 1.0, (2, 3)) for rng in rngs])
        objects = {}
        for k, (name, middle_m, range_m, turn_rad) in enumerate(self.settings.places):
            shift = unit[:, k] * [range_m, range_m, turn_rad]
            place_m = middle_m + shift * [1.0, 1.0, 0.0]
            objects[name] = np.concatenate([place_m, ur.yaw_quat(YAW_RAD + shift[:, 2])], axis=1)
        self.before_m[rows] = 0.0
        return self.start_at_home(rows, objects)

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> BoxFacts:
        """Compute the facts of this step."""
        found, goal, pushed_n = state.objects["box"], state.objects["goal"], self.forces_n(state)
        axis, up = (ur.rotate(found.quat, each) for each in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
        off = ur.relative_to(goal, found)
        goal_m, goal_rad = np.linalg.norm(off.position_m, axis=1), ur.rotation_angle(off.quat)
        force_n, height_m = np.linalg.norm(pushed_n, axis=2), found.position_m[:, 2] - HIGH_M / 2
        self.shown = {"force_n": force_n, "height_m": height_m, "goal_m": goal_m, "goal_rad": goal_rad}
        pressed_n, aside_m = -np.vecdot(pushed_n, np.stack([axis, -axis], axis=1)), np.hypot(*off.position_m[:, :2].T)
        lost = (up[:, 2] < 0.8) | (height_m < -0.05) | (self.before_m - height_m > DROPPED_M_S * self.timing.period_s)
        self.before_m, grasping = height_m, self.grasping(measured)
        return BoxFacts(grasping, measured.holding, pressed_n, height_m, goal_m, goal_rad, aside_m, lost)

    @ur.stage(weight=0.2)
    def reach(self, now: BoxFacts) -> tuple[ur.Number, ur.Progress]:
        """Bring both closed grippers to the faces of the box."""
        return now.at_face.all(axis=1), tuple(now.grasping.T)

    @ur.stage(weight=0.2)
    def press(self, now: BoxFacts) -> tuple[ur.Number, ur.Progress]:
        """Press the box between both grippers."""
        least_n = np.where(now.at_face, now.force_n, 0.0).min(axis=1)
        return least_n > PRESSED_N, ur.ratio(least_n / PRESSED_N)

    @ur.stage(weight=0.2, load_kg=(MASS_KG / 2, MASS_KG / 2), coupled=True)
    def lift(self, now: BoxFacts) -> tuple[ur.Number, ur.Progress]:
        """Lift the box between both grippers, and carry it over its goal."""
        both = (now.at_face & (now.force_n > 0.5 * PRESSED_N)).all(axis=1)
        progress = both * ur.ratio(now.height_m / LIFTED_M) * (0.5 + 0.5 * ur.gaussian(now.aside_m, margin=0.3))
        return both & (now.height_m > LIFTED_M) & (now.aside_m < OVER_GOAL_M), progress

    @ur.stage(weight=0.4, load_kg=(MASS_KG / 2, MASS_KG / 2), coupled=True)
    def place(self, now: BoxFacts) -> tuple[ur.Number, ur.Progress]:
        """Place the box upright on its goal, and let go of it."""
        at_goal = (now.goal_m < self.settings.success_error_m) & (now.goal_rad < self.settings.success_turn_rad)
        free = (now.force_n < FREE_N).all(axis=1)
        near = ur.gaussian(now.goal_m + 0.1 * now.goal_rad, margin=0.15)
        return at_goal & free, near * (0.8 + 0.2 * (at_goal & free))

    def lost(self, now: BoxFacts) -> ur.Number:
        """Return the rows whose box fell over, or from the table, or was dropped."""
        return now.lost

    def failure(self, row: int, outcome: ur.Outcome) -> str:
        """Return the name of the failure."""
        return "box_fell"

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


BEHIND_M, NEAR_M, OVER_M = 0.08, 0.015, 0.1  # distances of the fingertips from where they touch
FORCE_N, YIELD_M_S_N, LEAVE_M_S = 42.0, 1e-4, 0.02  # force that is regulated, its gain; speed of grippers that leave
PRESSED, SETTLED_S, WAIT_S = 0.9, 0.4, 15.0  # fraction of the force, and its time, before the lift; longest wait for it
HEIGHT_M, LIFT_S, CARRY_S, LOWER_S = 0.12, 3.0, 4.0, 4.0
AHEAD = np.array([0.0, 0.0, 1.0])  # of a tool, in its own frame


class BoxScript(ur.Script):
    """Presses the box with the measured forces, so that arms, box and goal need not be where they were measured."""

    task = BoxLift

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms, period_s, width_m = ur.Motions(self, fields), self.timing.period_s, self.settings.width_m
        begin, goal = arms.pose("box_base", HIGH_M / 2), arms.pose("goal_base", HIGH_M / 2)
        yield from arms.grip(-1.0)
        yield from arms.move(ur.raised(ur.compose(begin, tools_at(width_m, -BEHIND_M)), OVER_M))
        yield from arms.line(ur.compose(begin, tools_at(width_m, -BEHIND_M)))
        yield from arms.line(ur.compose(begin, tools_at(width_m, -NEAR_M)), speed_m_s=0.05)
        yielding = ur.Admittance(arms, YIELD_M_S_N)
        yield from yielding.tare()
        pressed_s = waited_s = 0.0
        while pressed_s < SETTLED_S and waited_s < WAIT_S:
            least_n = yield from self.press(yielding, begin)
            pressed_s, waited_s = pressed_s * (least_n > PRESSED * FORCE_N) + period_s, waited_s + period_s
        path_m = goal.position_m - begin.position_m
        turn_rad = 2.0 * np.arctan(np.divide(*ur.relative_to(begin, goal).quat[[3, 0]]))
        for time_s in np.arange(1, 1 + int((LIFT_S + CARRY_S + LOWER_S + 0.5) / period_s)) * period_s:
            times_s = time_s - np.array([0.0, LIFT_S, LIFT_S + CARRY_S])
            up, along, down = ur.least_jerk(times_s / [LIFT_S, CARRY_S, LOWER_S])
            at_m = begin.position_m + along * path_m + np.array([0.0, 0.0, (up - down) * HEIGHT_M])
            quat = ur.quat_multiply(ur.yaw_quat(along * turn_rad), begin.quat)
            yield from self.press(yielding, ur.Poses(at_m, quat))
        tools, away_m = arms.tools, np.zeros(3)
        while True:
            away_m = np.maximum(away_m - LEAVE_M_S * period_s * AHEAD, -BEHIND_M * AHEAD)
            yield from arms.step(ur.Poses(tools.position_m + ur.rotate(tools.quat, away_m), tools.quat))

    def press(self, yielding: ur.Admittance, box: ur.Poses) -> Generator[ur.Wish, ur.Fields, float]:
        """Regulate the forces of both grippers on a box on its path for one action; return the lesser one."""
        yield from yielding.step(ur.compose(box, tools_at(self.settings.width_m, -NEAR_M)), AHEAD, -FORCE_N * AHEAD)
        return float(-yielding.force_n[:, 2].max())
