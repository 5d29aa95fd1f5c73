"""The cell: two UR10s as ``left/`` and ``right/``, a table between them, floor, lights and cameras.

[compose][dual_ur10.assets.scene.compose] makes the `MjSpec` of a cell;
[build_model][dual_ur10.assets.scene.build_model] returns its model, compiled once per settings, as a copy that the
caller may change. Distances are measured with [collision_model][dual_ur10.assets.collision_model]. Importing this
module does not load mujoco.

Cell frame: origin on the table top midway between the arms' workspaces, x forward (away from the bases), y left, z up.
"""

from __future__ import annotations

import copy
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from dual_ur10.assets.cell_spec import actuator_names, add_obstacles, attach_arm, cell_spec, compiled, joint_names
from dual_ur10.assets.gripper import add_gripper, attach_own
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.assets.visuals import add_cameras, add_surroundings, draw_gripper, use_meshes
from dual_ur10.errors import DualUR10Error, SettingsError
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.arm import arm_spec, remove_visuals

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own


def compose(settings: SceneSettings, *, visuals: bool = True) -> Any:
    """Return a fresh `MjSpec` of the whole cell. `to_xml()` writes it, unless a tool has an MJCF of its own.

    Joints, actuators and degrees of freedom: the left arm's six, then the right arm's six. With grippers, each arm's
    are followed by its gripper's (two finger joints, one actuator: the opening in m). Props' joints are the last.
    Sensors, each for left and right: `<arm>/flange_base_pos` and `<arm>/flange_base_quat`
    (flange in the arm's own UR `base` frame, m and w, x, y, z) and `<arm>/flange_pos` (flange in the cell frame, m);
    with grippers also `<arm>/wrench_force` and `<arm>/wrench_torque` (N and N·m at the flange, in its axes, that the
    wrist exerts on the gripper: a gripper at rest that points down reads minus its weight along z).

    Args:
        settings: Settings of the cell.
        visuals: Include the visual-only parts. Without them the model has the same state and dynamics, and a step
            costs a quarter less: simulate without, render with.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    spec = cell_spec(settings)
    if visuals:
        add_surroundings(spec, settings)
    equipment = settings.equipment
    for name, mount, tool in zip(ARMS, settings.mounts, equipment.tools, strict=True):
        arm = arm_spec(mount.dh, settings.gains)
        if not visuals:
            remove_visuals(arm)
        if equipment.grippers and not tool.mjcf:
            add_gripper(arm, tool, settings.timestep_s, equipment.grip_force_n)
            if visuals:
                draw_gripper(arm, tool)
        attach_arm(spec, arm, name, mount)
        if equipment.grippers and tool.mjcf:
            attach_own(spec, name, tool, equipment.grip_force_n)
    for prop in equipment.props:
        prop.add_to(spec, settings.timestep_s, visuals=visuals)
    add_obstacles(spec, settings.obstacles)
    _add_flange_sensors(spec)
    if equipment.grippers:
        _add_wrench_sensors(spec)
    _add_welds(spec, settings)
    add_cameras(spec, settings, visuals=visuals)
    if settings.meshes and visuals:
        use_meshes(spec)
    return spec


def build_model(settings: SceneSettings, *, visuals: bool = True) -> mujoco.MjModel:
    """Return a fresh model of the cell.

    Args:
        settings: Settings of the cell.
        visuals: Include the visual-only parts; see `compose`.

    Returns:
        The compiled model; the caller may change it.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    return copy.copy(_model(settings, visuals))  # compiling takes ten times as long


@lru_cache(maxsize=16)
def _model(settings: SceneSettings, visuals: bool) -> mujoco.MjModel:
    try:
        return compiled(compose(settings, visuals=visuals), joint_names(settings), actuator_names(settings))
    except ValueError as error:
        for prop in settings.equipment.props:
            prop.check()  # names the one that is the cause
        if isinstance(error, DualUR10Error):
            raise
        raise SettingsError(f"the scene cannot be compiled: {error}") from error


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice]:
    """Return the slice of `sensordata` of each named sensor."""
    return {
        model.sensor(i).name: slice(int(model.sensor_adr[i]), int(model.sensor_adr[i]) + int(model.sensor_dim[i]))
        for i in range(model.nsensor)
    }


def _add_flange_sensors(spec: Any) -> None:
    import mujoco

    kinds, site = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE
    for kind, suffix, relative in (
        (kinds.mjSENS_FRAMEPOS, "flange_base_pos", True),
        (kinds.mjSENS_FRAMEQUAT, "flange_base_quat", True),
        (kinds.mjSENS_FRAMEPOS, "flange_pos", False),
    ):
        for arm in ARMS:
            reference = {"reftype": site, "refname": f"{arm}/base"} if relative else {}
            spec.add_sensor(name=f"{arm}/{suffix}", type=kind, objtype=site, objname=f"{arm}/flange", **reference)


def _add_wrench_sensors(spec: Any) -> None:
    import mujoco

    kinds = {"force": mujoco.mjtSensor.mjSENS_FORCE, "torque": mujoco.mjtSensor.mjSENS_TORQUE}
    for word, kind in kinds.items():
        for arm in ARMS:
            spec.add_sensor(
                name=f"{arm}/wrench_{word}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{arm}/wrench"
            )


def _add_welds(spec: Any, settings: SceneSettings) -> None:
    """Weld grippers to sites of props, and exclude their contacts with the bodies of these sites."""
    import mujoco

    for tcp, site in settings.equipment.welds:
        arm, body = tcp.split("/")[0], _body_of(spec, site)
        # Between sites: the anchor of a weld of bodies is easily misread. With MuJoCo's default solimp, 5 N·m would
        # rotate the gripper by 0.1° against the bar; with this one it is 0.006°.
        spec.add_equality(
            name=f"{arm}_grip",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1=tcp,
            name2=site,
            solref=(0.004, 1),
            solimp=(0.999, 0.999, 0.001, 0.5, 2.0),
        )
        for part in ("gripper", "finger_1", "finger_2"):
            spec.add_exclude(name=f"{arm}-{part}", bodyname1=f"{arm}/{part}", bodyname2=body)


def _body_of(spec: Any, site: str) -> str:
    found = spec.site(site)
    if found is None:
        raise SettingsError(f"welds names the site {site!r}, and no prop has it: add it to the MJCF of the prop")
    return str(found.parent.name)
