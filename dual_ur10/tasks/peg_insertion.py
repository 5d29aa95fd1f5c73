"""PegInsertion: the left arm inserts a peg into a plate that the right arm holds. Props, task and scripted policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

import dual_ur10.tasks as ur

WIDTH_M, PEG_M, PLATE_M = 0.024, 0.12, 0.02  # side of the peg and width of the handle; length of the peg; thickness
DEPTH_M = 0.03  # of an inserted peg
LOADS_KG = (0.4, 0.25)
STAND_M = {"peg": PEG_M / 2, "plate": PLATE_M / 2}  # heights of their origins on the table
PLACES_M = {"peg": 0.4, "plate": -0.2}  # y where they stand
MEETING = ur.pose((0.0, 0.1, 0.2))  # of the plate in the script
LEAST_M = 3e-4  # clearance: 0.15 mm on each side, the RMS distance of the left flange from its command


def peg(chamfer_m: float) -> ur.Prop:
    """Return a square peg whose tip tapers by the chamfer, so that it finds the hole."""
    low, top = -PEG_M / 2, -PEG_M / 2 + chamfer_m
    ends = (low, WIDTH_M / 2 - chamfer_m), (top, WIDTH_M / 2)
    points = " ".join(f"{x} {y} {z}" for z, r in ends for x in (-r, r) for y in (-r, r))
    half = (PEG_M - chamfer_m) / 2
    return ur.Prop(
        name="peg",
        mjcf=f"""
<mujoco>
  <asset><mesh name="tip" vertex="{points}"/></asset>
  <default><geom friction="0.2 0.005 0.0001" rgba="0.93 0.58 0.16 1"/></default>
  <worldbody><body><freejoint/>
    <geom type="box" size="0.012 0.012 {half}" pos="0 0 {chamfer_m / 2}" mass="0.39"/>
    <geom type="mesh" mesh="tip" mass="0.01"/>
  </body></worldbody>
</mujoco>""",
        held=(ur.HeldCapsule((0, 0, -0.02), (0, 0, 0.09), 0.017), None),
    )


def plate(clearance_m: float) -> ur.Prop:
    """Return a plate with a square hole, wider than the peg by the clearance, on a handle along -y."""
    hole = (WIDTH_M + clearance_m) / 2
    middle, half = (hole + 0.05) / 2, (0.05 - hole) / 2
    return ur.Prop(
        name="plate",
        mjcf=f"""
<mujoco>
  <default><geom type="box" friction="0.2 0.005 0.0001" rgba="0.14 0.47 0.60 1" mass="0.03"/></default>
  <worldbody><body><freejoint/>
    <geom size="{half} 0.05 0.01" pos="{middle} 0 0"/>
    <geom size="{half} 0.05 0.01" pos="{-middle} 0 0"/>
    <geom size="{hole} {half} 0.01" pos="0 {middle} 0"/>
    <geom size="{hole} {half} 0.01" pos="0 {-middle} 0"/>
    <geom size="0.012 0.125 0.02" pos="0 -0.175 0.01" mass="0.13"/>
  </body></worldbody>
