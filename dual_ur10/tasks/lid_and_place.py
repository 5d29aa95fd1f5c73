"""LidAndPlace: one arm holds a sprung lid open, the other puts a block inside. Props, task and script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

import dual_ur10.tasks as ur

INNER_M, FLOOR_M = 0.18, 0.01  # sides of the inside of the case, and its floor
HINGE_M = np.array([-0.1, 0.0, 0.086])  # in the case
TAB_M, BLOCK_M, BLOCK_HIGH_M, BLOCK_KG = 0.02, 0.04, 0.06, 0.3
OPEN_RAD, SHUT_RAD = 1.2, 0.05  # angles beyond which the lid is open, and below which it is closed
DROPPED_M_S = 0.5  # speed of a block that falls
CASE_YAW_RAD = np.radians(-35.0)
HOLDING = ur.pose((0.17, 0.0, 0.035), (0.0, 0.0, 1.0, 0.0))  # the left tool on the tab, in the frame of the lid
HELD = ur.pose((0.0, 0.0, 0.01), (0.0, 1.0, 0.0, 0.0))  # the right tool on the block, fingertips 2 cm above the table
PLACES_M = {"case": (0.0, 0.05, 0.0), "block": (0.0, -0.3, BLOCK_HIGH_M / 2)}

CASE = ur.Prop(
    name="case",
    mjcf="""
<mujoco>
  <compiler angle="degree"/>
  <default><geom type="box" rgba="0.14 0.47 0.60 1"/></default>
  <worldbody><body mocap="true">
    <geom size="0.1 0.1 0.005" pos="0 0 0.005"/>
    <geom size="0.005 0.1 0.04" pos="0.095 0 0.04"/>
    <geom size="0.005 0.1 0.04" pos="-0.095 0 0.04"/>
    <geom size="0.09 0.005 0.04" pos="0 0.095 0.04"/>
    <geom size="0.09 0.005 0.04" pos="0 -0.095 0.04"/>
    <body name="lid" pos="-0.1 0 0.086">
      <joint name="lid" type="hinge" axis="0 -1 0" range="0 100" stiffness="0.3" springref="-30" damping="0.05"/>
      <geom size="0.1 0.1 0.004" pos="0.1 0 0" mass="0.2" rgba="0.14 0.47 0.60 0.6"/>
      <geom size="0.012 0.01 0.025" pos="0.17 0 0.029" mass="0.03" rgba="0.93 0.58 0.16 1"/>
    </body>
  </body></worldbody>
</mujoco>""",
)
BLOCK = ur.Prop(
    name="block",
    mjcf=f"""
<mujoco>
  <worldbody><body><freejoint/>
    <geom type="box" size="0.02 0.02 0.03" mass="{BLOCK_KG}" friction="0.5 0.005 0.0001" rgba="0.85 0.25 0.20 1"/>
  </body></worldbody>
