"""Everything in the cell that is only looked at: materials, sky, lights, cameras, table legs, pedestals."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.assets.settings import TABLE_THICKNESS_M, SceneSettings
from dual_ur10.kinematics.frames import FLOOR_Z_M
from dual_ur10.kinematics.ur10 import ARMS

_Point = tuple[float, float, float]

_CAMERAS: Final[dict[str, tuple[_Point, _Point]]] = {
    "front": ((1.8, 0.0, 1.0), (-0.4, 0.0, 0.3)),
    "side": ((-0.1, -2.6, 0.9), (-0.25, 0.0, 0.3)),
    "overhead": ((-0.25, 0.0, 3.2), (-0.2, 0.0, 0.0)),
    "perspective": ((1.4, -1.7, 1.35), (-0.35, 0.0, 0.25)),
}  # where each stands, and what it looks at

CAMERAS: Final = tuple(_CAMERAS)
"""Names of the fixed cameras; each shows both arms."""


def cameras(settings: SceneSettings) -> tuple[str, ...]:
    """Names of all cameras of a drawn scene: the fixed ones and, with grippers, `left/wrist` and `right/wrist`."""
    return (*CAMERAS, *(f"{arm}/wrist" for arm in ARMS)) if settings.equipment.grippers else CAMERAS


def add_surroundings(root: Any, settings: SceneSettings) -> None:
    """Everything that is only looked at: materials, sky, lights, cameras, table legs, pedestals."""
    root.statistic.center = (-0.2, 0.0, 0.25)
    root.statistic.extent = 1.6
    getattr(root.visual, "global").offwidth = 1920
    getattr(root.visual, "global").offheight = 1080
    root.visual.headlight.ambient = (0.35, 0.35, 0.35)
    root.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    root.visual.headlight.specular = (0.1, 0.1, 0.1)
    root.visual.quality.shadowsize = 4096
    root.visual.map.znear = 0.02
    _add_materials(root)
    for position, strength, shadow in (((0.6, 0.9, 3.5), 0.5, "true"), ((-1.0, -2.5, 3.0), 0.3, "false")):
        root.worldbody.add(
            "light",
            pos=position,
            dir=(-0.2 - position[0], -position[1], 0.2 - position[2]),
            cutoff=60,
            exponent=1,
            diffuse=(strength,) * 3,
            specular=(0.2,) * 3,
            castshadow=shadow,
        )
    for name, (position, target) in _CAMERAS.items():
        root.worldbody.add("camera", name=name, pos=position, xyaxes=_look(position, target), fovy=45)
    _add_furniture(root, settings)


def _look(position: _Point, target: _Point) -> list[float]:
    """Axes x and y of a camera that looks from one point to another, the cell's z (or x, from above) upwards."""
    backward = np.subtract(position, target)
    backward /= np.linalg.norm(backward)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    x = np.cross(up, backward)
    x /= np.linalg.norm(x)
    return [*x.tolist(), *np.cross(backward, x).tolist()]


def _add_materials(root: Any) -> None:
    asset = root.asset
    asset.add(
        "texture",
        name="sky",
        type="skybox",
        builtin="gradient",
        rgb1=(0.75, 0.82, 0.9),
        rgb2=(0.35, 0.42, 0.5),
        width=256,
        height=256,
    )
    asset.add(
        "texture",
        name="floor",
        type="2d",
        builtin="checker",
        rgb1=(0.42, 0.44, 0.46),
        rgb2=(0.38, 0.40, 0.42),
        width=256,
        height=256,
    )
    asset.add("material", name="floor", texture="floor", texrepeat=(1, 1), texuniform="true")
    asset.add("material", name="table_top", rgba=(0.62, 0.55, 0.45, 1), specular=0.1, shininess=0.2)
    asset.add("material", name="frame", rgba=(0.25, 0.27, 0.29, 1), specular=0.3, shininess=0.4)
    root.find("geom", "floor").material = "floor"
    root.find("geom", "table").material = "table_top"


def _add_furniture(root: Any, settings: SceneSettings) -> None:
    look = {"material": "frame", "contype": 0, "conaffinity": 0, "group": 2}
    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    height = -TABLE_THICKNESS_M - FLOOR_Z_M
    for sx in (-1, 1):
        for sy in (-1, 1):
            root.worldbody.add(
                "geom",
                type="box",
                pos=(x + sx * (length / 2 - 0.06), y + sy * (width / 2 - 0.06), FLOOR_Z_M + height / 2),
                size=(0.04, 0.04, height / 2),
                **look,
            )
    for mount in settings.mounts:
        px, py, pz = mount.position_m
        on_table = abs(px - x) < length / 2 and abs(py - y) < width / 2 and pz >= 0.0
        bottom = 0.0 if on_table else FLOOR_Z_M
        if pz - bottom < 0.05:
            continue  # the base stands on the table or on the floor itself
        for top, low, radius in ((pz, pz - 0.02, 0.13), (pz - 0.02, bottom, 0.09), (bottom + 0.02, bottom, 0.2)):
            root.worldbody.add(
                "geom",
                type="cylinder",
                pos=(px, py, (top + low) / 2),
                size=(radius, (top - low) / 2),
                **look,
            )
