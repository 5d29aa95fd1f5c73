"""Parts shared by all models of a cell: options, floor, table, both arms, obstacles; conversion to MJCF."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

from dual_ur10.assets.arm import arm_tree, composer
from dual_ur10.assets.gripper import FINGER_JOINTS, add_gripper
from dual_ur10.assets.obstacles import Box, Obstacle, Plane, geom_name
from dual_ur10.assets.settings import TABLE_THICKNESS_M, SceneSettings
from dual_ur10.errors import DualUR10Error
from dual_ur10.kinematics.frames import FLOOR_Z_M
from dual_ur10.kinematics.rotations import quat_from_rotvec
from dual_ur10.kinematics.ur10 import ARMS, JOINTS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

_POINT_M: Final = 1e-6  # MuJoCo has no capsule of no length
_COLOUR: Final = "0.78 0.42 0.30 1"
_COLOUR_OF_WALLS: Final = "0.78 0.42 0.30 0.35"  # transparent
_WALL_M: Final = 3.0  # half the side of the visible piece of a wall


def cell_tree(settings: SceneSettings, *, rigid: bool = False) -> Any:
    """Return the dm_control tree of all models: options, floor, table and both arms with their grippers.

    Args:
        settings: Settings of the cell.
        rigid: Grippers without joints of their own.
    """
    root = composer().RootElement(model="cell")
    root.compiler.angle = "radian"
    root.option.timestep = settings.timestep_s
    root.option.integrator = settings.integrator
    root.option.cone = "elliptic"
    if settings.equipment.grippers or settings.equipment.prop:
        root.option.impratio = 100  # divides the rate at which gripped objects creep
    # A diverged simulation must be seen by the caller, not silently start again from t = 0.
    root.option.flag.autoreset = "disable"
    _add_ground(root, settings)
    for name, mount in zip(ARMS, settings.mounts, strict=True):
        arm = arm_tree(name, mount.dh, settings.gains)
        if settings.equipment.grippers:
            add_gripper(arm, settings, rigid=rigid)
        frame = root.attach(arm)
        frame.pos = mount.position_m
        frame.quat = mount.quat
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
    """Return the tree as plain XML, for features that dm_control lacks: its names cannot hold a slash."""
    return ET.fromstring(root.to_xml_string())


def child_of(parent: ET.Element, tag: str) -> ET.Element:
    """Return the child of that tag, and create it if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def add_obstacles(document: ET.Element, obstacles: tuple[Obstacle, ...]) -> None:
    """Add obstacles to the world of a model, after its other geoms.

    Args:
        document: MJCF of the cell.
        obstacles: Obstacles to add.
    """
    for each in obstacles:
        colour = _COLOUR_OF_WALLS if isinstance(each, Plane) else _COLOUR
        ET.SubElement(
            child_of(document, "worldbody"), "geom", {"name": geom_name(each), "rgba": colour, **_geom_of(each)}
        )


def _geom_of(obstacle: Obstacle) -> dict[str, str]:
    if isinstance(obstacle, Box):
        return {
            "type": "box",
            "pos": xml_numbers(*obstacle.position_m),
            "quat": xml_numbers(*quat_from_rotvec(obstacle.rotation_rad)),
            "size": xml_numbers(*(size / 2 for size in obstacle.size_m)),
        }
    if isinstance(obstacle, Plane):
        return {
            "type": "plane",
            "pos": xml_numbers(*obstacle.point_m),
            "zaxis": xml_numbers(*obstacle.normal),
            "size": xml_numbers(_WALL_M, _WALL_M, 0.1),
        }
    length = math.dist(obstacle.from_m, obstacle.to_m)
    if length < _POINT_M:
        return {
            "type": "sphere",
            "pos": xml_numbers(*obstacle.from_m),
            "size": xml_numbers(obstacle.radius_m + length),
        }
    return {
        "type": "capsule",
        "fromto": xml_numbers(*obstacle.from_m, *obstacle.to_m),
        "size": xml_numbers(obstacle.radius_m),
    }


def xml_numbers(*values: float) -> str:
    """Return numbers as the value of an XML attribute, exactly."""
    return " ".join(repr(float(value)) for value in values)


def text_of(document: ET.Element) -> str:
    """Return the MJCF text."""
    ET.indent(document)
    return ET.tostring(document, encoding="unicode")


def joint_names(settings: SceneSettings) -> tuple[str, ...]:
    """Return the joints of the cell in the order of `qpos`: left arm, left fingers, right arm, right fingers, prop."""
    each = (*JOINTS, *FINGER_JOINTS) if settings.equipment.grippers else JOINTS
    prop = (settings.equipment.prop,) if settings.equipment.prop else ()
    return (*(f"{arm}/{joint}" for arm in ARMS for joint in each), *prop)


def actuator_names(settings: SceneSettings) -> tuple[str, ...]:
    """Return the actuators of the cell in the order of `ctrl`: left arm, left gripper, right arm, right gripper."""
    each = (*JOINTS, "gripper") if settings.equipment.grippers else JOINTS
    return tuple(f"{arm}/{actuator}" for arm in ARMS for actuator in each)


def compiled(text: str, joints: tuple[str, ...], actuators: tuple[str, ...]) -> mujoco.MjModel:
    """Return a fresh model, with joints and actuators in the order of all arrays of this package.

    Raises:
        DualUR10Error: Their order differs.
    """
    model = _model_of(text)
    found_joints = tuple(model.joint(i).name for i in range(model.njnt))
    found_actuators = tuple(model.actuator(i).name for i in range(model.nu))
    for kind, found, expected in (("joints", found_joints, joints), ("actuators", found_actuators, actuators)):
        if found != expected:
            raise DualUR10Error(
                f"the model's {kind} are {list(found)}, expected {list(expected)}: the trees and the names disagree"
            )
    return copy.copy(model)


@lru_cache(maxsize=16)
def _model_of(text: str) -> mujoco.MjModel:
    """Return the compiled model, to be copied: compiling takes ten times as long."""
    import mujoco

    return mujoco.MjModel.from_xml_string(text)
