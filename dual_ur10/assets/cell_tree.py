"""What all models of a cell share: options, floor, table and both arms, and the way from tree to text."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

from dual_ur10.assets.arm import arm_tree, composer, quat_z
from dual_ur10.assets.settings import FLOOR_Z_M, TABLE_THICKNESS_M, SceneSettings
from dual_ur10.errors import DualUR10Error
from dual_ur10.ur10 import ARMS, JOINTS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own


def cell_tree(settings: SceneSettings) -> Any:
    """dm_control tree with what all models share: options, floor, table and both arms."""
    root = composer().RootElement(model="cell")
    root.compiler.angle = "radian"
    root.option.timestep = settings.timestep_s
    root.option.integrator = "implicitfast"
    root.option.cone = "elliptic"
    # A diverged simulation must be seen by the caller, not silently start again from t = 0.
    root.option.flag.autoreset = "disable"
    _add_ground(root, settings)
    for name, mount in zip(ARMS, settings.mounts, strict=True):
        frame = root.attach(arm_tree(name, mount.dh, settings.gains))
        frame.pos = mount.position_m
        frame.quat = quat_z(mount.yaw_rad)
    return root


def _add_ground(root: Any, settings: SceneSettings) -> None:
    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    root.worldbody.add("geom", name="floor", type="plane", pos=(0, 0, FLOOR_Z_M), size=(6, 6, 0.1))
    root.worldbody.add(
        "geom",
        name="table",
        type="box",
        pos=(x, y, -TABLE_THICKNESS_M / 2),
        size=(length / 2, width / 2, TABLE_THICKNESS_M / 2),
    )


def document_of(root: Any) -> ET.Element:
    """The tree as plain XML, for what dm_control cannot express: it lets no name hold a slash."""
    return ET.fromstring(root.to_xml_string())


def child_of(parent: ET.Element, tag: str) -> ET.Element:
    """The child of that tag, made if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def text_of(document: ET.Element) -> str:
    """MJCF text."""
    ET.indent(document)
    return ET.tostring(document, encoding="unicode")


def compiled(text: str) -> mujoco.MjModel:
    """A fresh model, its joints and actuators, if any, in the order that all arrays of this package have.

    Raises:
        DualUR10Error: They are not.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    expected = [f"{arm}/{joint}" for arm in ARMS for joint in JOINTS]
    joints = [model.joint(i).name for i in range(model.njnt)]
    actuators = [model.actuator(i).name for i in range(model.nu)]
    for kind, names in (("joints", joints), ("actuators", actuators or expected)):
        if names != expected:
            raise DualUR10Error(f"the model's {kind} are {names}, expected {expected}: ur10.xml and ur10.py disagree")
    return model
