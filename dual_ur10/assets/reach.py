"""How far parts of an arm can get from its base, and how far a joint moves them, whatever the others do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.kinematics.ur10 import ARMS

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]  # has no types of its own


def reach_m(model: mujoco.MjModel, settings: SceneSettings, geom: int) -> tuple[int, float]:
    """Arm that a geom is part of, and bound on the distance of all its points from the arm's base.

    The bound is the length of the chain of bodies up to the geom, stretched out in a line: up to a fifth more than the
    joints allow.

    Args:
        model: The cell's twin that measures distances.
        settings: The cell.
        geom: Index of the geom.

    Returns:
        Its row in `ARMS` and the bound in m; -1 and 0 for what is part of no arm.
    """
    for arm, mount in enumerate(settings.mounts):
        if model.geom(geom).name.startswith(f"{ARMS[arm]}/"):
            # The bases are parts of the world here, so that what is fixed in it is given in the cell frame.
            chain: list[Any] = [model.geom_pos[geom]]
            body = int(model.geom_bodyid[geom])
            while body != 0:
                chain.append(model.body_pos[body])
                body = int(model.body_parentid[body])
            chain[-1] = chain[-1] - np.asarray(mount.position_m)
            return arm, float(sum(map(np.linalg.norm, chain)) + model.geom_rbound[geom])
    return -1, 0.0


def levers_m(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Bounds on how much a distance sensor's reading changes per rad of each joint, (sensors, joints).

    A joint moves a point by its distance from the joint's axis at most. For that stands the distance of the next body
    from the axis, and the length of the chain of bodies from there on, stretched out in a line. What a joint moves as a
    whole stays as far apart as it was. How thick a capsule or a sphere is does not matter: the surface of what turns
    about itself stays where it is.

    Args:
        model: The cell's twin that measures distances.
    """
    levers = np.full((model.ngeom, model.njnt), np.nan)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        hops, beyond = _core_m(model, geom)
        while body != 0:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            for joint in range(first, first + count):
                away = np.cross(model.jnt_axis[joint], hops - model.jnt_pos[joint])
                levers[geom, joint] = np.linalg.norm(away, axis=1).max() + beyond
            beyond += float(np.linalg.norm(hops, axis=1).max())
            hops = model.body_pos[body][None]
            body = int(model.body_parentid[body])
    moves = np.isfinite(levers)
    levers[~moves] = 0.0
    first_of, second_of = model.sensor_objid, model.sensor_refid
    return np.where(moves[first_of] & moves[second_of], 0.0, levers[first_of] + levers[second_of])


def _core_m(model: mujoco.MjModel, geom: int) -> tuple[NDArray[np.float64], float]:
    """Points of a geom in its body's frame, (k, 3), and how far from the nearest of them another point of it may be."""
    import mujoco

    middle, kind = model.geom_pos[geom], int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return middle[None], 0.0
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        along = turn.reshape(3, 3)[:, 2] * model.geom_size[geom][1]
        return np.stack([middle - along, middle + along]), 0.0
    return middle[None], float(model.geom_rbound[geom])