</mujoco>""",
        held=(None, ur.HeldCapsule((0, 0, 0), (-0.26, 0, 0), 0.03)),
    )


@dataclass(frozen=True)
class PegSettings:
    """Settings of PegInsertion, keywords of `gym.make`.

    Attributes:
        clearance_m: Width of the hole minus that of the peg.
        chamfer_m: Height and depth of the chamfer at the tip of the peg.
        object_range_m: Initial positions of peg and plate, ± along x and y.
        object_turn_rad: Their initial yaws, ±.
        duration_s: Time of an episode.
    """

    clearance_m: float = 0.001
    chamfer_m: float = 0.003
    object_range_m: float = 0.02
    object_turn_rad: float = 0.15
    duration_s: float = 30.0

    def __post_init__(self) -> None:
        ranges = ("object_range_m", 0.0, 0.05), ("object_turn_rad", 0.0, 0.5), ("duration_s", 0.1, 1000.0)
        ur.check_numbers(self, ("clearance_m", -1.0, 0.01), ("chamfer_m", 5e-4, 0.005), *ranges)
        if self.clearance_m < LEAST_M:
            raise ur.SettingsError(
                f"clearance_m is {self.clearance_m:g}: a peg does not enter a hole that is less than {LEAST_M:g} m "
                "wider. Use 0.0005"
            )


class PegFacts(NamedTuple):
    """Facts of one instant on which the stages depend; pairs are of the left arm with the peg, and the right one.

    Attributes:
        grasping: (n, 2) progress of each arm towards holding its object.
        holds: (n, 2) True if the gripper holds its object.
        lifted: (n, 2) height of each object above where it stood, 1 once it is lifted.
        aside_m: (n,) distance of the tip of the peg from the axis of the hole.
        depth_m: (n,) its depth below the upper face of the plate.
        through: (n,) True if the peg is along the axis of the hole, and its other end above the plate.
    """

    grasping: ur.Array
    holds: ur.Mask
    lifted: ur.Array
    aside_m: ur.Array
    depth_m: ur.Array
    through: ur.Mask


class PegInsertion(ur.GraspingTask[PegSettings, PegFacts]):
    """Both arms pick up a peg and a plate, and insert the peg into the hole of the plate.

    ## Description

    The left arm picks up a square peg of 24 mm and 0.4 kg, the right arm a plate of 0.25 kg by its handle, and they
    insert the peg in the air. The hole is wider than the peg by `clearance_m`. What one arm holds the other cannot
    reach, and a plate on the table has nothing below its hole: one arm alone passes no stage.

    ## Action Space

    {actions}

    ## Observation Space

    {observations}

    ## Rewards

    The reward is the weighted sum of one term for each stage, between 0 and 1, and one for the end; each raw term is in
    `info` as `reward/<term>`. A term is the mean of both arms' parts, which their agents earn. It is 1 once its stage
    is passed, which is never lost, progress until then, and 0 before the stage begins.

    - *grasp* (0.2): passed when both grippers hold their objects. Each arm: half of the nearness of its tool to its
      grip, 0.2 for closing there, and 0.3 for holding it.
    - *lift* (0.2): passed when both are held and 10 cm higher than where they stood. Each arm: the fraction of that.
    - *align* (0.2): passed when the tip of the peg is less than 30 mm from the upper face of the plate and 5 mm from
      the axis of the hole. Both: nearness of the tip to the hole, while both are held.
    - *insert* (0.4): passed when the tip is 30 mm below the upper face of the plate on the axis of the hole, the other
      end above it, and both held, off the table. Both: the fraction of that depth.
    - *finish* (1.0): at a step that ends an episode with success, the number of its remaining steps; otherwise 0.

    `info["stage"]` is the number of stages passed in their order, 0 to 4. `info` also holds, without noise, `aside_m`,
    the distance of the tip from the axis of the hole, `depth_m`, its depth below the upper face of the plate, and
    `force_n` (2,), the force on each gripper.

    ## Starting State

    Both arms are at rest at home with open grippers. The peg stands at (0, 0.4) m and the plate lies at (0, -0.2) m,
    each shifted by up to `object_range_m` along x and y and rotated by up to `object_turn_rad`.

    ## Episode End

    ### Termination

    `info["end_reason"]` is

    - "success": the peg has been inserted for 0.5 s;
    - "object_fell": peg or plate fell from the table;
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
    settings_type = PegSettings
    per_arm: ClassVar[tuple[str, ...]] = ("force_n",)
    observed = ("peg", "plate")
    grips = (
        ur.Grip("peg", ur.pose((0.0, 0.0, 0.035), (0.0, 0.0, 1.0, 0.0)), WIDTH_M),
        ur.Grip("plate", ur.pose((0.0, -0.26, 0.015), (0.0, 1.0, -1.0, 0.0)), WIDTH_M),
    )

    def __init__(self, settings: PegSettings, cell: ur.CellConfig, timing: ur.Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        self.searched_s = np.zeros(n)
        held = [grip.tool for grip in self.grips]
        ranges = settings.object_range_m, settings.object_turn_rad
        lying = (ur.corners((0.0, PLACES_M[name], STAND_M[name]), *ranges) for name in self.observed)
        grips = ur.pair(*map(ur.compose, lying, held))
        meeting = ur.pair(*map(ur.compose, (ur.raised(MEETING, 0.1), MEETING), held))
        meeting = ur.Poses(*(part[None] for part in meeting))
        ur.check_reach(cell, {"its grip": grips, "the lifted grip": ur.raised(grips, 0.16), "the hole": meeting})

    @classmethod
    def requirements(cls, settings: PegSettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the peg and the plate."""
        near = ur.Camera("near", position_m=(0.85, 0.25, 0.7), target_m=(-0.05, 0.0, 0.12))
        props = peg(settings.chamfer_m), plate(settings.clearance_m)
        equipment = ur.Equipment(grippers=True, props=props, grip_force_n=200.0, cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample where peg and plate stand."""
        reach = [self.settings.object_range_m] * 2 + [self.settings.object_turn_rad]
        shift = np.array([rng.uniform(-1.0, 1.0, (2, 3)) for rng in rngs]) * reach
        objects = {}
        for k, name in enumerate(self.observed):
            place = shift[:, k] * [1.0, 1.0, 0.0] + np.array([0.0, PLACES_M[name], STAND_M[name]])
            objects[name] = np.concatenate([place, ur.yaw_quat(shift[:, k, 2])], axis=1)
        self.searched_s[rows] = 0.0
        return self.start_at_home(rows, objects)

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> PegFacts:
        """Compute the facts of this step."""
        peg, hole = state.objects["peg"], state.objects["plate"]
        at_m, quat = ur.relative_to(hole, ur.compose(peg, ur.pose((0.0, 0.0, -PEG_M / 2))))
        heights_m = np.stack([state.objects[name].position_m[:, 2] - STAND_M[name] for name in self.observed], axis=1)
        aside_m, depth_m = np.linalg.norm(at_m[:, :2], axis=1), PLATE_M / 2 - at_m[:, 2]
        force_n = np.linalg.norm(self.forces_n(state), axis=2)
        self.shown = {"force_n": force_n, "aside_m": aside_m, "depth_m": depth_m}
        through = (ur.rotate(quat, [0.0, 0.0, 1.0])[:, 2] > 0.9) & (depth_m < PEG_M - PLATE_M)
        return PegFacts(self.grasping(measured), measured.holding, heights_m / 0.1, aside_m, depth_m, through)

    def lead(self, state: ur.CellState, measured: ur.Grasped) -> ur.Lead:
        """Return the goals: both up, the plate to the meeting and the peg above it, and the peg along the hole."""
        peg, plate = (state.objects[name] for name in self.observed)
        up = [ur.Poses(np.where([True, True, False], each.position_m, LIFT_M), each.quat) for each in (peg, plate)]
        meeting = ur.Poses(*(np.broadcast_to(part, (self.n, len(part))) for part in MEETING))
        met = np.linalg.norm(plate.position_m - MEETING.position_m, axis=1) < 0.01
        at_m = ur.relative_to(plate, peg).position_m - [0.0, 0.0, (PLATE_M + PEG_M) / 2]
        aside_m = np.linalg.norm(at_m[:, :2], axis=1)
        entered = at_m[:, 2] < -2.0 * ENTERED_M
        self.searched_s += self.elapsed_s * ((self.passed > 2) & (at_m[:, 2] < ENTERED_M) & ~entered)
        inside = met & (self.passed > 2) & ((aside_m < ASIDE_M) | (self.searched_s > 0.0))
        pushed_m = np.maximum(at_m[:, 2] - PUSH_M, -DEPTH_M - 0.01)
        height_m = np.select([inside, met & (aside_m < 0.02)], [pushed_m, START_M], 0.1) + (PLATE_M + PEG_M) / 2
        x_m, y_m = np.where(entered, at_m[:, :2].T, spiral_m(self.searched_s))
        over = ur.compose(plate, ur.Poses(np.stack([x_m, y_m, height_m], axis=1), ur.yaw_quat(np.zeros(self.n))))
        lifted, both = self.passed[:, None] > 1, ((over, up[0]), (meeting, up[1]))
        goals = [ur.Poses(*(np.where(lifted, *parts) for parts in zip(*pair, strict=True))) for pair in both]
        led = ur.toward(ur.pair(peg, plate), ur.pair(*goals), AHEAD_M, AHEAD_RAD)
        return ur.Lead(self.bringing(measured, led), np.ones((self.n, 2), dtype=bool))

    @ur.stage(weight=0.2)
    def grasp(self, now: PegFacts) -> tuple[ur.Number, ur.Progress]:
        """Hold both objects."""
        left, right = now.grasping.T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG)
    def lift(self, now: PegFacts) -> tuple[ur.Number, ur.Progress]:
        """Lift both by 10 cm."""
        left, right = ur.ratio(now.holds * now.lifted).T
        return (now.holds & (now.lifted > 1.0)).all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG)
    def align(self, now: PegFacts) -> tuple[ur.Number, ur.Progress]:
        """Bring the tip of the peg above the hole."""
        near = (np.abs(now.depth_m) < 0.03) & (now.aside_m < 0.005)
        return near, now.holds.all(axis=1) * ur.gaussian(now.aside_m + np.abs(now.depth_m), margin=0.3)

    @ur.stage(weight=0.4, load_kg=LOADS_KG, coupled=True)
    def insert(self, now: PegFacts) -> tuple[ur.Number, ur.Progress]:
        """Insert the peg, with both objects off the table."""
        held = (now.holds & (now.lifted > 0.5)).all(axis=1) & now.through & (now.aside_m < 0.005)
        return held & (now.depth_m > DEPTH_M), held * ur.ratio(now.depth_m / DEPTH_M)

    def lost(self, now: PegFacts) -> ur.Number:
        """Return the rows in which an object fell from the table."""
        return (now.lifted < -0.5).any(axis=1)

    def failure(self, row: int, outcome: ur.Outcome) -> str:
        """Return the name of the failure."""
        return "object_fell"

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


