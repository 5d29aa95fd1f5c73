"""The cell's contact-free twin, which only measures distances: capsules, table and floor, one sensor per pair."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.assets.arm import strip
from dual_ur10.assets.cell_tree import cell_tree, child_of, compiled, document_of, joint_names, text_of
from dual_ur10.assets.settings import Equipment, SceneSettings
from dual_ur10.ur10 import ARMS, LINKS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

CLEARANCE_CUTOFF_M: Final = 0.2
"""Distances beyond this read as this."""

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

# A capsule against a box costs seven times as much as any other pair, a sphere against a box as much as the others. The
# wrists' capsules are nearly spheres, so that the spheres around them stand in for them at the table. The fingers are a
# box only where they come near on purpose: to the table and to the other gripper.
_ROUND: Final = LINKS[3:]


def clearance_pairs(settings: SceneSettings) -> tuple[tuple[str, str], ...]:
    """Geom names of each distance sensor of the clearance model, in sensor order.

    The pairs are all that can meet: each moving link with the other arm, the table and the floor, and the forearm and
    the wrists with those parts of their own arm that they can reach. Grippers add, after those, their `palm` and
    `fingers` with all of these. Props are not measured.

    Args:
        settings: the cell.
    """
    return _WITH_GRIPPERS if settings.equipment.grippers else CLEARANCE_PAIRS


@lru_cache(maxsize=32)
def compose_clearance(settings: SceneSettings) -> str:
    """MJCF text of the cell's twin that measures distances.

    It has the arms' joints in the cell's order and no visuals, contacts, actuators or gravity, so that one `forward` up
    to the position stage gives all distances. Sensor i is the signed distance in m of the collision geoms
    `clearance_pairs(settings)[i]`, negative when they overlap, at most `CLEARANCE_CUTOFF_M`. From the wrists to the
    table it is that of the spheres around their capsules: never more than the capsules' own distance, and up to 12.5 mm
    less where a wrist lies across. The fingers are the box that holds both at any opening; to all but the table and the
    other gripper it is the capsule around this box, up to 36 mm nearer. A gripper has its whole mass, with its fingers
    half open.

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
    sensors = child_of(document, "sensor")
    for geom1, geom2 in clearance_pairs(settings):
        ET.SubElement(
            sensors,
            "distance",
            name=f"{geom1}:{geom2}",
            geom1=_measured(geom1, geom2),
            geom2=_measured(geom2, geom1),
            cutoff=repr(CLEARANCE_CUTOFF_M),
        )
    return text_of(document)


def build_clearance_model(settings: SceneSettings) -> mujoco.MjModel:
    """A fresh model of the cell's contact-free twin, for distances only.

    Args:
        settings: the cell.

    Returns:
        The compiled model; its `sensordata` has one distance per pair of `clearance_pairs(settings)`.
    """
    bare = replace(settings, equipment=Equipment())
    return compiled(compose_clearance(settings), joint_names(bare), ())


def _ball(name: str) -> str:
    return f"{name}_ball"


def _measured(geom: str, other: str) -> str:
    """The geom that stands in for one of a pair."""
    part = geom.split("/")[-1]
    if part in _ROUND and other == "table":
        return _ball(geom)
    if part == "fingers" and other.split("/")[-1] not in ("table", *_GRIPPER):
        return f"{geom}_round"
    return geom


def _add_balls(frame: Any) -> None:
    """Put the smallest sphere around each wrist's capsule."""
    for geom in frame.find_all("geom"):
        if geom.name in _ROUND:
            first, last = np.reshape(geom.fromto, (2, 3))
            radius = float(geom.size[0] + np.linalg.norm(last - first) / 2)
            geom.parent.add("geom", name=_ball(geom.name), type="sphere", size=(radius,), pos=(first + last) / 2)
