"""Visual-only parts of the cell: surroundings, cameras, grippers, props and the optional meshes of the arms.

Nothing here has mass or contacts: a model composed with `visuals=False` leaves all of it out.
"""

from __future__ import annotations

import importlib.metadata
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.assets.gripper import FINGERTIP_M, PAD_LENGTH_M, PAD_THICK_M, PAD_WIDTH_M, PALM_LENGTH_M, TCP_M
from dual_ur10.assets.prop import Camera
from dual_ur10.assets.settings import TABLE_THICKNESS_M, SceneSettings
from dual_ur10.errors import MissingExtraError
from dual_ur10.kinematics.frames import FLOOR_Z_M
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.types import Vector3

FIXED_CAMERAS: Final = (
    Camera("front", (1.8, 0.0, 1.0), (-0.4, 0.0, 0.3)),
    Camera("side", (-0.1, -2.6, 0.9), (-0.25, 0.0, 0.3)),
    Camera("overhead", (-0.25, 0.0, 3.2), (-0.2, 0.0, 0.0)),
    Camera("perspective", (1.4, -1.7, 1.35), (-0.35, 0.0, 0.25)),
)
"""Cameras of every scene; each shows both arms."""

CAMERAS: Final = tuple(each.name for each in FIXED_CAMERAS)
"""Their names."""


def cameras(settings: SceneSettings) -> tuple[str, ...]:
    """Return the names of all cameras: fixed ones, with grippers `left/wrist` and `right/wrist`, and the scene's."""
    wrists = tuple(f"{arm}/wrist" for arm in ARMS) if settings.equipment.grippers else ()
    return (*CAMERAS, *wrists, *(each.name for each in settings.equipment.cameras))


def add_surroundings(spec: Any, settings: SceneSettings) -> None:
    """Add materials, sky, lights, cameras, table legs and pedestals."""
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
    for each in (*FIXED_CAMERAS, *settings.equipment.cameras):
        axes = _camera_axes(each.position_m, each.target_m)
        spec.worldbody.add_camera(name=each.name, pos=each.position_m, xyaxes=axes, fovy=each.fovy_deg)
    _add_furniture(spec, settings)


def _camera_axes(position: Vector3, target: Vector3) -> list[float]:
    """Return axes x and y of a camera that faces a target, the cell's z (or x, from above) upwards in the image."""
    backward = np.subtract(position, target)
    backward /= np.linalg.norm(backward)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    x = np.cross(up, backward)
    x /= np.linalg.norm(x)
    return [*x.tolist(), *np.cross(backward, x).tolist()]


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


_GRIPPER_MATERIALS: Final = {
    "shell": ((0.21, 0.22, 0.24, 1), 0.5, 0.5),
    "link": ((0.46, 0.48, 0.51, 1), 0.6, 0.6),
    "tip": ((0.32, 0.33, 0.36, 1), 0.4, 0.5),
    "steel": ((0.70, 0.72, 0.75, 1), 0.8, 0.8),
    "light": ((0.25, 0.65, 0.95, 1), 0.2, 0.2),
    "groove": ((0.20, 0.20, 0.22, 1), 0.1, 0.1),
    "glass": ((0.05, 0.07, 0.14, 1), 0.9, 0.9),
}  # colour, specular, shininess

_LENS: Final = (-0.0445, 0.0, 0.078)
_LENS_AIM: Final = (0.0, 0.0, 0.20)


def draw_gripper(arm: Any) -> None:
    """Add the visuals of the gripper of one arm's spec, and a camera `wrist` to it."""
    palm = arm.body("gripper")
    for name, (rgba, specular, shininess) in _GRIPPER_MATERIALS.items():
        arm.add_material(
            name=name, rgba=rgba, specular=specular, shininess=shininess, emission=0.5 if name == "light" else 0.0
        )
    style = arm.find_default("visual")
    _draw_palm(_Pen(palm, style))
    _draw_camera(palm, _Pen(palm, style))
    for i, sign in ((1, 1), (2, -1)):
        _draw_finger(_Pen(arm.body(f"finger_{i}"), style, sign))


class _Pen:
    """Adds visual parts to one body, y mirrored where `sign` is -1."""

    def __init__(self, body: Any, style: Any, sign: int = 1) -> None:
        self._body, self._style, self._sign = body, style, sign

    def box(self, low: tuple[float, ...], high: tuple[float, ...], material: str) -> None:
        """Box between two corners."""
        middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
        self._add("box", pos=middle * (1, self._sign, 1), size=half, material=material)

    def rod(self, a: tuple[float, ...], b: tuple[float, ...], radius: float, material: str, kind: str) -> None:
        """Cylinder or capsule between two points."""
        ends = np.array([a, b]) * (1, self._sign, 1)
        self._add(kind, fromto=ends.ravel(), size=(radius, 0, 0), material=material)

    def disc(self, y: float, low: float, high: float, radius: float, material: str, x: float = 0.0) -> None:
        """Cylinder along z."""
        self.rod((x, y, low), (x, y, high), radius, material, "cylinder")

    def oval(self, low: float, high: float, half_y: float, radius: float, material: str) -> None:
        """Plate with round ends at y = ±half_y."""
        self.box((-radius, -half_y, low), (radius, half_y, high), material)
        for y in (-half_y, half_y):
            self.disc(y, low, high, radius, material)

    def _add(self, kind: str, **attributes: Any) -> None:
        import mujoco

        self._body.add_geom(self._style, type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), **attributes)


