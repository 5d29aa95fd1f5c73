"""PegInsertion: the left arm inserts a peg into a plate that the right arm holds. Props, task and scripted policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import dual_ur10.tasks as ur

WIDTH_M, PEG_M, PLATE_M = 0.024, 0.12, 0.02  # side of the peg and width of the handle; length of the peg; thickness
DEPTH_M = 0.03  # of an inserted peg
LOADS_KG = (0.4, 0.25)
STAND_M = {"peg": PEG_M / 2, "plate": PLATE_M / 2}  # heights of their origins on the table
MEETING = ur.pose((0.0, 0.1, 0.2))  # of the plate in the script

# The last 3 mm of the peg taper, so that it finds the hole.
TIP_POINTS = " ".join(f"{x} {y} {z}" for z, r in ((-0.06, 0.009), (-0.057, 0.012)) for x in (-r, r) for y in (-r, r))
PEG = ur.Prop(
    name="peg",
    mjcf=f"""
<mujoco>
  <asset><mesh name="tip" vertex="{TIP_POINTS}"/></asset>
  <default><geom friction="0.2 0.005 0.0001" rgba="0.93 0.58 0.16 1"/></default>
  <worldbody><body><freejoint/>
    <geom type="box" size="0.012 0.012 0.0585" pos="0 0 0.0015" mass="0.39"/>
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
        object_range_m: Initial positions of peg and plate, ± along x and y.
        object_turn_rad: Their initial yaws, ±.
        duration_s: Time of an episode.
    """

    clearance_m: float = 0.001
    object_range_m: float = 0.02
    object_turn_rad: float = 0.15
    duration_s: float = 30.0

    def __post_init__(self) -> None:
        ranges = ("clearance_m", 2e-4, 0.01), ("object_range_m", 0.0, 0.05), ("object_turn_rad", 0.0, 0.5)
        ur.check_numbers(self, *ranges, ("duration_s", 0.1, 1000.0))


class Facts(NamedTuple):
    """Facts of one instant on which the stages depend; pairs are of the left arm with the peg, and the right one.

    Attributes:
        near: (n, 2) nearness of each tool to its grip.
        holds: (n, 2) True if the gripper holds its object.
        lifted: (n, 2) height of each object above where it stood, 1 once it is lifted.
        aside_m: (n,) distance of the tip of the peg from the axis of the hole.
        depth_m: (n,) its depth below the upper face of the plate.
    """

    near: ur.Array
    holds: ur.Mask
    lifted: ur.Array
    aside_m: ur.Array
    depth_m: ur.Array


@ur.register("TwoArm/PegInsertion-v0", scripted="PegScript")
class PegInsertion(ur.GraspingTask[PegSettings, Facts]):
    """Both arms pick up a peg and a plate, and insert the peg into the hole of the plate.

    Success is a peg 30 mm deep in the plate for half a second, with both in their grippers and off the table. So one
    arm alone cannot succeed.
    """

    limits = ur.MotionLimits(speed_rad_s=(1.0,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0)
    settings_type = PegSettings
    observed = ("peg", "plate")
    grips = (
        ur.Grip("peg", ur.pose((0.0, 0.0, 0.035), (0.0, 0.0, 1.0, 0.0)), WIDTH_M),
        ur.Grip("plate", ur.pose((0.0, -0.26, 0.015), (0.0, 1.0, -1.0, 0.0)), WIDTH_M),
    )

    @classmethod
    def requirements(cls, settings: PegSettings) -> ur.SceneRequirements:
        """Return the scene: two grippers, the peg and the plate."""
        near, props = ur.Camera("near", (0.5, 0.4, 0.45), target_m=(0.0, 0.05, 0.2)), (PEG, plate(settings.clearance_m))
        equipment = ur.Equipment(grippers=True, props=props, grip_force_n=200.0, cameras=(near,))
        return ur.SceneRequirements(equipment, timestep_s=0.001, gains=ur.COMPLIANT, closer=ur.PICKING)

    def start(self, rows: ur.Rows, rngs: Sequence[np.random.Generator]) -> ur.Start:
        """Sample where peg and plate stand."""
        reach = [self.settings.object_range_m] * 2 + [self.settings.object_turn_rad]
        shift = np.array([rng.uniform(-1.0, 1.0, (2, 3)) for rng in rngs]) * reach
        objects = {}
        for k, (name, y_m) in enumerate((("peg", 0.4), ("plate", -0.2))):
            place = shift[:, k] * [1.0, 1.0, 0.0] + np.array([0.0, y_m, STAND_M[name]])
            objects[name] = np.concatenate([place, ur.yaw_quat(shift[:, k, 2])], axis=1)
        return self.start_at_home(rows, objects)

    def facts(self, state: ur.CellState, measured: ur.Grasped) -> Facts:
        """Compute the facts of this step."""
        peg, hole = state.objects["peg"], state.objects["plate"]
        at_m = ur.relative_to(hole, ur.compose(peg, ur.pose((0.0, 0.0, -PEG_M / 2)))).position_m
        heights_m = np.stack([state.objects[name].position_m[:, 2] - STAND_M[name] for name in self.observed], axis=1)
        near = ur.gaussian(np.linalg.norm(measured.grip_in_tool_m, axis=2), margin=0.3)
        aside_m, depth_m = np.linalg.norm(at_m[:, :2], axis=1), PLATE_M / 2 - at_m[:, 2]
        self.shown = {"aside_m": aside_m, "depth_m": depth_m}
        return Facts(near, measured.holding, heights_m / 0.1, aside_m, depth_m)

    @ur.stage(weight=0.2)
    def grasp(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Hold both objects."""
        left, right = (0.5 * (now.near + now.holds)).T
        return now.holds.all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG)
    def lift(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Lift both by 10 cm."""
        left, right = ur.ratio(now.holds * now.lifted).T
        return (now.holds & (now.lifted > 1.0)).all(axis=1), (left, right)

    @ur.stage(weight=0.2, load_kg=LOADS_KG)
    def align(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Bring the tip of the peg above the hole."""
        above = (now.depth_m < 0.0) & (now.depth_m > -0.03) & (now.aside_m < 0.005)
        return above, now.holds.all(axis=1) * ur.gaussian(now.aside_m + np.abs(now.depth_m), margin=0.3)

    @ur.stage(weight=0.4, load_kg=LOADS_KG, coupled=True)
    def insert(self, now: Facts) -> tuple[ur.Number, ur.Progress]:
        """Insert the peg, with both objects off the table."""
        held = (now.holds & (now.lifted > 0.5)).all(axis=1) & (now.aside_m < 0.005)
        return held & (now.depth_m > DEPTH_M), held * ur.ratio(now.depth_m / DEPTH_M)

    def lost(self, now: Facts) -> ur.Number:
        """Return the rows in which an object fell from the table."""
        return (now.lifted < -0.5).any(axis=1)

    def values(self, measured: ur.Grasped) -> dict[str, ur.Array]:
        """Return the values of `info`."""
        return self.shown


START_M, INSERT_M_S = 0.008, 0.015  # height of the tip above the plate before the insertion, and its speed
SEARCH_N, ENTERED_M = 5.0, 0.004  # force at which the tip is beside the hole, and depth at which it is in it
SEARCH_RAD_S, SEARCH_M_RAD = 1.5, 0.0007  # of the spiral on which it searches the hole
YIELD_M_S_N, NOISE_N, FORCE_FILTER = 1e-3, 2.0, 0.4  # speed for a force from the side, and forces that do not count


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
        yield from arms.grip(-1.0)
        yield from arms.line(ur.raised(grips, 0.16))
        yield from arms.line(ur.pair(ur.compose(ur.raised(MEETING, 0.1), peg), ur.compose(MEETING, plate)))
        for _ in range(int(2.0 / period_s)):
            moved_m = np.array([self.hole(arms) + np.array([0.0, 0.0, START_M]), np.zeros(3)])
            yield from arms.follow(ur.Poses(arms.tools.position_m + moved_m, arms.tools.quat))
        tools, searched_s, yielded_m, down_m, push_n = arms.tools, 0.0, np.zeros(2), 0.0, np.zeros(3)
        while True:
            push_n = push_n + FORCE_FILTER * (arms.force_n()[0] - push_n)
            entered = self.hole(arms)[2] > ENTERED_M
            if push_n[2] < SEARCH_N or entered:
                down_m = min(down_m + INSERT_M_S * period_s, START_M + DEPTH_M + 0.01)
            else:
                searched_s += period_s
            if entered:
                yielded_m += YIELD_M_S_N * period_s * (push_n[:2] - np.clip(push_n[:2], -NOISE_N, NOISE_N))
            angle = SEARCH_RAD_S * searched_s
            aside_m = yielded_m + SEARCH_M_RAD * angle * np.array([np.cos(angle), np.sin(angle)])
            moved_m = np.array([[*aside_m, -down_m], [0.0, 0.0, 0.0]])
            yield from arms.step(ur.Poses(tools.position_m + moved_m, tools.quat))

    def hole(self, arms: ur.Motions) -> ur.Array:
        """Return the path from the tip of the peg to the hole, whose z is the depth of the tip, (3,)."""
        path_m: ur.Array = arms.pose("plate_base").position_m - arms.pose("peg_base").position_m
        path_m[2] += (PLATE_M + PEG_M) / 2
        return path_m
