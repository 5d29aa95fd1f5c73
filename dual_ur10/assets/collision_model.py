"""The cell's contact-free twin, which only measures distances: capsules, table and floor, one sensor per pair."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.assets.arm import strip
from dual_ur10.assets.cell_tree import (
    add_obstacles,
    cell_tree,
    child_of,
    compiled,
    document_of,
    joint_names,
    text_of,
    xml_numbers,
)
from dual_ur10.assets.gripper import TCP_M
from dual_ur10.assets.obstacles import geom_name
from dual_ur10.assets.props import BAR_LENGTH_M, BAR_WIDTH_M, BLOCK_GRIP_M, BLOCK_SIZE_M, GRIP_DISTANCE_M
from dual_ur10.assets.settings import Equipment, SceneSettings
from dual_ur10.kinematics.ur10 import ARMS, LINKS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

CLEARANCE_CUTOFF_M: Final = 0.2
"""Distances beyond this read as this."""

HELD: Final = "held"
"""Name of the geom of each arm: a capsule in the prop, of its width. Its edges stand out by 8 mm."""

# What it can meet: the other arm but for its fingers, which take it, and those parts of its own that can get there.
_PAYLOAD_MEETS_OTHER: Final = ("base_link", *LINKS, "palm")
_PAYLOAD_MEETS_OWN: Final = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link")

PAYLOAD_PAIRS: Final = tuple(
    pair
    for arm, other in (ARMS, ARMS[::-1])
    for pair in (
        *((f"{arm}/{HELD}", f"{other}/{part}") for part in _PAYLOAD_MEETS_OTHER),
        *((f"{arm}/{HELD}", f"{arm}/{part}") for part in _PAYLOAD_MEETS_OWN),
        (f"{arm}/{HELD}", "floor"),
    )
)
"""Pairs of the twin that what is held adds."""

# Which parts of one arm can meet. Joints 2, 3 and 4 are parallel, so wrists 1 and 2 always pass base and shoulder
# sideways; ur10.xml filters their contacts.
_OWN: Final = {
    "forearm_link": ("base_link", "shoulder_link"),
    "wrist_1_link": ("upper_arm_link",),
    "wrist_2_link": ("upper_arm_link",),
    "wrist_3_link": ("base_link", "shoulder_link", "upper_arm_link", "forearm_link"),
}


_GRIPPER: Final = ("palm", "fingers")
# Their wrist holds both, and no posture brings one to the other wrists of its arm.
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
"""Geom names of each distance sensor of the bare cell's clearance model, in sensor order."""

_WITH_GRIPPERS: Final = CLEARANCE_PAIRS + _gripper_pairs()


def _held(settings: SceneSettings) -> str | None:
    """What the hands may hold."""
    return settings.equipment.prop if settings.equipment.grippers else None


def _obstacle_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    parts = (*LINKS, *_GRIPPER) if settings.equipment.grippers else LINKS
    if _held(settings):
        parts = (*parts, HELD)
    return tuple((f"{arm}/{part}", geom_name(each)) for each in settings.obstacles for arm in ARMS for part in parts)


# A capsule against a box's hull costs up to thirteen times as much as any other pair, a sphere against a box as much as
# the others. The wrists' capsules are nearly spheres, so that the spheres around them stand in for them at boxes. The
# fingers are a box only where they come near on purpose: to what is flat, and to the other gripper.
_ROUND: Final = LINKS[3:]


def clearance_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    """Geom names of each distance sensor of the clearance model, in sensor order.

    The pairs are all that can meet: each moving link with the other arm, the table and the floor, and the forearm and
    the wrists with those parts of their own arm that they can reach. Grippers add, after those, their `palm` and
    `fingers` with all of these; a prop adds what each hand `held`, as if it did so all the time, with all that it can
    meet but the table and the other hand's fingers. Obstacles add, last, each of these parts with each of them. A prop
    that lies somewhere is not measured.

    Args:
        settings: the cell.
    """
    pairs = _WITH_GRIPPERS if settings.equipment.grippers else CLEARANCE_PAIRS
    pairs = pairs + PAYLOAD_PAIRS if _held(settings) else pairs
    return pairs + _obstacle_pairs(settings) if settings.obstacles else pairs


