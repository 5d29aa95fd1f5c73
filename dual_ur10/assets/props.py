"""Props of the package's own tasks: a bar for both arms, and a block to hand over with its target."""

from __future__ import annotations

import math
from typing import Final

from dual_ur10.assets.gripper import box_inertia
from dual_ur10.assets.prop import HeldCapsule, Prop
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Vector3

BAR_LENGTH_M: Final = 1.2
"""Along the bar's own y."""

BAR_WIDTH_M: Final = 0.04
"""Side of the bar's square section."""

BAR_MASS_KG: Final = 4.0

GRIP_DISTANCE_M: Final = 1.0
"""Distance of the bar's sites `left_grip` and `right_grip`, at y = ±0.5 m."""

BLOCK_SIZE_M: Final = (0.2, 0.04, 0.04)
"""The block's sides along its own x, y, z."""

BLOCK_MASS_KG: Final = 0.5

BLOCK_GRIP_M: Final = 0.05
"""Distance of each grip from the block's centre along its own x: the left gripper on the -x side, the right on +x."""

GRIP_QUAT: Final = (0.0, math.sqrt(0.5), -math.sqrt(0.5), 0.0)
"""w, x, y, z: orientation of either arm's tcp in the bar's frame when it grips from above.

The tool's x, y, z are the bar's -y, -x, -z. From `HOME_Q_RAD`, with the bar along the cell's y, wrist 3 rotates by
-90°, to near the middle of its range.
"""

BLOCK_GRIP_QUAT: Final = (0.0, 0.0, 1.0, 0.0)
"""w, x, y, z: orientation of the tcp in the block's frame when it grips from above: x, y, z are the block's -x, y, -z.

That of `HOME_Q_RAD`, with the block along the cell's x.
"""


_SKIN_M: Final = 0.0003  # thickness of painted marks

_MATERIALS: Final = {
    "metal": ((0.70, 0.72, 0.75, 1), 0.7, 0.7),
    "dark": ((0.16, 0.17, 0.19, 1), 0.3, 0.3),
    "grip_zone": ((0.93, 0.58, 0.16, 1), 0.2, 0.3),
    "front_half": ((0.93, 0.58, 0.16, 1), 0.3, 0.4),
    "back_half": ((0.14, 0.47, 0.60, 1), 0.3, 0.4),
    "front_target": ((0.84, 0.60, 0.30, 1), 0.0, 0.0),
    "back_target": ((0.34, 0.52, 0.57, 1), 0.0, 0.0),
    "outline": ((0.96, 0.96, 0.94, 1), 0.0, 0.0),
}
"""Colour, specular reflection and shininess."""


def _text(values: object) -> str:
    return " ".join(map(repr, values)) if isinstance(values, tuple) else repr(values)


def _painted(low: Vector3, high: Vector3, material: str) -> str:
    """Return a box that is drawn only, from one corner to the opposite one."""
    middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
    size = tuple((b - a) / 2 for a, b in zip(low, high, strict=True))
    return (
        f'<geom type="box" pos="{_text(middle)}" size="{_text(size)}" material="{material}" group="2" contype="0" '
        'conaffinity="0"/>'
    )


def _mjcf(body: str, materials: tuple[str, ...]) -> str:
    colours = "".join(
        f'<material name="{name}" rgba="{_text(rgba)}" specular="{specular}" shininess="{shininess}"/>'
        for name, (rgba, specular, shininess) in _MATERIALS.items()
        if name in materials
    )
    return f"<mujoco><asset>{colours}</asset><worldbody>{body}</worldbody></mujoco>"


def _box_body(name: str, mass_kg: float, size_m: Vector3, rest: str) -> str:
    """Return a free body with a box that collides."""
    inertia = box_inertia(mass_kg, *size_m)
    half = tuple(each / 2 for each in size_m)
    return (
        f'<body name="{name}" pos="0 0 {_text(half[2])}"><freejoint/>'
        f'<inertial mass="{_text(mass_kg)}" pos="0 0 0" diaginertia="{_text(inertia)}"/>'
        f'<geom name="{name}" type="box" size="{_text(half)}" group="3" condim="4" rgba="0.9 0.5 0.2 0.5"/>'
        f"{rest}</body>"
    )


