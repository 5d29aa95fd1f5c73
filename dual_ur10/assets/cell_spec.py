"""Parts shared by all models of a cell, as MuJoCo's `MjSpec`: options, floor, table, both arms, obstacles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from dual_ur10.assets.gripper import FINGER_JOINTS
from dual_ur10.assets.obstacles import Box, Obstacle, Plane, geom_name
from dual_ur10.assets.settings import TABLE_THICKNESS_M, SceneSettings
from dual_ur10.errors import DualUR10Error
from ur_core.kinematics.frames import FLOOR_Z_M, ArmMount
from ur_core.kinematics.rotations import quat_from_rotvec
from ur_core.kinematics.ur10 import ARMS, JOINTS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own

_POINT_M: Final = 1e-6  # MuJoCo has no capsule of no length
_COLOUR: Final = (0.78, 0.42, 0.30, 1.0)
_COLOUR_OF_WALLS: Final = (0.78, 0.42, 0.30, 0.35)  # transparent
_WALL_M: Final = 3.0  # half the side of the visible piece of a wall


def cell_spec(settings: SceneSettings) -> Any:
    """Return the `MjSpec` of a cell without arms: options, floor and table."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "cell"
    spec.compiler.degree = False
    spec.option.timestep = settings.timestep_s
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{settings.integrator.upper()}")
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    if settings.equipment.grippers or settings.equipment.props:
        spec.option.impratio = 100  # divides the rate at which gripped objects creep
    # A diverged simulation must be seen by the caller, not silently start again from t = 0.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _add_ground(spec, settings)
    return spec


def _add_ground(spec: Any, settings: SceneSettings) -> None:
    import mujoco

    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    kinds, world = mujoco.mjtGeom, spec.worldbody
    world.add_geom(name="floor", type=kinds.mjGEOM_PLANE, pos=(0, 0, FLOOR_Z_M), size=(6, 6, 0.1))
    world.add_geom(
        name="table",
        type=kinds.mjGEOM_BOX,
        pos=(x, y, -TABLE_THICKNESS_M / 2),
        size=(length / 2, width / 2, TABLE_THICKNESS_M / 2),
    )


def attach_arm(spec: Any, arm: Any, name: str, mount: ArmMount) -> None:
    """Attach an arm to the world of a cell; its names get the prefix `<name>/`.

    Args:
        spec: Spec of the cell.
        arm: Spec of the arm, of `arm.arm_spec`.
        name: Name of the arm.
        mount: Pose of its base.
    """
    base = spec.worldbody.add_body(name=f"{name}/", pos=mount.position_m, quat=mount.quat)
    spec.attach(arm, prefix=f"{name}/", frame=base.add_frame())


def add_obstacles(spec: Any, obstacles: tuple[Obstacle, ...]) -> None:
    """Add obstacles to the world of a model, after its other geoms.

    Args:
        spec: Spec of the cell.
        obstacles: Obstacles to add.
    """
    for each in obstacles:
        colour = _COLOUR_OF_WALLS if isinstance(each, Plane) else _COLOUR
        spec.worldbody.add_geom(name=geom_name(each), rgba=colour, **_geom_of(each))


def _geom_of(obstacle: Obstacle) -> dict[str, Any]:
    import mujoco

    kinds = mujoco.mjtGeom
    if isinstance(obstacle, Box):
        return {
            "type": kinds.mjGEOM_BOX,
            "pos": obstacle.position_m,
            "quat": quat_from_rotvec(obstacle.rotation_rad),
            "size": [size / 2 for size in obstacle.size_m],
        }
    if isinstance(obstacle, Plane):
        return {
            "type": kinds.mjGEOM_PLANE,
            "pos": obstacle.point_m,
            "zaxis": obstacle.normal,
            "size": (_WALL_M, _WALL_M, 0.1),
        }
    length = math.dist(obstacle.from_m, obstacle.to_m)
    if length < _POINT_M:
        return {"type": kinds.mjGEOM_SPHERE, "pos": obstacle.from_m, "size": (obstacle.radius_m + length, 0, 0)}
    return {
        "type": kinds.mjGEOM_CAPSULE,
        "fromto": (*obstacle.from_m, *obstacle.to_m),
        "size": (obstacle.radius_m, 0, 0),
    }


def joint_names(settings: SceneSettings) -> tuple[str, ...]:
    """Return the joints of the cell in the order of `qpos`: left arm, left fingers, right arm, right fingers, props."""
    each = (*JOINTS, *FINGER_JOINTS) if settings.equipment.grippers else JOINTS
    props = (joint for prop in settings.equipment.props for joint in prop.joint_names)
    return (*(f"{arm}/{joint}" for arm in ARMS for joint in each), *props)


def actuator_names(settings: SceneSettings) -> tuple[str, ...]:
    """Return the actuators of the cell in the order of `ctrl`: left arm, left gripper, right arm, right gripper."""
    each = (*JOINTS, "gripper") if settings.equipment.grippers else JOINTS
    return tuple(f"{arm}/{actuator}" for arm in ARMS for actuator in each)


def compiled(spec: Any, joints: tuple[str, ...], actuators: tuple[str, ...]) -> mujoco.MjModel:
    """Return the compiled model, with joints and actuators in the order of all arrays of this package.

    Raises:
        DualUR10Error: Their order differs.
    """
    model = spec.compile()
    found_joints = tuple(model.joint(i).name for i in range(model.njnt))
    found_actuators = tuple(model.actuator(i).name for i in range(model.nu))
    for kind, found, expected in (("joints", found_joints, joints), ("actuators", found_actuators, actuators)):
        if found != expected:
            raise DualUR10Error(
                f"the model's {kind} are {list(found)}, expected {list(expected)}: the specs and the names disagree"
            )
    return model
