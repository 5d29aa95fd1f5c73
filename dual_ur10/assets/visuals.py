"""Visual-only parts of the cell: surroundings, cameras, grippers, props and the optional meshes of the arms.

Nothing here has mass or contacts: a model composed with `visuals=False` leaves all of it out.
"""

from __future__ import annotations

import importlib.metadata
import math
from pathlib import Path
from typing import Any, Final, NamedTuple

from dual_ur10.assets.settings import TABLE_THICKNESS_M, SceneSettings
from dual_ur10.errors import MissingExtraError, SettingsError, UnknownNameError
from ur_core.kinematics.frames import FLOOR_Z_M
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.camera import Camera
from ur_core.objects import load_object
from ur_core.tools.pen import Pen
from ur_core.tools.tool import Tool

FIXED_CAMERAS: Final = (
    Camera("front", (1.8, 0.0, 1.0), (-0.4, 0.0, 0.3)),
    Camera("side", (-0.1, -2.6, 0.9), (-0.25, 0.0, 0.3)),
    Camera("overhead", (-0.25, 0.0, 3.2), (-0.2, 0.0, 0.0)),
    Camera("perspective", (1.4, -1.7, 1.35), (-0.35, 0.0, 0.25)),
)
"""Cameras of every scene; each shows both arms."""

CAMERAS: Final = tuple(each.name for each in FIXED_CAMERAS)
"""Their names."""


class PlacedCamera(NamedTuple):
    """Camera in the model of a cell.

    Attributes:
        name: Its name there.
        body: Name of the body that carries it; "": the cell.
        camera: The camera.
    """

    name: str
    body: str
    camera: Camera


def placed_cameras(settings: SceneSettings) -> tuple[PlacedCamera, ...]:
    """Return all cameras: fixed ones, with grippers those of the tools, those of props, the scene's, and the cell's.

    Raises:
        SettingsError: Two have one name.
    """
    equipment = settings.equipment
    found = [PlacedCamera(each.name, "", each) for each in FIXED_CAMERAS]
    for arm, tool in zip(ARMS, equipment.tools, strict=True):
        for each in tool.views if equipment.grippers else ():
            found.append(PlacedCamera(f"{arm}/{each.name}", f"{arm}/{each.body or 'gripper'}", each))
    for prop in equipment.props:
        for each in prop.cameras:
            found.append(PlacedCamera(f"{prop.name}/{each.name}", prop.body_named(each.body), each))
    found += [PlacedCamera(each.name, each.body, each) for each in equipment.cameras]
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"two cameras of the cell are named {name!r}: every scene has {', '.join(CAMERAS)}")
    placed = {each.name: each for each in found}
    placed |= {name: PlacedCamera(name, each.body, each) for name, each in settings.cameras}
    return tuple(placed.values())


def cameras(settings: SceneSettings) -> tuple[str, ...]:
    """Return the names of all cameras, such as "front", "left/wrist" and, of a prop, "case/eye"."""
    return tuple(each.name for each in placed_cameras(settings))


def add_cameras(spec: Any, settings: SceneSettings, *, visuals: bool) -> None:
    """Add all cameras to the spec of a cell that is complete otherwise.

    Args:
        spec: `MjSpec` of the cell.
        settings: Settings of the cell.
        visuals: False: check them only.

    Raises:
        UnknownNameError: The cell has no body of a camera.
        SettingsError: Two have one name.
    """
    for name, body, camera in placed_cameras(settings):
        carrier = spec.body(body) if body else spec.worldbody
        if carrier is None:
            known = [each.name for each in spec.bodies if each.name and each.name != "world"]
            raise UnknownNameError(f"body of the camera {name!r}", body, known)
        if visuals:
            carrier.add_camera(name=name, pos=camera.position_m, xyaxes=camera.axes, fovy=camera.fovy_deg)


def add_surroundings(spec: Any, settings: SceneSettings) -> None:
    """Add materials, sky, lights, table legs and pedestals."""
    spec.stat.center = (-0.2, 0.0, 0.25)
    spec.stat.extent = 1.6
    spec.visual.global_.offwidth = 1920
    spec.visual.global_.offheight = 1080
    spec.visual.headlight.ambient = (0.35, 0.35, 0.35)
    spec.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear = 0.02
    _add_materials(spec)
    for position, strength, shadow in (((0.6, 0.9, 3.5), 0.5, True), ((-1.0, -2.5, 3.0), 0.3, False)):
        spec.worldbody.add_light(
            pos=position,
            dir=(-0.2 - position[0], -position[1], 0.2 - position[2]),
            cutoff=60,
            exponent=1,
            diffuse=(strength,) * 3,
            specular=(0.2,) * 3,
            castshadow=shadow,
        )
    _add_furniture(spec, settings)


