"""A parallel-jaw gripper at the flange, of the size, stroke, force and mass of a Robotiq 2F-85.

Its frame is the flange's: z is the approach, the fingers open along y, the pads' width lies along x. Both fingers
slide; a stiff joint equality keeps them in step, as the mechanism of the real one does, so that gripped objects
stay centred. One position servo drives the sum of both finger positions: the opening. The real worm gear holds against
any load; this one yields to a force on one finger that exceeds the grip force.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from dual_ur10.assets.settings import GRIP_FORCE_N, SceneSettings
from dual_ur10.types import Vector3

OPENING_M: Final = 0.085
"""Stroke: largest distance of the pads (data sheet of the 2F-85)."""

TCP_M: Final = 0.15
"""Flange to tool centre point, the middle of the pads, along the flange's z."""

MASS_KG: Final = 0.925
"""Gripper with its coupling (data sheet of the 2F-85)."""

SPEED_M_S: Final = 0.15
"""Largest speed of the opening (data sheet of the 2F-85: 20 to 150 mm/s)."""

FORCE_N: Final = GRIP_FORCE_N
"""Least and largest grip force (data sheet of the 2F-85)."""

PAD_WIDTH_M: Final = 0.022
PAD_LENGTH_M: Final = 0.038
PAD_THICK_M: Final = 0.007

FINGER_JOINTS: Final = ("finger_1_joint", "finger_2_joint")
"""Slide joints of one gripper, 0 when closed to `OPENING_M / 2` m; finger 1 is the one at +y."""

PALM_LENGTH_M: Final = 0.086
"""From the flange to where the fingers begin."""

FINGERTIP_M: Final = TCP_M + PAD_LENGTH_M / 2
"""Flange to fingertips along the flange's z."""

# Capsule around the palm, along y. Edges of the visual palm and its camera protrude by up to 12 mm.
_PALM_RADIUS_M: Final = 0.05
_PALM_HALF_M: Final = 0.035
_PALM_Z_M: Final = 0.048

_FINGER_MASS_KG: Final = 0.06
_FINGER_THICK_M: Final = 0.020  # pad and what carries it
_FINGER_HALF_X_M: Final = 0.014

# Reflected inertia of the drive at each finger. The real one has a worm gear and cannot be pushed open, its rotor's
# inertia is not published. This value makes the servo well damped at any timestep of a few ms.
_ARMATURE_KG: Final = 1.0
# On the opening: 200 rad/s, critically damped with both fingers' inertia; the lag in a ramp is kv / kp = 11 ms.
KP_N_M: Final = 20_000.0
_KV: Final = 220.0

RIGID: Final = (0.99, 0.999, 0.001, 0.5, 2.0)
"""`solimp` of contacts and constraints that hardly yield."""


def stiff(timestep_s: float) -> tuple[float, float]:
    """Return `solref` of the pads' contacts and of the coupling: as stiff as the timestep allows, critically damped."""
    return max(0.002, 2 * timestep_s), 1.0


def add_gripper(arm: Any, settings: SceneSettings, *, rigid: bool = False) -> None:
    """Put a gripper on the flange of one arm's spec.

    Args:
        arm: `MjSpec` of `arm.arm_spec`.
        settings: Settings of the cell.
        rigid: For the collision model: no joints and no actuator, the fingers' mass at half opening, and a box
            `fingers` and a capsule `fingers_round` around all positions of the fingers.
    """
    flange, solid = arm.site("flange"), arm.find_default("collision")
    mass = MASS_KG - 2 * _FINGER_MASS_KG
    body = arm.body("wrist_3_link").add_body(
        name="gripper",
        pos=flange.pos,
        quat=flange.quat,
        gravcomp=1,
        mass=mass,
        ipos=(0, 0, 0.047),
        inertia=box_inertia(mass, 0.07, 0.10, PALM_LENGTH_M),
        explicitinertial=True,
    )
    body.add_site(name="wrench")
    body.add_site(name="tcp", pos=(0, 0, TCP_M))
    body.add_geom(
        solid,
        name="palm",
        fromto=(0, -_PALM_HALF_M, _PALM_Z_M, 0, _PALM_HALF_M, _PALM_Z_M),
        size=(_PALM_RADIUS_M, 0, 0),
    )
    for i, sign in ((1, 1), (2, -1)):
        _add_finger(body, solid, i, sign, settings, rigid=rigid)
    if rigid:
        _add_reach(body, solid)
    else:
        _couple(arm, settings)


