"""Meshes of the optional package `example-robot-data`, drawn in place of the arms' primitives."""

from __future__ import annotations

import importlib.metadata
import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final

from dual_ur10.assets.cell_tree import child_of
from dual_ur10.errors import DualUR10Error, MissingExtraError
from dual_ur10.kinematics.ur10 import ARMS

# Frames of the mesh files in the body frames of ur10.xml: position in m, quaternion w, x, y, z.
_HALF = math.sqrt(0.5)
_MESHES: Final = {
    "base_link": ("base", "0 0 0", "1 0 0 0"),
    "shoulder_link": ("shoulder", "0 0 0.1273", "0 0 0 1"),
    "upper_arm_link": ("upperarm", "0 0 0.220941", "0.5 0.5 -0.5 -0.5"),
    "forearm_link": ("forearm", "0 0 0.049041", "0.5 0.5 -0.5 -0.5"),
    "wrist_1_link": ("wrist1", "0 0 0.049041", f"{_HALF} {_HALF} 0 0"),
    "wrist_2_link": ("wrist2", "0 0 0", "1 0 0 0"),
    "wrist_3_link": ("wrist3", "0 0 0", f"{_HALF} {_HALF} 0 0"),
}


def _mesh_folder() -> Path:
    where = "cmeel.prefix/share/example-robot-data/robots/ur_description/meshes/ur10/collision"
    try:
        folder = Path(str(importlib.metadata.distribution("example-robot-data").locate_file(where)))
    except importlib.metadata.PackageNotFoundError:
        folder = Path()
    if not (folder / "base.stl").is_file():
        raise MissingExtraError("example-robot-data", "meshes", "drawing the UR10's meshes (meshes=True)")
    return folder


def use_meshes(document: ET.Element) -> None:
    """Draw meshes in place of the primitives of both arms."""
    folder = _mesh_folder()
    asset = child_of(document, "asset")
    for mesh, _, _ in _MESHES.values():
        ET.SubElement(asset, "mesh", name=mesh, file=str(folder / f"{mesh}.stl"))
    for arm in ARMS:
        for link, (mesh, position, quat) in _MESHES.items():
            body = document.find(f".//body[@name='{arm}/{link}']")
            if body is None:
                raise DualUR10Error(f"ur10.xml has no body {link!r}")
            for geom in body.findall(f"geom[@class='{arm}/visual']"):
                body.remove(geom)
            ET.SubElement(
                body,
                "geom",
                {"class": f"{arm}/visual"},
                type="mesh",
                mesh=mesh,
                pos=position,
                quat=quat,
                material=f"{arm}/tube",
            )
