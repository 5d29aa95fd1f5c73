"""Collision model of a cell: a MuJoCo model of shapes and pairs, without contacts, with one distance sensor per pair.

The safety gate's kernel takes the shapes and pairs from it and measures by itself; the sensors check it in tests.

Nothing reports to the safety gate whether a gripper holds a prop. So each gripper carries the payload geometry of each
prop, `Prop.held`, all the time: the prop where it should be gripped, and of the bar, which both grippers hold, the part
up to its middle. An empty gripper keeps the same distances. The table, on which props lie, is left out: a gripper
that comes to take a prop, and is not level, would be refused for an object that it does not hold yet.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.assets.cell_spec import add_obstacles, attach_arm, cell_spec, compiled, joint_names
from dual_ur10.assets.gripper import add_rigid_gripper
from dual_ur10.assets.obstacles import geom_name
from dual_ur10.assets.prop import HeldCapsule
from dual_ur10.assets.settings import Equipment, SceneSettings
from ur_core.kinematics.ur10 import ARMS, LINKS
from ur_core.mjcf.arm import arm_spec, remove_visuals
from ur_core.types import Array

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

CLEARANCE_CUTOFF_M: Final = 0.2
"""Distances beyond this read as this."""

HULL: Final = ":hull"
"""End of the name of a box's hull."""

HELD: Final = "held_"
"""Begin of the name of an arm's payload geometry, which the prop's name follows."""

# What it can meet: the other arm but for its fingers, which take it, and those parts of its own that can get there.
_PAYLOAD_MEETS_OTHER: Final = ("base_link", *LINKS, "palm")
_PAYLOAD_MEETS_OWN: Final = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link")

# Which parts of one arm can meet. Joints 2, 3 and 4 are parallel, so wrists 1 and 2 always pass base and shoulder
# sideways; ur10.xml filters their contacts.
_OWN: Final = {
    "forearm_link": ("base_link", "shoulder_link"),
    "wrist_1_link": ("upper_arm_link",),
    "wrist_2_link": ("upper_arm_link",),
    "wrist_3_link": ("base_link", "shoulder_link", "upper_arm_link", "forearm_link"),
}


_GRIPPER: Final = ("palm", "fingers")
# Both are fixed to wrist 3, and no configuration brings one to the other wrists of its arm.
_OWN_OF_GRIPPER: Final = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link")


def _pairs() -> tuple[tuple[str, str], ...]:
    moving = LINKS[1:]
    pairs = [(f"left/{a}", f"right/{b}") for a in moving for b in moving]
    for arm, other_arm in (ARMS, ARMS[::-1]):
        pairs += [(f"{arm}/{link}", f"{other_arm}/{other}") for link in moving for other in ("base_link", LINKS[0])]
        pairs += [(f"{arm}/{link}", ground) for link in moving for ground in ("table", "floor")]
        pairs += [(f"{arm}/{link}", f"{arm}/{other}") for link, others in _OWN.items() for other in others]
    return tuple(pairs)


def _gripper_pairs() -> tuple[tuple[str, str], ...]:
    pairs = [(f"left/{a}", f"right/{b}") for a in _GRIPPER for b in _GRIPPER]
    for arm, other_arm in (ARMS, ARMS[::-1]):
        for part in _GRIPPER:
            pairs += [(f"{arm}/{part}", f"{other_arm}/{other}") for other in ("base_link", *LINKS)]
            pairs += [(f"{arm}/{part}", ground) for ground in ("table", "floor")]
            pairs += [(f"{arm}/{part}", f"{arm}/{other}") for other in _OWN_OF_GRIPPER]
    return tuple(pairs)


CLEARANCE_PAIRS: Final = _pairs()
"""Geom names of each distance sensor of the bare cell's collision model, in sensor order."""

_WITH_GRIPPERS: Final = CLEARANCE_PAIRS + _gripper_pairs()


def payload(settings: SceneSettings, arm: int) -> dict[str, HeldCapsule]:
    """Return the payload geometry of an arm by the name of its geom, without the prefix of the arm.

    Args:
        settings: Settings of the cell.
        arm: Index of the arm in `ARMS`.
    """
    if not settings.equipment.grippers:
        return {}
    held = ((prop.name, prop.held[arm]) for prop in settings.equipment.props)
    return {f"{HELD}{name}": capsule for name, capsule in held if capsule is not None}


def payload_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    """Return the pairs of the collision model that the payload geometry adds."""
    return tuple(
        pair
        for k, (arm, other) in enumerate((ARMS, ARMS[::-1]))
        for held in payload(settings, k)
        for pair in (
            *((f"{arm}/{held}", f"{other}/{part}") for part in _PAYLOAD_MEETS_OTHER),
            *((f"{arm}/{held}", f"{arm}/{part}") for part in _PAYLOAD_MEETS_OWN),
            (f"{arm}/{held}", "floor"),
        )
    )