def _add_materials(spec: Any) -> None:
    import mujoco

    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.75, 0.82, 0.9),
        rgb2=(0.35, 0.42, 0.5),
        width=256,
        height=256,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.42, 0.44, 0.46),
        rgb2=(0.38, 0.40, 0.42),
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.add_material(name="table_top", rgba=(0.62, 0.55, 0.45, 1), specular=0.1, shininess=0.2)
    spec.add_material(name="frame", rgba=(0.25, 0.27, 0.29, 1), specular=0.3, shininess=0.4)
    spec.geom("floor").material = "floor"
    spec.geom("table").material = "table_top"


def _add_furniture(spec: Any, settings: SceneSettings) -> None:
    import mujoco

    style = {"material": "frame", "contype": 0, "conaffinity": 0, "group": 2}
    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    height = -TABLE_THICKNESS_M - FLOOR_Z_M
    for sx in (-1, 1):
        for sy in (-1, 1):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=(x + sx * (length / 2 - 0.06), y + sy * (width / 2 - 0.06), FLOOR_Z_M + height / 2),
                size=(0.04, 0.04, height / 2),
                **style,
            )
    for mount in settings.mounts:
        px, py, pz = mount.position_m
        on_table = abs(px - x) < length / 2 and abs(py - y) < width / 2 and pz >= 0.0
        bottom = 0.0 if on_table else FLOOR_Z_M
        if pz - bottom < 0.05:
            continue  # the base stands on the table or on the floor itself
        for top, low, radius in ((pz, pz - 0.02, 0.13), (pz - 0.02, bottom, 0.09), (bottom + 0.02, bottom, 0.2)):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                pos=(px, py, (top + low) / 2),
                size=(radius, (top - low) / 2, 0),
                **style,
            )


def draw_gripper(arm: Any, tool: Tool) -> None:
    """Add the visuals of the gripper of one arm's spec.

    A tool's own function gets the same arguments. It may add materials, and geoms of the class "visual" to the bodies
    `gripper`, `finger_1` and `finger_2`.

    Raises:
        SettingsError: The tool's own function cannot be imported.
    """
    if not tool.visuals:
        _draw_plainly(arm, tool)
        return
    # Registered, since `Tool.received` takes none from records.
    load_object(tool.visuals, f"visuals of the tool {tool.name!r}", registered=True)(arm, tool)


def _draw_plainly(arm: Any, tool: Tool) -> None:
    """Draw the parts of the figures: coupling, palm, fingers and pads."""
    palm, tip = Pen(arm, "gripper"), tool.fingertip_m
    (x, y), (width, thick, length) = (size / 2 for size in tool.palm_size_m), tool.pad_m
    palm.disc(0, 0.0, 0.014, 0.0375, "flange")
    palm.box((-x, -y, 0.014), (x, y, tool.palm_m), "housing")
    for i, sign in ((1, 1), (2, -1)):
        pen, half = Pen(arm, f"finger_{i}", sign), tool.finger_width_m / 2
        pen.box((-half, thick, tool.palm_m), (half, tool.finger_thick_m, tip), "tube")
        pen.box((-width / 2, 0.0, tip - length), (width / 2, thick, tip), "rubber")


# Frames of the mesh files in the body frames of ur10.xml: position in m, quaternion w, x, y, z.
_HALF = math.sqrt(0.5)
_MESHES: Final = {
    "base_link": ("base", (0, 0, 0), (1, 0, 0, 0)),
    "shoulder_link": ("shoulder", (0, 0, 0.1273), (0, 0, 0, 1)),
    "upper_arm_link": ("upperarm", (0, 0, 0.220941), (0.5, 0.5, -0.5, -0.5)),
    "forearm_link": ("forearm", (0, 0, 0.049041), (0.5, 0.5, -0.5, -0.5)),
    "wrist_1_link": ("wrist1", (0, 0, 0.049041), (_HALF, _HALF, 0, 0)),
    "wrist_2_link": ("wrist2", (0, 0, 0), (1, 0, 0, 0)),
    "wrist_3_link": ("wrist3", (0, 0, 0), (_HALF, _HALF, 0, 0)),
}


def _mesh_folder() -> Path:
    where = "cmeel.prefix/share/example-robot-data/robots/ur_description/meshes/ur10/collision"
    try:
        folder = Path(str(importlib.metadata.distribution("example-robot-data").locate_file(where)))
    except importlib.metadata.PackageNotFoundError:
        folder = Path()
    if not (folder / "base.stl").is_file():
        raise MissingExtraError("example-robot-data", "meshes", "rendering the UR10's meshes (meshes=True)")
    return folder


def use_meshes(spec: Any) -> None:
    """Replace the primitives of both arms of a cell's spec by meshes."""
    import mujoco

    folder = _mesh_folder()
    for mesh, _, _ in _MESHES.values():
        spec.add_mesh(name=mesh, file=str(folder / f"{mesh}.stl"))
    for arm in ARMS:
        style = spec.find_default(f"{arm}/visual")
        for link, (mesh, position, quat) in _MESHES.items():
            body = spec.body(f"{arm}/{link}")
            for geom in body.geoms:
                if geom.classname.name == style.name:
                    spec.delete(geom)
            body.add_geom(
                style,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=mesh,
                pos=position,
                quat=quat,
                material=f"{arm}/tube",
            )
