"""The cell: two UR10s as ``left/`` and ``right/``, a table between them, floor, lights and cameras.

[compose][dual_ur10.assets.scene.compose] writes the MJCF of a cell and
[compose_clearance][dual_ur10.assets.scene.compose_clearance] that of its contact-free twin, which only measures the
distances between collision capsules. Both are cached per settings; the models built from them are fresh each time, so
that a caller may change one. Importing this module loads neither mujoco nor dm_control.

This is the module to import from; the modules beside it hold the parts.

Cell frame: origin on the table top midway between the arms' workspaces, x forward (away from the bases), y left, z up.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import TYPE_CHECKING

from dual_ur10.assets.arm import strip
from dual_ur10.assets.cell_tree import cell_tree, child_of, compiled, document_of, text_of
from dual_ur10.assets.clearance_model import (
    CLEARANCE_CUTOFF_M,
    CLEARANCE_PAIRS,
    build_clearance_model,
    clearance_pairs,
    compose_clearance,
)
from dual_ur10.assets.meshes import use_meshes
from dual_ur10.assets.settings import (
    BASE_RADIUS_M,
    FLOOR_Z_M,
    GAINS,
    HOME_Q_RAD,
    MIN_BASE_DISTANCE_M,
    TABLE_THICKNESS_M,
    ArmMount,
    SceneSettings,
)
from dual_ur10.assets.surroundings import CAMERAS, add_surroundings
from dual_ur10.ur10 import ARMS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

__all__ = [
    "BASE_RADIUS_M",
    "CAMERAS",
    "CLEARANCE_CUTOFF_M",
    "CLEARANCE_PAIRS",
    "FLOOR_Z_M",
    "GAINS",
    "HOME_Q_RAD",
    "MIN_BASE_DISTANCE_M",
    "TABLE_THICKNESS_M",
    "ArmMount",
    "SceneSettings",
    "build_clearance_model",
    "build_model",
    "clearance_pairs",
    "compose",
    "compose_clearance",
    "sensor_slices",
]


@lru_cache(maxsize=32)
def compose(settings: SceneSettings, *, drawn: bool = True) -> str:
    """MJCF text of the whole cell.

    Joints, actuators and degrees of freedom come as the left arm's six, then the right arm's six. The sensors are, for
    left and then right each time: `<arm>/flange_base_pos` and `<arm>/flange_base_quat` (flange in the arm's own UR
    `base` frame, m and w, x, y, z) and `<arm>/flange_pos` (flange in the cell frame, m).

    Args:
        settings: the cell.
        drawn: with the parts that are only looked at. Without them the model has the same state and the same
        dynamics, and a step costs a quarter less: simulate without, draw with.

    Returns:
        The text; the same object for equal settings.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    root = cell_tree(settings)
    if drawn:
        add_surroundings(root, settings)
    else:
        for arm in ARMS:
            strip(root.find("attachment_frame", arm))
    document = document_of(root)
    _add_flange_sensors(document)
    if settings.meshes and drawn:
        use_meshes(document)
    return text_of(document)


def build_model(settings: SceneSettings, *, drawn: bool = True) -> mujoco.MjModel:
    """A fresh model of the cell.

    Args:
        settings: the cell.
        drawn: with the parts that are only looked at; see `compose`.

    Returns:
        The compiled model; the caller may change it.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    return compiled(compose(settings, drawn=drawn))


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice]:
    """Where each named sensor's values lie in `sensordata`."""
    return {
        model.sensor(i).name: slice(int(model.sensor_adr[i]), int(model.sensor_adr[i]) + int(model.sensor_dim[i]))
        for i in range(model.nsensor)
    }


def _add_flange_sensors(document: ET.Element) -> None:
    # Here and not in the dm_control tree: that one sorts sensors by arm and lets no name hold a slash.
    sensors = child_of(document, "sensor")
    for tag, suffix, relative in (
        ("framepos", "flange_base_pos", True),
        ("framequat", "flange_base_quat", True),
        ("framepos", "flange_pos", False),
    ):
        for arm in ARMS:
            attributes = {"name": f"{arm}/{suffix}", "objtype": "site", "objname": f"{arm}/flange"}
            if relative:
                attributes |= {"reftype": "site", "refname": f"{arm}/base"}
            ET.SubElement(sensors, tag, attributes)