def _bar_mjcf() -> str:
    half, end = BAR_WIDTH_M / 2, BAR_LENGTH_M / 2
    parts = [_painted((-half, -end + 0.008, -half), (half, end - 0.008, half), "metal")]
    for side in (-1, 1):
        y = side * (end - 0.004)
        parts.append(_painted((-half, y - 0.004, -half), (half, y + 0.004, half), "dark"))
        y, skin = side * GRIP_DISTANCE_M / 2, half + _SKIN_M
        parts.append(_painted((-skin, y - 0.03, -skin), (skin, y + 0.03, skin), "grip_zone"))
        for edge in (-0.031, 0.031):
            parts.append(_painted((-skin, y + edge - 0.002, -skin), (skin, y + edge + 0.002, skin), "dark"))
    # The slots of a profile, between the grips.
    parts.append(_painted((-half - _SKIN_M, -0.44, -0.004), (half + _SKIN_M, 0.44, 0.004), "dark"))
    parts.append(_painted((-0.004, -0.44, -half - _SKIN_M), (0.004, 0.44, half + _SKIN_M), "dark"))
    sites = "".join(
        f'<site name="{arm}_grip" pos="0 {_text(sign * GRIP_DISTANCE_M / 2)} 0" quat="{_text(GRIP_QUAT)}" group="4"/>'
        for arm, sign in zip(ARMS, (1, -1), strict=True)
    )
    size = (BAR_WIDTH_M, BAR_LENGTH_M, BAR_WIDTH_M)
    return _mjcf(_box_body("bar", BAR_MASS_KG, size, sites + "".join(parts)), ("metal", "dark", "grip_zone"))


def _block_mjcf() -> str:
    x, y, z = (each / 2 for each in BLOCK_SIZE_M)
    parts = [
        _painted((0.002, -y, -z), (x, y, z), "front_half"),
        _painted((-x, -y, -z), (-0.002, y, z), "back_half"),
        _painted((-0.002, -y + 0.0008, -z + 0.0008), (0.002, y - 0.0008, z - 0.0008), "dark"),
    ]
    for end in (-1, 1):
        a, b = sorted((end * (x - 0.012), end * (x - 0.009)))
        parts.append(_painted((a, -y - _SKIN_M, -z - _SKIN_M), (b, y + _SKIN_M, z + _SKIN_M), "outline"))
    materials = ("front_half", "back_half", "dark", "outline")
    return _mjcf(_box_body("block", BLOCK_MASS_KG, BLOCK_SIZE_M, "".join(parts)), materials)


def _target_mjcf() -> str:
    """Return a plate on the table below the target pose, its halves coloured like the block's."""
    x, y, z = (each / 2 for each in BLOCK_SIZE_M)
    low, high, edge = -z, -z + 0.0015, 0.004
    parts = [
        _painted((0, -y, low), (x, y, high), "front_target"),
        _painted((-x, -y, low), (0, y, high), "back_target"),
    ]
    for side in (-1, 1):
        a, b = sorted((side * y, side * (y + edge)))
        parts.append(_painted((-x - edge, a, low), (x + edge, b, high + 0.0004), "outline"))
        a, b = sorted((side * x, side * (x + edge)))
        parts.append(_painted((a, -y, low), (b, y, high + 0.0004), "outline"))
    body = f'<body name="target" mocap="true" pos="0 -0.3 {_text(z)}">{"".join(parts)}</body>'
    return _mjcf(body, ("front_target", "back_target", "outline"))


def _held(first_m: float, last_m: float, width_m: float) -> tuple[HeldCapsule, HeldCapsule]:
    """Return capsules from one end to another along the left tool's x, and mirrored along the right one's.

    Edges of a prop of square section protrude by 8 mm.
    """
    first, last, radius = first_m + width_m / 2, last_m - width_m / 2, width_m / 2
    return (
        HeldCapsule((first, 0.0, 0.0), (last, 0.0, 0.0), radius),
        HeldCapsule((-first, 0.0, 0.0), (-last, 0.0, 0.0), radius),
    )


BAR: Final = Prop(
    name="bar", mjcf=_bar_mjcf(), held=_held(-(BAR_LENGTH_M - GRIP_DISTANCE_M) / 2, GRIP_DISTANCE_M / 2, BAR_WIDTH_M)
)
"""Bar that both arms carry: of it, each carries the part up to the middle."""

BAR_WELDS: Final = tuple((f"{arm}/tcp", f"bar/{arm}_grip") for arm in ARMS)
"""Sites that are welded where grippers hold the bar rigidly."""

BLOCK: Final = Prop(
    name="block",
    mjcf=_block_mjcf(),
    held=_held(-(BLOCK_SIZE_M[0] / 2 + BLOCK_GRIP_M), BLOCK_SIZE_M[0] / 2 - BLOCK_GRIP_M, BLOCK_SIZE_M[1]),
)
"""Block that one arm hands to the other."""

TARGET: Final = Prop(name="target", mjcf=_target_mjcf())
"""Place on the table where the block is to lie."""
