"""How obstacles stand in models: as solid geoms of the world, and in the twin that measures distances also as hulls."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from typing import Final

from dual_ur10.assets.cell_tree import child_of
from dual_ur10.assets.obstacles import Box, Obstacle, Plane, geom_name
from dual_ur10.kinematics.rotations import quat_from_rotvec

_POINT_M: Final = 1e-6  # MuJoCo has no capsule of no length
_COLOUR: Final = "0.78 0.42 0.30 1"
_COLOUR_OF_WALLS: Final = "0.78 0.42 0.30 0.35"  # what is behind one can still be seen
_DRAWN_M: Final = 3.0  # half the side of the piece of a wall that is drawn


def add_obstacles(document: ET.Element, obstacles: tuple[Obstacle, ...]) -> None:
    """Put them into the world of a model, after all that is there.

    Args:
        document: MJCF of the cell.
        obstacles: What to put there.
    """
    for each in obstacles:
        colour = _COLOUR_OF_WALLS if isinstance(each, Plane) else _COLOUR
        ET.SubElement(
            child_of(document, "worldbody"), "geom", {"name": geom_name(each), "rgba": colour, **_shape(each)}
        )


def hull_name(box: str) -> str:
    """Name of a box's hull in the twin that measures distances. No obstacle can have this name."""
    return f"{box}:hull"


def add_hulls(document: ET.Element) -> None:
    """Give every box of the world a second geom of the same shape, a mesh.

    MuJoCo's distance of a capsule from a box is wrong where the capsule's line pierces it: a link that is stuck through
    a plate may read as clear of it. That from a mesh, which is found in another way, is right everywhere.

    Args:
        document: MJCF of the twin that measures distances.
    """
    world, asset = child_of(document, "worldbody"), child_of(document, "asset")
    for box in [geom for geom in world.findall("geom") if geom.get("type") == "box"]:
        name = hull_name(box.attrib["name"])
        corners = itertools.product(*((-float(half), float(half)) for half in box.attrib["size"].split()))
        ET.SubElement(asset, "mesh", name=name, vertex=_text(*itertools.chain(*corners)))
        pose = {key: value for key, value in box.attrib.items() if key in ("pos", "quat")}
        ET.SubElement(world, "geom", {"name": name, "type": "mesh", "mesh": name, **pose})


def _shape(obstacle: Obstacle) -> dict[str, str]:
    """Attributes of the geom."""
    if isinstance(obstacle, Box):
        return {
            "type": "box",
            "pos": _text(*obstacle.position_m),
            "quat": _text(*quat_from_rotvec(obstacle.rotation_rad)),
            "size": _text(*(size / 2 for size in obstacle.size_m)),
        }
    if isinstance(obstacle, Plane):
        return {
            "type": "plane",
            "pos": _text(*obstacle.point_m),
            "zaxis": _text(*obstacle.normal),
            "size": _text(_DRAWN_M, _DRAWN_M, 0.1),
        }
    length = math.dist(obstacle.from_m, obstacle.to_m)
    if length < _POINT_M:
        return {"type": "sphere", "pos": _text(*obstacle.from_m), "size": _text(obstacle.radius_m + length)}
    return {
        "type": "capsule",
        "fromto": _text(*obstacle.from_m, *obstacle.to_m),
        "size": _text(obstacle.radius_m),
    }


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