</mujoco>""",
    held=(None, ur.HeldCapsule((0, 0, -0.01), (0, 0, 0.02), 0.03)),
)


@dataclass(frozen=True)
class LidSettings:
    """Settings of LidAndPlace, keywords of `gym.make`.

    Attributes:
        object_range_m: Initial positions of case and block, ± along x and y.
        object_turn_rad: Their initial yaws, ±.
        slam_rad_s: Speed of the closing lid from which an episode fails.
        duration_s: Time of an episode.
    """

    object_range_m: float = 0.02
    object_turn_rad: float = 0.15
    slam_rad_s: float = 1.5
    duration_s: float = 45.0

    def __post_init__(self) -> None:
        ranges = ("object_range_m", 0.0, 0.04), ("object_turn_rad", 0.0, 0.3), ("slam_rad_s", 0.5, 10.0)
        ur.check_numbers(self, *ranges, ("duration_s", 0.1, 1000.0))


class LidFacts(NamedTuple):
    """Facts of one instant on which the stages depend; pairs are of the left arm with the lid, and the right one.

    Attributes:
        grasping: (n, 2) progress of each arm towards holding its object.
        holds: (n, 2) True if the gripper holds its object.
        lid_rad: (n,) angle of the lid.
        off_m: (n,) distance of the block from the middle of the floor of the case.
        inside: (n,) True if the block is within the walls of the case.
        lost: (n,) True if the lid slammed, or the block was dropped, or fell from the table.
    """

    grasping: ur.Array
    holds: ur.Mask
    lid_rad: ur.Array
    off_m: ur.Array
    inside: ur.Mask
    lost: ur.Mask


class LidAndPlace(ur.GraspingTask[LidSettings, LidFacts]):
    """The left arm holds a sprung lid open, the right arm puts a block into the case, and the lid closes gently.

    ## Description

    A case stands on the table, with a lid that a spring closes. The left arm grips the tab of the lid and opens it, and
    holds it while the right arm puts a block of 0.3 kg inside and leaves. Then the left arm closes the lid; one that is
    let go of slams, which fails the episode. One arm alone cannot hold the lid and place the block, and passes no
    stage.

    ## Action Space

    {actions}

    ## Observation Space

    {observations}

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of both arms' parts, which their agents earn. It is 1 once its stage
    is passed, which is never lost, progress until then, and 0 before the stage begins.

    - *grasp* (0.1): passed when the left gripper holds the tab and the right one the block. Each arm: half of the
      nearness of its tool to its grip, 0.2 for closing there, and 0.3 for holding it.
    - *open* (0.2): passed when the lid is open by more than 1.2 rad, with both held. Both: the fraction of that angle.
    - *insert* (0.3): passed when the block lies in the case and the right gripper has left it, while the left one holds
      the lid open. Both: 0.8 of the nearness of the block to the floor of the case while the lid is held open, the rest
      when the block is left there.
    - *close* (0.4): passed when the lid is closed to 0.05 rad over the block, and no gripper holds anything. Both: 0.8
      of the closed fraction of the lid while the block is inside, the rest when the lid is closed.
    - *finish* (1.0): at a step that ends an episode with success, the number of its remaining steps; otherwise 0.

    `info["stage"]` is the number of stages passed in their order, 0 to 4. `info` also holds, without noise, `lid_rad`,
    the angle of the lid, `block_m`, the distance of the block from the middle of the floor of the case, and `force_n`
    (2,), the force on each gripper.

    ## Starting State

    Both arms are at rest at home with open grippers. The case stands at (0, 0.05) m with its x at -35 degrees, its lid
    closed, and the block at (0, -0.3) m, each shifted by up to `object_range_m` along x and y and rotated by up to
    `object_turn_rad`.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "success": all stages were passed, and the lid has been closed over the block for 0.5 s;
    - "lid_slammed": the lid closed faster than `slam_rad_s`;
    - "block_fell": the block was dropped (0.5 m/s), or fell from the table;
    - "refused/<limit>": with `on_refusal="terminate"`, the safety gate refused a motion; see `info["safety"]`;
    - "physics": the simulation diverged (`info["physics_error"]`).

    ### Truncation

    After `duration_s`, 1125 steps with the defaults, with the reason "time". `env.spec.max_episode_steps` is this
    number; no time limit is registered with the id.

    ## Arguments

    {arguments}

    ## Version History

    - v0: first version.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = LidSettings
    per_arm: ClassVar[tuple[str, ...]] = ("force_n",)
    observed = ("case", "block")
    further = (ur.Field("lid_rad", 1, -0.5, 2.0, "angle (rad)", "angle of the lid", "case/lid", concise=(0.5,)),)
    grips = (ur.Grip("case", HOLDING, TAB_M, body="lid"), ur.Grip("block", HELD, BLOCK_M))

    def __init__(self, settings: LidSettings, cell: ur.CellConfig, timing: ur.Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        self.before_rad, self.before_m, self.slammed = np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool)
        ranges = settings.object_range_m, settings.object_turn_rad
        cases = ur.corners(PLACES_M["case"], *ranges, CASE_YAW_RAD)
        taken = ur.compose(ur.corners(PLACES_M["block"], *ranges), HELD)
        placed = ur.compose(ur.compose(cases, ur.pose((ASIDE_M, 0.0, BLOCK_HIGH_M / 2))), HELD)
        tabs = [LidScript.tab(cases, lid_rad) for lid_rad in (0.0, OPENED_RAD)]
        pairs = {"tab and block": (tabs[0], taken), "the open lid and the case": (tabs[1], placed)}
        ur.check_reach(cell, {name: ur.raised(ur.pair(*both), OVER_M) for name, both in pairs.items()})

    @classmethod
    def requirements(cls, settings: LidSettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the case and the block."""
        near = ur.Camera("near", position_m=(0.7, -0.35, 0.55), target_m=(0.0, 0.0, 0.1))
        equipment = ur.Equipment(grippers=True, props=(CASE, BLOCK), cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample the places of case and block; the lid is closed."""
        reach = [self.settings.object_range_m] * 2 + [self.settings.object_turn_rad]
        shift = np.array([rng.uniform(-1.0, 1.0, (2, 3)) for rng in rngs]) * reach
        objects = {}
        for k, (name, yaw_rad) in enumerate((("case", CASE_YAW_RAD), ("block", 0.0))):
            place_m = shift[:, k] * [1.0, 1.0, 0.0] + np.array(PLACES_M[name])
            objects[name] = np.concatenate([place_m, ur.yaw_quat(yaw_rad + shift[:, k, 2])], axis=1)
        self.before_rad[rows], self.before_m[rows] = 0.0, BLOCK_HIGH_M / 2
        return self.start_at_home(rows, objects)

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> LidFacts:
        """Compute the facts of this step."""
        lid_rad, block = state.joints["lid"].copy(), state.objects["block"]
        self.slammed = self.before_rad - lid_rad > self.settings.slam_rad_s * self.timing.period_s
        self.before_rad = lid_rad
        at_m = ur.relative_to(state.objects["case"], block).position_m
        off_m = np.linalg.norm(at_m - [0.0, 0.0, FLOOR_M + BLOCK_HIGH_M / 2], axis=1)
        inside = (np.abs(at_m[:, :2]) < (INNER_M - BLOCK_M) / 2).all(axis=1) & (at_m[:, 2] < HINGE_M[2] - 0.02)
        self.shown = {"force_n": np.linalg.norm(self.forces_n(state), axis=2), "lid_rad": lid_rad, "block_m": off_m}
        height_m = block.position_m[:, 2].copy()
        lost = self.slammed | (height_m < 0.0) | (self.before_m - height_m > DROPPED_M_S * self.timing.period_s)
        self.before_m = height_m
        return LidFacts(self.grasping(measured), measured.holding, lid_rad, off_m, inside, lost)

    def lead(self, state: ur.CellState, measured: ur.Grasped) -> ur.Lead:
        """Return the goals: the lid open, the block above the case, in it, the tool away, and the lid closed."""
        case, block, lid_rad = state.objects["case"], state.objects["block"], state.joints["lid"]
        inside = ur.compose(case, ur.pose((ASIDE_M, 0.0, FLOOR_M + BLOCK_HIGH_M / 2 + DROP_M)))
        aside_m, height_m = np.hypot(*(inside.position_m - block.position_m)[:, :2].T), block.position_m[:, 2]
        opened, left, away = self.passed > 1, self.passed > 2, measured.tools[:, 1, 2] > CARRY_M
        down = opened & (aside_m < 0.015)
        over = (down | opened & (height_m > 0.75 * CARRY_M))[:, None]
        placed = down & (height_m < inside.position_m[:, 2] + 0.004)
        lowered_m = np.where(placed, height_m, inside.position_m[:, 2])
        z_m = np.where(down & ~left, lowered_m, CARRY_M + BLOCK_HIGH_M / 2)
        xy_m = np.where(over, inside.position_m[:, :2], block.position_m[:, :2])
        to = ur.Poses(np.column_stack([xy_m, z_m]), np.where(over, inside.quat, block.quat))
        led = ur.toward(block, to, AHEAD_M, AHEAD_RAD)
        to_rad = np.where(left & away, CLOSED_RAD, OPENED_RAD)
        angle_rad = lid_rad + (to_rad - lid_rad).clip(-CLOSING_RAD, OPENING_RAD)
        turned = ur.quat_from_rotvec(angle_rad[:, None] * [0.0, -1.0, 0.0])
        lid = ur.compose(case, ur.Poses(np.broadcast_to(HINGE_M, (self.n, 3)), turned))
        closed = np.stack([~(left & (lid_rad < 0.6 * SHUT_RAD)), ~(placed | left)], axis=1)
        return ur.Lead(self.bringing(measured, ur.pair(lid, led)), closed)

    @ur.stage(weight=0.1)
    def grasp(self, now: LidFacts) -> tuple[ur.Number, ur.Progress]:
        """Hold the tab of the lid and the block."""
        left, right = now.grasping.T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=(0.0, BLOCK_KG))
    def open(self, now: LidFacts) -> tuple[ur.Number, ur.Progress]:
        """Open the lid."""
        held = now.holds.all(axis=1)
        return held & (now.lid_rad > OPEN_RAD), held * ur.ratio(now.lid_rad / OPEN_RAD)

    @ur.stage(weight=0.3, load_kg=(0.0, BLOCK_KG))
    def insert(self, now: LidFacts) -> tuple[ur.Number, ur.Progress]:
        """Put the block into the case, and leave it there, while the lid is held open."""
        held = now.holds[:, 0] & (now.lid_rad > OPEN_RAD)
        left = now.inside & ~now.holds[:, 1]
        return held & left, held * ur.gaussian(now.off_m, margin=0.3) * (0.8 + 0.2 * left)

    @ur.stage(weight=0.4)
    def close(self, now: LidFacts) -> tuple[ur.Number, ur.Progress]:
        """Close the lid over the block, and let go of it."""
        shut = now.inside & (now.lid_rad < SHUT_RAD)
        return shut & ~now.holds.any(axis=1), now.inside * (0.8 * (1.0 - ur.ratio(now.lid_rad / OPEN_RAD)) + 0.2 * shut)

    def lost(self, now: LidFacts) -> ur.Number:
        """Return the rows whose lid slammed, or whose block was dropped, or fell from the table."""
        return now.lost

    def failure(self, row: int, outcome: ur.Outcome) -> str:
        """Return the name of the failure."""
        return "lid_slammed" if self.slammed[row] else "block_fell"

    def further_values(self, state: ur.CellState, measured: ur.Grasped) -> Mapping[str, ur.Array]:
        """Return the angle of the lid, for both arms."""
        return {"lid_rad": np.repeat(state.joints["lid"][:, None, None], 2, axis=1)}

    def values(self, measured: ur.Grasped) -> dict[str, Any]:
        """Return the values of `info`."""
        return self.shown


