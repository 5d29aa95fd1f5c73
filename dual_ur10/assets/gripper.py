"""Composition of a tool at the flange of an arm: two fingers that slide, one servo for their distance.

A stiff joint equality keeps both fingers in step, as the mechanism of a parallel gripper does, so that gripped objects
stay centred. One position servo drives the sum of both finger positions: the opening.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, Final

import numpy as np

from dual_ur10.errors import SettingsError
from ur_core.tools.tool import Tool
from ur_core.types import Array, Vector3

FINGER_JOINTS: Final = ("finger_1_joint", "finger_2_joint")
"""Slide joints of one gripper, 0 when closed to half its stroke in m; finger 1 is the one at +y."""

RIGID: Final = (0.99, 0.999, 0.001, 0.5, 2.0)
"""`solimp` of contacts and constraints that hardly yield."""

_BODIES: Final = ("gripper", "finger_1", "finger_2")
_SITES: Final = ("wrench", "tcp")
_NEAR: Final = 1e-6
_PROTRUDES_M: Final = 0.001


def stiff(timestep_s: float) -> tuple[float, float]:
    """Return `solref` of the pads' contacts and of the coupling: as stiff as the timestep allows, critically damped."""
    return max(0.002, 2 * timestep_s), 1.0


def add_gripper(arm: Any, tool: Tool, timestep_s: float, force_n: float) -> None:
    """Put a tool that is composed of its figures on the flange of one arm's spec, with fingers that move.

    Args:
        arm: `MjSpec` of `arm.arm_spec`.
        tool: The tool.
        timestep_s: Physics timestep.
        force_n: Grip force.
    """
    palm = _add_palm(arm, tool)
    for i, sign in ((1, 1), (2, -1)):
        _add_joint(_add_finger(palm, tool, i, sign, 0.0), arm, tool, i, sign, timestep_s)
    _couple(arm, tool, timestep_s, force_n)


def add_rigid_gripper(arm: Any, tool: Tool) -> None:
    """Put a tool on the flange of one arm's spec for the collision model.

    It has no joints and no actuator, the fingers' mass at half opening, and a box `fingers` and a capsule
    `fingers_round` around all positions of the fingers.

    Args:
        arm: `MjSpec` of `arm.arm_spec`.
        tool: The tool.
    """
    import mujoco

    palm, solid = _add_palm(arm, tool), arm.find_default("collision")
    for i, sign in ((1, 1), (2, -1)):
        _add_finger(palm, tool, i, sign, tool.stroke_m / 4)
    half = np.array(
        [tool.finger_width_m / 2, tool.stroke_m / 2 + tool.finger_thick_m, (tool.fingertip_m - tool.palm_m) / 2]
    )
    z = tool.fingertip_m - half[2]
    palm.add_geom(solid, name="fingers", type=mujoco.mjtGeom.mjGEOM_BOX, pos=(0, 0, z), size=half)
    along = max(half[1] - 0.025, 0.001)  # MuJoCo takes no capsule without a length
    radius = math.hypot(half[0], half[1] - along, half[2])
    palm.add_geom(solid, name="fingers_round", fromto=(0, -along, z, 0, along, z), size=(radius, 0, 0))


def _add_palm(arm: Any, tool: Tool) -> Any:
    flange, mass = arm.site("flange"), tool.mass_kg - 2 * tool.finger_mass_kg
    palm = arm.body("wrist_3_link").add_body(
        name="gripper",
        pos=flange.pos,
        quat=flange.quat,
        gravcomp=1,
        mass=mass,
        ipos=(0, 0, tool.com_m),
        inertia=box_inertia(mass, *tool.palm_size_m, tool.palm_m),
        explicitinertial=True,
    )
    palm.add_site(name="wrench")
    palm.add_site(name="tcp", pos=(0, 0, tool.tcp_m))
    palm.add_geom(
        arm.find_default("collision"),
        name="palm",
        fromto=(0, -tool.palm_half_m, tool.palm_z_m, 0, tool.palm_half_m, tool.palm_z_m),
        size=(tool.palm_radius_m, 0, 0),
    )
    return palm