LIFT_M, ASIDE_M = 0.2, 0.0015  # height of lifted objects; of the tip from the axis, from which it is lowered
AHEAD_M, PUSH_M, AHEAD_RAD = 0.02, 0.004, 0.06  # longest steps of objects that the goals show
START_M, INSERT_M_S = 0.008, 0.015  # height of the tip above the plate before the insertion, and its speed
SEARCH_N, ENTERED_M = 5.0, 0.004  # force at which the tip is beside the hole; depth below there at which it is in it
SEARCH_RAD_S, SEARCH_M, SEARCH_S = 1.5, 0.008, 12.0  # of the spiral on which it searches the hole, and back
CAUGHT_N = 6.0  # force from the side of a tip at the edge of the hole, at which the search waits
YIELD_M_S_N, NOISE_N = 1e-3, 2.0  # speed for the error of a force, and errors that do not count
PUSHING_N = np.array([[0.0, 0.0, -SEARCH_N], [0.0, 0.0, 0.0]])


def spiral_m(searched_s: ur.Number | float) -> ur.Array:
    """Return the place on the spiral after times of search, (2, …)."""
    radius_m = SEARCH_M * np.sin(0.5 * np.pi * np.asarray(searched_s) / SEARCH_S)
    turned_rad = SEARCH_RAD_S * np.asarray(searched_s)
    return np.array([radius_m * np.cos(turned_rad), radius_m * np.sin(turned_rad)])