AHEAD_M, AHEAD_RAD, OPENING_RAD, CLOSING_RAD = 0.02, 0.06, 0.06, 0.03  # longest steps that the goals show
OVER_M, CARRY_M = 0.1, 0.2  # heights of tools above their grips, and of the carried block
OPENED_RAD, CLOSED_RAD, ASIDE_M, DROP_M = 1.6, 0.01, 0.03, 0.003  # ends of the lid; of the block in the case
OPEN_S, OVER_S, DOWN_S, CLOSE_S, RELEASE = 5.0, 3.5, 3.0, 6.0, 0.3  # times; opening of the right gripper in the case
YIELD_M_S_N, NOISE_N = 1e-3, 4.0  # of the left arm on the arc of the tab
WIDTHS_M = (TAB_M, BLOCK_M)
LEFT = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])


class LidScript(ur.Script):
    """Opens the lid on the arc of its tab, lowers the block into the case, and closes the lid as slowly.

    The arc follows from the measured pose of the case, and the left arm yields to the forces of its errors.
    """

    task = LidAndPlace

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms = ur.Motions(self, fields)
        case, block = arms.pose("case_base", 0.0), arms.pose("block_base", BLOCK_HIGH_M / 2)
        grips = ur.pair(self.tab(case, 0.0), ur.compose(block, HELD))
        yield from arms.move(ur.raised(grips, OVER_M))
        yield from arms.line(grips)
        yield from arms.grip(-1.0, width_m=WIDTHS_M)
        yielding = ur.Admittance(arms, YIELD_M_S_N, NOISE_N)
        inside = ur.compose(case, ur.pose((ASIDE_M, 0.0, FLOOR_M + BLOCK_HIGH_M / 2 + DROP_M)))
        taken, placed = ([*each.position_m, 2.0 * np.arctan(each.quat[3] / each.quat[0])] for each in (block, inside))
        lift = np.array([0.0, 0.0, 0.0, CARRY_M, 0.0])
        at, up = np.array([0.0, *taken]), np.array([OPENED_RAD, *taken]) + lift
        down, shut = np.array([OPENED_RAD, *placed]), np.array([CLOSED_RAD, *taken]) + lift
        for begin, end, time_s in ((at, up, OPEN_S), (up, down + lift, OVER_S), (down + lift, down, DOWN_S)):
            yield from self.lead(yielding, case, begin, end, time_s)
        yield from arms.grip(-1.0, RELEASE, WIDTHS_M)
        for begin, end, time_s in ((down, down + lift, DOWN_S), (down + lift, up, OVER_S), (up, shut, CLOSE_S)):
            yield from self.lead(yielding, case, begin, end, time_s)
        yield from arms.grip(1.0, width_m=WIDTHS_M)
        away_m = np.array([[0.0, 0.0, OVER_M], [0.0, 0.0, 0.0]])
        yield from arms.line(ur.Poses(arms.tools.position_m + away_m, arms.tools.quat))

    def lead(self, yielding: ur.Admittance, case: ur.Poses, begin: ur.Array, end: ur.Array, time_s: float) -> ur.Steps:
        """Move lid and block from rest to rest: angle of the lid, position and yaw of the block, (5,)."""
        steps = int(time_s / self.timing.period_s)
        for ratio in ur.least_jerk(np.arange(1, steps + 1) / steps):
            lid_rad, *position_m, yaw_rad = begin + ratio * (end - begin)
            block = ur.Poses(np.array(position_m), ur.yaw_quat(yaw_rad))
            yield from yielding.step(ur.pair(self.tab(case, lid_rad), ur.compose(block, HELD)), LEFT)

    @staticmethod
    def tab(case: ur.Poses, lid_rad: float) -> ur.Poses:
        """Return the pose of the left tool that holds the tab of a lid at an angle."""
        lid = ur.Poses(HINGE_M, ur.quat_from_rotvec(np.array([0.0, -lid_rad, 0.0])))
        return ur.compose(ur.compose(case, lid), HOLDING)