def _draw_palm(pen: _Pen) -> None:
    pen.disc(0, 0.0, 0.0125, 0.0375, "steel")  # coupling
    pen.disc(0, 0.0125, 0.014, 0.0350, "rubber")
    pen.disc(0, 0.014, 0.044, 0.0365, "shell")
    pen.disc(0, 0.026, 0.029, 0.0369, "light")
    for step in range(1, 9):  # from round to wide
        z = 0.038 + 0.001 * step
        pen.oval(z, z + 0.001, 0.034 * step / 9, 0.0365 - 0.0075 * step / 9, "shell")
    pen.oval(0.047, 0.079, 0.034, 0.0290, "shell")
    pen.oval(0.0535, 0.0545, 0.034, 0.0293, "groove")
    pen.oval(0.079, 0.0815, 0.034, 0.0275, "groove")
    pen.oval(0.0815, 0.0845, 0.034, 0.0285, "housing")
    pen.box((-0.0155, -0.0590, 0.0845), (0.0155, 0.0590, 0.0848), "rubber")
    for x in (-0.0095, 0.0095):
        pen.rod((x, -0.0585, 0.0862), (x, 0.0585, 0.0862), 0.0028, "steel", "cylinder")  # rails
        for y in (-0.0605, 0.0605):
            pen.box((x - 0.004, y - 0.0022, 0.0845), (x + 0.004, y + 0.0022, 0.0895), "housing")
    pen.box((0.0280, -0.020, 0.060), (0.0294, 0.020, 0.074), "housing")  # name plate


def _draw_camera(palm: Any, pen: _Pen) -> None:
    x, _, z = _LENS
    pen.box((x - 0.0075, -0.017, z - 0.020), (x + 0.0075, 0.017, z - 0.001), "shell")
    pen.box((x + 0.0075, -0.012, z - 0.016), (-0.028, 0.012, z - 0.005), "housing")
    pen.disc(0, z - 0.001, z + 0.001, 0.0058, "steel", x)
    pen.disc(0, z + 0.001, z + 0.0013, 0.0045, "glass", x)
    forward = np.subtract(_LENS_AIM, _LENS)
    forward /= np.linalg.norm(forward)
    # Up in the image is the flange's -x: away from the base where the arm is at home.
    palm.add_camera(
        name="wrist",
        pos=(x, 0, z + 0.002),
        xyaxes=(0, -1, 0, -forward[2], 0, forward[0]),
        fovy=72,
    )


def _draw_finger(pen: _Pen) -> None:
    pen.box((-0.0130, 0.003, PALM_LENGTH_M), (0.0130, 0.020, 0.0965), "housing")  # carriage
    pen.box((-0.0055, 0.009, 0.0965), (0.0055, 0.0165, 0.132), "shell")
    for side in (-1, 1):
        x, edge = side * 0.0078, side * 0.0137
        pen.rod((x, 0.0140, 0.0985), (x, 0.0120, 0.1300), 0.0054, "link", "capsule")
        for y, z in ((0.0140, 0.0985), (0.0120, 0.1300)):
            pen.rod((x, y, z), (edge, y, z), 0.0038, "shell", "cylinder")  # pins
            pen.rod((x, y, z), (edge + side * 0.0002, y, z), 0.0019, "steel", "cylinder")
    low = TCP_M - PAD_LENGTH_M / 2
    pen.box((-0.0110, PAD_THICK_M, low - 0.004), (0.0110, 0.0145, FINGERTIP_M - 0.003), "tip")
    pen.box((-0.0110, PAD_THICK_M, FINGERTIP_M - 0.003), (0.0110, 0.0115, FINGERTIP_M), "tip")
    half = PAD_WIDTH_M / 2
    pen.box((-half, 0.0, low), (half, PAD_THICK_M - 0.0015, FINGERTIP_M), "rubber")
    pen.box((-half, PAD_THICK_M - 0.0015, low), (half, PAD_THICK_M, FINGERTIP_M), "steel")
    for k in range(1, 6):
        z = low + k * PAD_LENGTH_M / 6
        pen.box((-half - 0.0002, -0.0001, z - 0.0005), (half + 0.0002, 0.0012, z + 0.0005), "groove")


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