class PegScript(ur.Script):
    """Picks up both objects, aligns them by their measured poses, and inserts the peg by the forces on it."""

    task = PegInsertion

    def script(self, fields: ur.Fields) -> ur.Steps:
        """Move both arms through one episode."""
        arms, period_s = ur.Motions(self, fields), self.timing.period_s
        peg, plate = (grip.tool for grip in PegInsertion.grips)
        places = (arms.pose(f"{name}_base", height_m) for name, height_m in STAND_M.items())
        grips = ur.pair(*map(ur.compose, places, (peg, plate)))
        yield from arms.move(ur.raised(grips, 0.1))
        yield from arms.line(grips)
        yield from arms.grip(-1.0, width_m=(WIDTH_M, WIDTH_M))
        yield from arms.line(ur.raised(grips, 0.16))
        yield from arms.line(ur.pair(ur.compose(ur.raised(MEETING, 0.1), peg), ur.compose(MEETING, plate)))
        for _ in range(int(2.0 / period_s)):
            moved_m = np.array([self.hole(arms) + np.array([0.0, 0.0, START_M]), np.zeros(3)])
            yield from arms.follow(ur.Poses(arms.tools.position_m + moved_m, arms.tools.quat))
        yielding, tools = ur.Admittance(arms, YIELD_M_S_N, NOISE_N), arms.tools
        searched_s, down_m, touched_m = 0.0, 0.0, np.inf
        while True:
            depth_m, touches = self.hole(arms)[2], -yielding.force_n[0, 2] > SEARCH_N
            touched_m = min(touched_m, depth_m) if touches else touched_m
            entered = depth_m > touched_m + ENTERED_M
            if entered or not touches:
                down_m = min(down_m + INSERT_M_S * period_s, START_M + DEPTH_M + 0.02)
            elif np.hypot(*yielding.force_n[0, :2]) < CAUGHT_N:
                searched_s += period_s
            moved_m = np.array([[*spiral_m(searched_s), -down_m], [0.0, 0.0, 0.0]])
            free = np.array([[1.0, 1.0, not entered], [0.0, 0.0, 0.0]])
            yield from yielding.step(ur.Poses(tools.position_m + moved_m, tools.quat), free, PUSHING_N)

    def hole(self, arms: ur.Motions) -> ur.Array:
        """Return the path from the tip of the peg to the hole, whose z is the depth of the tip, (3,)."""
        path_m: ur.Array = arms.pose("plate_base").position_m - arms.pose("peg_base").position_m
        path_m[2] += (PLATE_M + PEG_M) / 2
        return path_m
