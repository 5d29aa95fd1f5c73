"""Objects to handle: a bar for both arms, and a block to hand over."""

from __future__ import annotations

import math
from typing import Any, Final

from dual_ur10.assets.gripper import RIGID, box_inertia, stiff
from dual_ur10.assets.settings import PROPS, SceneSettings
from dual_ur10.errors import UnknownNameError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.types import Vector3

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


def prop_width_m(prop: str) -> float:
    """Return the width in m between the fingers that hold the prop.

    Raises:
        UnknownNameError: There is no such prop.
    """
    if prop not in PROPS:
        raise UnknownNameError("prop", str(prop), PROPS)
    return BAR_WIDTH_M if prop == "bar" else BLOCK_SIZE_M[1]


def prop_size_m(prop: str) -> Vector3:
    """Return the sides in m along the prop's own x, y, z.

    Raises:
        UnknownNameError: There is no such prop.
    """
    if prop not in PROPS:
        raise UnknownNameError("prop", str(prop), PROPS)
    return (BAR_WIDTH_M, BAR_LENGTH_M, BAR_WIDTH_M) if prop == "bar" else BLOCK_SIZE_M


def add_prop(spec: Any, settings: SceneSettings) -> None:
    """Add the prop of these settings, if any, at the origin of the table; after the arms, whose joints come first."""
    import mujoco

    prop = settings.equipment.prop
    if prop is None:
        return
    x, y, z = prop_size_m(prop)
    mass = BAR_MASS_KG if prop == "bar" else BLOCK_MASS_KG
    body = spec.worldbody.add_body(
        name=prop,
        pos=(0, 0, z / 2),
        mass=mass,
        ipos=(0, 0, 0),
        inertia=box_inertia(mass, x, y, z),
        explicitinertial=True,
    )
    body.add_freejoint(name=prop)
    body.add_geom(
        name=prop,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(x / 2, y / 2, z / 2),
        group=3,
        condim=4,
        rgba=(0.9, 0.5, 0.2, 0.5),
        solref=stiff(settings.timestep_s),
        solimp=RIGID,
    )
    if prop == "bar":
        for arm, sign in zip(ARMS, (1, -1), strict=True):
            body.add_site(name=f"{arm}_grip", pos=(0, sign * GRIP_DISTANCE_M / 2, 0), quat=GRIP_QUAT, group=4)
    else:
        # Target of the block. The model without visuals has it too, so that both have the same state.
        spec.worldbody.add_body(name="target", mocap=True, pos=(0, -0.3, z / 2))


def weld_bar(spec: Any) -> None:
    """Weld both grippers to the bar's grips, and exclude their contacts with it."""
    import mujoco

    for arm in ARMS:
        # Between sites: the anchor of a weld of bodies is easily misread. With MuJoCo's default solimp, 5 N·m would
        # rotate the gripper by 0.1° against the bar; with this one it is 0.006°.
        spec.add_equality(
            name=f"{arm}_grip",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1=f"{arm}/tcp",
            name2=f"{arm}_grip",
            solref=(0.004, 1),
            solimp=(0.999, 0.999, 0.001, 0.5, 2.0),
        )
        for body in ("gripper", "finger_1", "finger_2"):
            spec.add_exclude(name=f"{arm}-{body}", bodyname1=f"{arm}/{body}", bodyname2="bar")