def _obstacle_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    parts = (*LINKS, *_GRIPPER) if settings.equipment.grippers else LINKS
    return tuple(
        (f"{arm}/{part}", geom_name(each))
        for each in settings.obstacles
        for k, arm in enumerate(ARMS)
        for part in (*parts, *payload(settings, k))
    )


# A capsule against a box's hull costs up to thirteen times as much as any other pair, a sphere against a box as much as
# the others. The wrists' capsules are nearly spheres, so that the spheres around them stand in for them at boxes. The
# fingers are a box only where they come near on purpose: to what is flat, and to the other gripper.
_ROUND: Final = LINKS[3:]


def clearance_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    """Return the geom names of each distance sensor of the collision model, in sensor order.

    The pairs are all that can meet: each moving link with the other arm, the table and the floor, and the forearm and
    the wrists with those parts of their own arm that they can reach. Grippers add their `palm` and `fingers` with all
    of these. A prop adds each arm's payload geometry `held_<prop>` with all that it can meet, except the table and the
    other gripper's fingers. Obstacles add, last, each of these parts with each obstacle. The prop itself is not
    measured.

    Args:
        settings: the cell.
    """
    pairs = _WITH_GRIPPERS if settings.equipment.grippers else CLEARANCE_PAIRS
    pairs = pairs + payload_pairs(settings) if settings.equipment.props else pairs
    return pairs + _obstacle_pairs(settings) if settings.obstacles else pairs


def compose_collision_model(settings: SceneSettings) -> Any:
    """Return a fresh `MjSpec` of the cell's collision model.

    It has the arms' joints in the cell's order and no visuals, contacts, actuators or gravity, so that one `forward` up
    to the position stage gives all distances. Sensor i is the signed distance in m of the collision geoms
    `clearance_pairs(settings)[i]`, negative when they overlap, at most `CLEARANCE_CUTOFF_M`. From the wrists to the
    table and to boxes it is that of the spheres around their capsules: never more than the capsules' own distance, and
    up to 12.5 mm less where a wrist lies across. The fingers are the box that holds both at any opening; to all but the
    table, boxes, planes and the other gripper it is the capsule around this box, up to 36 mm nearer. A gripper has its
    whole mass, with its fingers half open.

    Args:
        settings: Settings of the cell; `gains` and `meshes` have no effect.
    """
    import mujoco

    spec = cell_spec(settings)
    spec.compiler.fusestatic = True
    for name, mount, tool in zip(ARMS, settings.mounts, settings.equipment.tools, strict=True):
        arm = arm_spec(mount.dh, settings.gains)
        remove_visuals(arm)
        if settings.equipment.grippers:
            add_rigid_gripper(arm, tool)
        _add_balls(arm)
        for geom, capsule in payload(settings, ARMS.index(name)).items():
            add_payload_geometry(arm.body("gripper"), geom, capsule, tool.tcp_m)
        for unused in (*arm.actuators, *arm.excludes):
            arm.delete(unused)
        attach_arm(spec, arm, name, mount)
    bits = mujoco.mjtDisableBit
    spec.option.disableflags |= (
        bits.mjDSBL_CONTACT | bits.mjDSBL_GRAVITY | bits.mjDSBL_CONSTRAINT | bits.mjDSBL_ACTUATION
    )
    add_obstacles(spec, settings.obstacles)
    add_hulls(spec)
    shapes = {"table": "box"} | {geom_name(each): each.kind for each in settings.obstacles}
    for geom1, geom2 in clearance_pairs(settings):
        first, second = _measured(geom1, geom2, shapes)
        spec.add_sensor(
            name=f"{geom1}:{geom2}",
            type=mujoco.mjtSensor.mjSENS_GEOMDIST,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=first,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=second,
            cutoff=CLEARANCE_CUTOFF_M,
        )
    return spec


def build_collision_model(settings: SceneSettings) -> mujoco.MjModel:
    """Return a fresh collision model of the cell.

    Args:
        settings: Settings of the cell.

    Returns:
        The compiled model; its `sensordata` has one distance per pair of `clearance_pairs(settings)`.
    """
    return copy.copy(_model(settings))  # compiling takes ten times as long


@lru_cache(maxsize=16)
def _model(settings: SceneSettings) -> mujoco.MjModel:
    bare = replace(settings, equipment=Equipment())
    return compiled(compose_collision_model(settings), joint_names(bare), ())


def hull_name(box: str) -> str:
    """Return the name of a box's hull in a collision model. No obstacle can have this name."""
    return box + HULL


def add_hulls(spec: Any) -> None:
    """Give every box of the world a second geom of the same shape, a mesh.

    MuJoCo's own distance of a capsule from a box is wrong where the capsule's line pierces it: a link that pierces a
    plate may read as clear of it. The distance from a mesh, which MuJoCo computes differently, is right everywhere. To
    the kernel both are the box.

    Args:
        spec: Spec of a collision model.
    """
    import mujoco

    for box in [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_BOX]:
        name = hull_name(box.name)
        corners = itertools.product(*((-half, half) for half in box.size.tolist()))
        spec.add_mesh(name=name, uservert=[*itertools.chain(*corners)])
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=box.pos, quat=box.quat)