def _add_finger(palm: Any, tool: Tool, i: int, sign: int, open_m: float) -> Any:
    return palm.add_body(
        name=f"finger_{i}",
        pos=(0, sign * open_m, 0),
        gravcomp=1,
        mass=tool.finger_mass_kg,
        ipos=(0, sign * tool.finger_thick_m / 2, (tool.palm_m + tool.fingertip_m) / 2),
        inertia=box_inertia(tool.finger_mass_kg, tool.pad_m[0], tool.finger_thick_m, tool.fingertip_m - tool.palm_m),
        explicitinertial=True,
    )


def _add_joint(finger: Any, arm: Any, tool: Tool, i: int, sign: int, timestep_s: float) -> None:
    """Let a finger slide, and add what may touch."""
    import mujoco

    finger.add_joint(
        name=f"finger_{i}_joint",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(0, sign, 0),
        range=(0, tool.stroke_m / 2),
        armature=tool.armature_kg,
        solref_limit=stiff(timestep_s),
    )
    solid, (width_m, thick_m, length_m) = arm.find_default("collision"), tool.pad_m
    depth_m = tool.finger_thick_m - thick_m
    finger.add_geom(
        solid,
        name=f"finger_{i}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, sign * (thick_m + depth_m / 2), (tool.palm_m + tool.fingertip_m) / 2),
        size=(tool.finger_width_m / 2, depth_m / 2, (tool.fingertip_m - tool.palm_m) / 2),
    )
    finger.add_geom(
        solid,
        name=f"pad_{i}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0, sign * thick_m / 2, tool.tcp_m),
        size=(width_m / 2, thick_m / 2, length_m / 2),
        friction=(1.0, 0.02, 0.0001),
        priority=1,
        condim=4,
        solref=stiff(timestep_s),
        solimp=RIGID,
    )


def _couple(arm: Any, tool: Tool, timestep_s: float, force_n: float) -> None:
    import mujoco

    arm.add_exclude(name="fingers", bodyname1="finger_1", bodyname2="finger_2")
    equality = arm.add_equality(
        name="fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=FINGER_JOINTS[0],
        name2=FINGER_JOINTS[1],
        solref=stiff(timestep_s),
        solimp=RIGID,
    )
    equality.data[:5] = (0, 1, 0, 0, 0)  # finger 1 is where finger 2 is
    opening = arm.add_tendon(name="opening")
    for joint in FINGER_JOINTS:
        opening.wrap_joint(joint, 1)
    servo = arm.add_actuator(
        name="gripper",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target="opening",
        ctrlrange=(0, tool.stroke_m),
        forcerange=(-force_n, force_n),
    )
    servo.set_to_position(kp=tool.servo_kp, kv=tool.servo_kv)


def attach_own(spec: Any, name: str, tool: Tool, force_n: float) -> None:
    """Attach a tool with an MJCF of its own to the flange of an arm in a cell's spec.

    Args:
        spec: `MjSpec` of the cell, with the arm.
        name: Name of the arm.
        tool: The tool.
        force_n: Grip force.

    Raises:
        SettingsError: The MJCF is wrong, lacks a part, or does not fit the tool's figures.
    """
    import mujoco

    try:
        own = mujoco.MjSpec.from_string(tool.mjcf)
        model = own.copy().compile()
    except ValueError as error:
        raise SettingsError(f"mjcf of the tool {tool.name!r} is wrong: {error}") from error
    if own.cameras:
        raise SettingsError(
            f"mjcf of the tool {tool.name!r} has a camera: leave it out, and give the tool a Camera, Tool(cameras=...)"
        )
    for kind, names in (("body", _BODIES), ("site", _SITES), ("joint", FINGER_JOINTS), ("actuator", ("gripper",))):
        for each in names:
            if getattr(own, kind)(each) is None:
                raise SettingsError(f"mjcf of the tool {tool.name!r} has no {kind} {each!r}: add it, or name it so")
    _check_figures(model, tool)
    flange = spec.site(f"{name}/flange")
    frame = spec.body(f"{name}/wrist_3_link").add_frame(pos=flange.pos, quat=flange.quat)
    spec.attach(own, prefix=f"{name}/", frame=frame)
    spec.actuator(f"{name}/gripper").forcerange = (-force_n, force_n)


