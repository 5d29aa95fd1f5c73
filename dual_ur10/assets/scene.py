"""The cell: two UR10s as ``left/`` and ``right/``, a table between them, floor, lights and cameras.

[compose][dual_ur10.assets.scene.compose] writes the MJCF of a cell, cached per settings;
[build_model][dual_ur10.assets.scene.build_model] compiles a fresh model, which the caller may change. Distances are
measured with [collision_model][dual_ur10.assets.collision_model]. Importing this module loads neither mujoco nor
dm_control.

Cell frame: origin on the table top midway between the arms' workspaces, x forward (away from the bases), y left, z up.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import TYPE_CHECKING

from dual_ur10.assets.arm import remove_visuals
from dual_ur10.assets.cell_tree import (
    actuator_names,
    add_obstacles,
    cell_tree,
    child_of,
    compiled,
    document_of,
    joint_names,
    text_of,
)
from dual_ur10.assets.props import add_prop, weld_bar
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.assets.visuals import add_surroundings, draw_grippers, draw_prop, use_meshes
from dual_ur10.kinematics.ur10 import ARMS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own


@lru_cache(maxsize=32)
def compose(settings: SceneSettings, *, visuals: bool = True) -> str:
    """Return the MJCF text of the whole cell.

    Joints, actuators and degrees of freedom: the left arm's six, then the right arm's six. With grippers, each arm's
    are followed by its gripper's (two finger joints, one actuator: the opening in m). A prop's free joint is the last.
    Sensors, each for left and right: `<arm>/flange_base_pos` and `<arm>/flange_base_quat`
    (flange in the arm's own UR `base` frame, m and w, x, y, z) and `<arm>/flange_pos` (flange in the cell frame, m);
    with grippers also `<arm>/wrench_force` and `<arm>/wrench_torque` (N and N·m at the flange, in its axes, that the
    wrist exerts on the gripper: a gripper at rest that points down reads minus its weight along z).

    Args:
        settings: Settings of the cell.
        visuals: Include the visual-only parts. Without them the model has the same state and dynamics, and a step
            costs a quarter less: simulate without, render with.

    Returns:
        The text; the same object for equal settings.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    root = cell_tree(settings)
    add_prop(root, settings)
    if visuals:
        add_surroundings(root, settings)
        if settings.equipment.prop:
            draw_prop(root, settings.equipment.prop)
        if settings.equipment.grippers:
            draw_grippers(root)
    else:
        for arm in ARMS:
            remove_visuals(root.find("attachment_frame", arm))
    document = document_of(root)
    add_obstacles(document, settings.obstacles)
    _add_flange_sensors(document)
    if settings.equipment.grippers:
        _add_wrench_sensors(document)
    if settings.equipment.welded:
        weld_bar(document)
    if settings.meshes and visuals:
        use_meshes(document)
    return text_of(document)


def build_model(settings: SceneSettings, *, visuals: bool = True) -> mujoco.MjModel:
    """Return a fresh model of the cell.

    Args:
        settings: Settings of the cell.
        visuals: Include the visual-only parts; see `compose`.

    Returns:
        The compiled model; the caller may change it.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    return compiled(compose(settings, visuals=visuals), joint_names(settings), actuator_names(settings))


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice]:
    """Return the slice of `sensordata` of each named sensor."""
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


def _add_wrench_sensors(document: ET.Element) -> None:
    sensors = child_of(document, "sensor")
    for kind in ("force", "torque"):
        for arm in ARMS:
            ET.SubElement(sensors, kind, name=f"{arm}/wrench_{kind}", site=f"{arm}/wrench")