def add_payload_geometry(gripper: Any, name: str, capsule: HeldCapsule, tcp_m: float) -> None:
    """Add payload geometry to a gripper's body, without a mass: that of the body is explicit.

    Args:
        gripper: Body of a gripper in an arm's spec.
        name: Name of the geom.
        capsule: Its shape, in the frame of the tool centre point.
        tcp_m: Distance of the tool centre point from the flange.
    """
    import mujoco

    fromto = [x + shift for end in (capsule.from_m, capsule.to_m) for x, shift in zip(end, (0, 0, tcp_m), strict=True)]
    gripper.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=fromto, size=(capsule.radius_m, 0, 0))


def _ball(name: str) -> str:
    return f"{name}_ball"


def _measured(geom: str, other: str, shapes: Mapping[str, str]) -> tuple[str, str]:
    """Return the geoms that are measured for a pair.

    Args:
        geom: Part of an arm.
        other: Part of an arm, or a geom of the cell.
        shapes: Shapes of all boxes and obstacles by name.
    """
    (part, part2), shape = (each.split("/")[-1] for each in (geom, other)), shapes.get(other)
    if shape is None:
        return _without_corners(geom, part2), _without_corners(other, part)
    if part == "fingers":
        return (f"{geom}_round" if shape == "capsule" else geom), other
    if shape != "box":
        return geom, other
    return (_ball(geom), other) if part in _ROUND else (geom, hull_name(other))


def _without_corners(geom: str, other_part: str) -> str:
    """Return the fingers' capsule in place of their box, except to the other gripper."""
    return f"{geom}_round" if geom.endswith("/fingers") and other_part not in _GRIPPER else geom


def _add_balls(arm: Any) -> None:
    """Put the smallest sphere around each wrist's capsule."""
    import mujoco

    for name in _ROUND:
        geom = arm.geom(name)
        first, last = np.reshape(geom.fromto, (2, 3))
        radius = float(geom.size[0] + np.linalg.norm(last - first) / 2)
        geom.parent.add_geom(
            name=_ball(name), type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(radius, 0, 0), pos=(first + last) / 2
        )


def reach_m(model: mujoco.MjModel, settings: SceneSettings, geom: int) -> tuple[int, float]:
    """Return the arm that a geom is part of, and a bound on the distance of its points from the arm's base.

    The bound is the length of the chain of bodies up to the geom, stretched out in a line: up to a fifth more than the
    joints allow.

    Args:
        model: A collision model.
        settings: Settings of the cell.
        geom: Index of the geom.

    Returns:
        Its row in `ARMS` and the bound in m; -1 and 0 for a geom that is part of no arm.
    """
    for arm, mount in enumerate(settings.mounts):
        if model.geom(geom).name.startswith(f"{ARMS[arm]}/"):
            # The bases are parts of the world here, so geoms fixed to them are given in the cell frame.
            chain: list[Any] = [model.geom_pos[geom]]
            body = int(model.geom_bodyid[geom])
            while body != 0:
                chain.append(model.body_pos[body])
                body = int(model.body_parentid[body])
            chain[-1] = chain[-1] - np.asarray(mount.position_m)
            return arm, float(sum(map(np.linalg.norm, chain)) + model.geom_rbound[geom])
    return -1, 0.0


def levers_m(model: mujoco.MjModel) -> Array:
    """Return bounds on the change of each distance sensor's reading per rad of each joint, (sensors, joints).

    A joint moves a point by at most its distance from the joint's axis. Its bound is the distance of the next body from
    the axis plus the length of the chain of bodies from there on, stretched out in a line. The distance of two geoms
    that a joint moves together does not change. The radius of a capsule or a sphere has no effect: a surface of
    revolution does not move when it rotates about its own axis.

    Args:
        model: A collision model.
    """
    levers = np.full((model.ngeom, model.njnt), np.nan)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        hops, beyond = _core_m(model, geom)
        while body != 0:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            for joint in range(first, first + count):
                away = np.cross(model.jnt_axis[joint], hops - model.jnt_pos[joint])
                levers[geom, joint] = np.linalg.norm(away, axis=1).max() + beyond
            beyond += float(np.linalg.norm(hops, axis=1).max())
            hops = model.body_pos[body][None]
            body = int(model.body_parentid[body])
    moves = np.isfinite(levers)
    levers[~moves] = 0.0
    first_of, second_of = model.sensor_objid, model.sensor_refid
    return np.where(moves[first_of] & moves[second_of], 0.0, levers[first_of] + levers[second_of])


def _core_m(model: mujoco.MjModel, geom: int) -> tuple[Array, float]:
    """Return points of a geom in its body's frame, (k, 3), and the largest distance of the geom from the nearest."""
    import mujoco

    middle, kind = model.geom_pos[geom], int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return middle[None], 0.0
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        along = rotation.reshape(3, 3)[:, 2] * model.geom_size[geom][1]
        return np.stack([middle - along, middle + along]), 0.0
    return middle[None], float(model.geom_rbound[geom])