def _check_figures(model: Any, tool: Tool) -> None:
    """Compare an MJCF with the figures that the safety gate and the tasks take.

    Raises:
        SettingsError: They differ.
    """
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, wanted in (("wrench", (0.0, 0.0, 0.0)), ("tcp", (0.0, 0.0, tool.tcp_m))):
        site = data.site(name)
        if np.abs(site.xpos - wanted).max() > _NEAR or np.abs(site.xmat - np.eye(3).ravel()).max() > _NEAR:
            x, y, z = site.xpos.tolist()
            raise SettingsError(
                f"site {name!r} in the mjcf of the tool {tool.name!r} is at ({x:.4g}, {y:.4g}, {z:.4g}) m: it must be "
                f"at (0, 0, {wanted[2]:g}) with the flange's axes, as tcp_m says; put it there, or correct tcp_m"
            )
    found = {
        "stroke_m": model.actuator("gripper").ctrlrange[1],
        "mass_kg": model.body_subtreemass[model.body("gripper").id],
    }
    for figure, value in found.items():
        if abs(value - getattr(tool, figure)) > _NEAR:
            raise SettingsError(
                f"{figure} of the tool {tool.name!r} is {getattr(tool, figure):g}, and {value:g} in its mjcf: write "
                "the same"
            )
    for open_m in (0.0, tool.stroke_m / 2):
        for joint in FINGER_JOINTS:
            data.joint(joint).qpos = open_m
        mujoco.mj_kinematics(model, data)
        for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
            for point in _corners(model, data, int(geom)):
                if _outside_m(tool, point) > _PROTRUDES_M:
                    x, y, z = point.tolist()
                    raise SettingsError(
                        f"geom {model.geom(geom).name!r} of the tool {tool.name!r} reaches ({x:.4g}, {y:.4g}, {z:.4g}) "
                        "m at the flange, outside of palm and fingers as the safety gate knows them: enlarge the "
                        "tool's figures"
                    )


def _corners(model: Any, data: Any, geom: int) -> Array:
    """Return the outermost points of a geom in the flange's frame, (k, 3)."""
    import mujoco

    place, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        along = size[1] * rotation[:, 2] * (kind == mujoco.mjtGeom.mjGEOM_CAPSULE)
        around = size[0] * np.concatenate([np.eye(3), -np.eye(3)])
        return np.concatenate([place + along + around, place - along + around])
    middle, half = model.geom_aabb[geom].reshape(2, 3)
    signs = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    corners: Array = place + (middle + signs * half) @ rotation.T
    return corners


def _outside_m(tool: Tool, point: Array) -> float:
    """Return the distance of a point from the shapes that the safety gate knows, 0 or below inside of them."""
    x, y, z = np.abs(point[0]), np.abs(point[1]), point[2]
    palm = math.hypot(x, max(y - tool.palm_half_m, 0.0), z - tool.palm_z_m) - tool.palm_radius_m
    beside = x - tool.finger_width_m / 2, y - tool.stroke_m / 2 - tool.finger_thick_m
    return float(min(palm, max(*beside, tool.palm_m - z, z - tool.fingertip_m)))


def box_inertia(mass_kg: float, x_m: float, y_m: float, z_m: float) -> Vector3:
    """Return the diagonal inertia, kg·m², of a box of these sides about its centre."""
    twelfth = mass_kg / 12
    return twelfth * (y_m**2 + z_m**2), twelfth * (x_m**2 + z_m**2), twelfth * (x_m**2 + y_m**2)
