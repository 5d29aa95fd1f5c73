"""What of the props is only looked at: colours that show where to grip and which way round they are."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.assets.props import BAR_LENGTH_M, BAR_WIDTH_M, BLOCK_SIZE_M, GRIP_DISTANCE_M

_MATERIALS: Final = {
    "metal": ((0.70, 0.72, 0.75, 1), 0.7, 0.7),
    "dark": ((0.16, 0.17, 0.19, 1), 0.3, 0.3),
    "grip_zone": ((0.93, 0.58, 0.16, 1), 0.2, 0.3),
    "front_half": ((0.93, 0.58, 0.16, 1), 0.3, 0.4),
    "back_half": ((0.14, 0.47, 0.60, 1), 0.3, 0.4),
    "front_target": ((0.84, 0.60, 0.30, 1), 0.0, 0.0),
    "back_target": ((0.34, 0.52, 0.57, 1), 0.0, 0.0),
    "outline": ((0.96, 0.96, 0.94, 1), 0.0, 0.0),
}  # colour, specular, shininess

_SKIN_M: Final = 0.0003  # what is painted on stands this far out


def draw_prop(root: Any, prop: str) -> None:
    """Draw the prop in a cell's tree."""
    for name, (rgba, specular, shininess) in _MATERIALS.items():
        root.asset.add("material", name=name, rgba=rgba, specular=specular, shininess=shininess)
    if prop == "bar":
        _draw_bar(root.find("body", "bar"))
    else:
        _draw_block(root.find("body", "block"))
        _draw_target(root.find("body", "target"))


def _box(body: Any, low: tuple[float, ...], high: tuple[float, ...], material: str) -> None:
    body.add(
        "geom",
        type="box",
        pos=np.add(low, high) / 2,
        size=np.subtract(high, low) / 2,
        material=material,
        group=2,
        contype=0,
        conaffinity=0,
    )


def _draw_bar(bar: Any) -> None:
    half, end = BAR_WIDTH_M / 2, BAR_LENGTH_M / 2
    _box(bar, (-half, -end + 0.008, -half), (half, end - 0.008, half), "metal")
    for side in (-1, 1):
        y = side * (end - 0.004)
        _box(bar, (-half, y - 0.004, -half), (half, y + 0.004, half), "dark")
        y, skin = side * GRIP_DISTANCE_M / 2, half + _SKIN_M
        _box(bar, (-skin, y - 0.03, -skin), (skin, y + 0.03, skin), "grip_zone")
        for edge in (-0.031, 0.031):
            _box(bar, (-skin, y + edge - 0.002, -skin), (skin, y + edge + 0.002, skin), "dark")
    # The slots of a profile, between the grips.
    _box(bar, (-half - _SKIN_M, -0.44, -0.004), (half + _SKIN_M, 0.44, 0.004), "dark")
    _box(bar, (-0.004, -0.44, -half - _SKIN_M), (0.004, 0.44, half + _SKIN_M), "dark")


def _draw_block(block: Any) -> None:
    x, y, z = np.array(BLOCK_SIZE_M) / 2
    _box(block, (0.002, -y, -z), (x, y, z), "front_half")
    _box(block, (-x, -y, -z), (-0.002, y, z), "back_half")
    _box(block, (-0.002, -y + 0.0008, -z + 0.0008), (0.002, y - 0.0008, z - 0.0008), "dark")
    for end in (-1, 1):
        a, b = sorted((end * (x - 0.012), end * (x - 0.009)))
        _box(block, (a, -y - _SKIN_M, -z - _SKIN_M), (b, y + _SKIN_M, z + _SKIN_M), "outline")


def _draw_target(target: Any) -> None:
    """A plate on the table below the wanted pose, its halves coloured like the block's."""
    x, y, z = np.array(BLOCK_SIZE_M) / 2
    low, high = -z, -z + 0.0015
    _box(target, (0, -y, low), (x, y, high), "front_target")
    _box(target, (-x, -y, low), (0, y, high), "back_target")
    edge = 0.004
    for side in (-1, 1):
        a, b = sorted((side * y, side * (y + edge)))
        _box(target, (-x - edge, a, low), (x + edge, b, high + 0.0004), "outline")
        a, b = sorted((side * x, side * (x + edge)))
        _box(target, (a, -y, low), (b, y, high + 0.0004), "outline")