def _add_reach(palm: Any, solid: Any) -> None:
    """Add a box around all positions of the fingers, and a capsule along y around that box."""
    import mujoco

    half = np.array([_FINGER_HALF_X_M, OPENING_M / 2 + _FINGER_THICK_M, (FINGERTIP_M - PALM_LENGTH_M) / 2])
    z = FINGERTIP_M - half[2]
    palm.add_geom(solid, name="fingers", type=mujoco.mjtGeom.mjGEOM_BOX, pos=(0, 0, z), size=half)
    along = half[1] - 0.025
    radius = math.hypot(half[0], half[1] - along, half[2])
    palm.add_geom(solid, name="fingers_round", fromto=(0, -along, z, 0, along, z), size=(radius, 0, 0))


def _add_finger(palm: Any, solid: Any, i: int, sign: int, settings: SceneSettings, *, rigid: bool) -> None:
    import mujoco

    open_m = OPENING_M / 4 if rigid else 0.0
    middle_m = (PALM_LENGTH_M + FINGERTIP_M) / 2
    finger = palm.add_body(
        name=f"finger_{i}",
        pos=(0, sign * open_m, 0),
        gravcomp=1,
        mass=_FINGER_MASS_KG,
        ipos=(0, sign * _FINGER_THICK_M / 2, middle_m),
        inertia=box_inertia(_FINGER_MASS_KG, 0.022, _FINGER_THICK_M, FINGERTIP_M - PALM_LENGTH_M),
        explicitinertial=True,
    )
    if rigid:
        return
    finger.add_joint(
        name=f"finger_{i}_joint",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(0, sign, 0),
        range=(0, OPENING_M / 2),
        armature=_ARMATURE_KG,
        solref_limit=stiff(settings.timestep_s),
    )
    depth_m = _FINGER_THICK_M - PAD_THICK_M
    finger.add_geom(
        solid,
        name=f"finger_{i}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, sign * (PAD_THICK_M + depth_m / 2), middle_m),
        size=(_FINGER_HALF_X_M, depth_m / 2, (FINGERTIP_M - PALM_LENGTH_M) / 2),
    )
    finger.add_geom(
        solid,
        name=f"pad_{i}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, sign * PAD_THICK_M / 2, TCP_M),
        size=(PAD_WIDTH_M / 2, PAD_THICK_M / 2, PAD_LENGTH_M / 2),
        friction=(1.0, 0.02, 0.0001),
        priority=1,
        condim=4,
        solref=stiff(settings.timestep_s),
        solimp=RIGID,
    )


def _couple(arm: Any, settings: SceneSettings) -> None:
    import mujoco

    arm.add_exclude(name="fingers", bodyname1="finger_1", bodyname2="finger_2")
    equality = arm.add_equality(
        name="fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=FINGER_JOINTS[0],
        name2=FINGER_JOINTS[1],
        solref=stiff(settings.timestep_s),
        solimp=RIGID,
    )
    equality.data[:5] = (0, 1, 0, 0, 0)  # finger 1 is where finger 2 is
    opening = arm.add_tendon(name="opening")
    for joint in FINGER_JOINTS:
        opening.wrap_joint(joint, 1)
    force = settings.equipment.grip_force_n
    servo = arm.add_actuator(
        name="gripper",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target="opening",
        ctrlrange=(0, OPENING_M),
        forcerange=(-force, force),
    )
    servo.set_to_position(kp=KP_N_M, kv=_KV)


def box_inertia(mass_kg: float, x_m: float, y_m: float, z_m: float) -> Vector3:
    """Return the diagonal inertia, kg·m², of a box of these sides about its centre."""
    twelfth = mass_kg / 12
    return twelfth * (y_m**2 + z_m**2), twelfth * (x_m**2 + z_m**2), twelfth * (x_m**2 + y_m**2)