@lru_cache(maxsize=32)
def compose_collision_model(settings: SceneSettings) -> str:
    """MJCF text of the cell's twin that measures distances.

    It has the arms' joints in the cell's order and no visuals, contacts, actuators or gravity, so that one `forward` up
    to the position stage gives all distances. Sensor i is the signed distance in m of the collision geoms
    `clearance_pairs(settings)[i]`, negative when they overlap, at most `CLEARANCE_CUTOFF_M`. From the wrists to the
    table and to boxes it is that of the spheres around their capsules: never more than the capsules' own distance, and
    up to 12.5 mm less where a wrist lies across. The fingers are the box that holds both at any opening; to all but the
    table, boxes, planes and the other gripper it is the capsule around this box, up to 36 mm nearer. A gripper has its
    whole mass, with its fingers half open.

    Args:
        settings: the cell; `gains` and `meshes` do not matter.

    Returns:
        The text; the same object for equal settings.
    """
    root = cell_tree(settings, rigid=True)
    root.compiler.fusestatic = True
    for arm in ARMS:
        frame = root.find("attachment_frame", arm)
        strip(frame)
        _add_balls(frame)
        if (prop := _held(settings)) is not None:
            add_payload_geometry(root.find("body", f"{arm}/gripper"), arm, prop)
    for unused in (
        *root.find_all("actuator"),
        *root.find_all("contact"),
        *root.find_all("equality"),
        *root.find_all("tendon"),
    ):
        unused.remove()
    for name in ("contact", "gravity", "constraint", "actuation"):
        setattr(root.option.flag, name, "disable")
    document = document_of(root)
    add_obstacles(document, settings.obstacles)
    add_hulls(document)
    sensors = child_of(document, "sensor")
    shapes = {"table": "box"} | {geom_name(each): each.kind for each in settings.obstacles}
    for geom1, geom2 in clearance_pairs(settings):
        first, second = _measured(geom1, geom2, shapes)
        ET.SubElement(
            sensors, "distance", name=f"{geom1}:{geom2}", geom1=first, geom2=second, cutoff=repr(CLEARANCE_CUTOFF_M)
        )
    return text_of(document)


def build_collision_model(settings: SceneSettings) -> mujoco.MjModel:
    """A fresh model of the cell's contact-free twin, for distances only.

    Args:
        settings: the cell.

    Returns:
        The compiled model; its `sensordata` has one distance per pair of `clearance_pairs(settings)`.
    """
    bare = replace(settings, equipment=Equipment())
    return compiled(compose_collision_model(settings), joint_names(bare), ())


def hull_name(box: str) -> str:
    """Name of a box's hull in a collision model. No obstacle can have this name."""
    return f"{box}:hull"


def add_hulls(document: ET.Element) -> None:
    """Give every box of the world a second geom of the same shape, a mesh.

    MuJoCo's distance of a capsule from a box is wrong where the capsule's line pierces it: a link that is stuck through
    a plate may read as clear of it. That from a mesh, which is found in another way, is right everywhere.

    Args:
        document: MJCF of a collision model.
    """
    world, asset = child_of(document, "worldbody"), child_of(document, "asset")
    for box in [geom for geom in world.findall("geom") if geom.get("type") == "box"]:
        name = hull_name(box.attrib["name"])
        corners = itertools.product(*((-float(half), float(half)) for half in box.attrib["size"].split()))
        ET.SubElement(asset, "mesh", name=name, vertex=xml_numbers(*itertools.chain(*corners)))
        pose = {key: value for key, value in box.attrib.items() if key in ("pos", "quat")}
        ET.SubElement(world, "geom", {"name": name, "type": "mesh", "mesh": name, **pose})


def add_payload_geometry(gripper: Any, arm: str, prop: str) -> None:
    """Put what a hand holds into its gripper's body, without a mass: the body's is given.

    Args:
        gripper: Body of a gripper in dm_control's tree.
        arm: "left" or "right".
        prop: Name of the prop.
    """
    first, last = _along_m(prop)
    side = 1.0 if arm == ARMS[0] else -1.0
    width = BAR_WIDTH_M if prop == "bar" else BLOCK_SIZE_M[1]
    fromto = (side * (first + width / 2), 0, TCP_M, side * (last - width / 2), 0, TCP_M)
    gripper.add("geom", name=HELD, type="capsule", fromto=fromto, size=(width / 2,))


def _along_m(prop: str) -> tuple[float, float]:
    """From where to where it reaches along the left tool's x; along the right tool's it is the other way round."""
    if prop == "bar":
        return -(BAR_LENGTH_M - GRIP_DISTANCE_M) / 2, GRIP_DISTANCE_M / 2
    return -(BLOCK_SIZE_M[0] / 2 + BLOCK_GRIP_M), BLOCK_SIZE_M[0] / 2 - BLOCK_GRIP_M


def _ball(name: str) -> str:
    return f"{name}_ball"


def _measured(geom: str, other: str, shapes: Mapping[str, str]) -> tuple[str, str]:
    """The geoms that stand in for a pair: a part of an arm, and another or what stands in the cell.

    Args:
        geom: The part of an arm.
        other: The other.
        shapes: Those of all boxes and of all obstacles, by name.
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
    """The fingers' capsule in place of their box, except to the other gripper."""
    return f"{geom}_round" if geom.endswith("/fingers") and other_part not in _GRIPPER else geom


def _add_balls(frame: Any) -> None:
    """Put the smallest sphere around each wrist's capsule."""
    for geom in frame.find_all("geom"):
        if geom.name in _ROUND:
            first, last = np.reshape(geom.fromto, (2, 3))
            radius = float(geom.size[0] + np.linalg.norm(last - first) / 2)
            geom.parent.add("geom", name=_ball(geom.name), type="sphere", size=(radius,), pos=(first + last) / 2)
