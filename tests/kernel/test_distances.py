"""Distances of the kernel against MuJoCo's own distance sensors, on plain data of the same collision model."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M, build_collision_model
from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.assets.props import BAR, BLOCK
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from tests.sim2real.control.reference_cell import UNEQUAL, random_q
from tests.soak import SOAK
from ur_core.kinematics.ur10 import ARMS

COUNT = 250_000 if SOAK else 1_000
BOX, CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
EXACT_M = 1e-9
HULL_M = 1e-7  # MuJoCo keeps the corners of a mesh in single precision
UNCERTAIN = ((0.004, 0.011), (0.007, 0.006))

BOXES = (
    Box(name="box", position_m=(-0.1, 0.4, 0.6), size_m=(0.3, 0.5, 0.2), rotation_rad=(0.4, -0.3, 0.8)),
    Box(name="plate", position_m=(-0.4, -0.3, 0.5), size_m=(1.5, 0.001, 1.5), rotation_rad=(0.1, 0.0, 0.2)),
    Box(name="shelf", position_m=(0.3, 0.0, 0.9), size_m=(0.6, 0.01, 0.4)),
)
ROUND = (
    Capsule(name="post", from_m=(0.0, 0.7, 0.0), to_m=(-0.1, 0.8, 1.2), radius_m=0.05),
    Capsule(name="upright", from_m=(0.1, -0.7, 0.0), to_m=(0.1, -0.7, 1.6), radius_m=0.004),
    Capsule(name="ball", from_m=(-0.3, 0.5, 0.7), to_m=(-0.3, 0.5, 0.7), radius_m=0.2),
)
PLANES = (
    Plane(name="wall", point_m=(0.3, 0.0, 0.0), normal=(-0.6, 0.8, 0.0)),
    Plane(name="ceiling", point_m=(0.0, 0.0, 1.0), normal=(0.0, 0.0, -1.0)),
)
GRIPPERS = Equipment(grippers=True)
SCENES = {
    "bare": SceneSettings(),
    "calibrated arms with a bar": dataclasses.replace(UNEQUAL, equipment=Equipment(grippers=True, props=(BAR,))),
    "grippers among boxes": dataclasses.replace(UNEQUAL, equipment=GRIPPERS, obstacles=BOXES),
    "a block among round and flat things": SceneSettings(
        equipment=Equipment(grippers=True, props=(BLOCK,)), obstacles=(*ROUND, *PLANES)
    ),
}


def configurations(count: int) -> np.ndarray:
    """Return configurations (count, 12): anywhere, near home, and at quarter turns, where axes are parallel."""
    rng, third = np.random.default_rng(0), count // 3
    near = HOME_Q_RAD + rng.uniform(-0.8, 0.8, (third, 2, 6))
    quarters = rng.integers(-4, 5, (third, 2, 6)) * (np.pi / 2)
    return np.concatenate([random_q(rng, count - 2 * third), near, quarters]).reshape(count, 12)


def separation(data: mujoco.MjData, model: mujoco.MjModel, pair: int) -> float:
    """Return the largest separation along an axis of two boxes, or of a capsule's line and a box.

    Negative, it is how deep they are in each other. MuJoCo's depths are not: of two boxes it prefers the normals of
    faces, and a line that pierces a box is a case that its distance of a capsule does not know.
    """
    geoms = [int(model.sensor_objid[pair]), int(model.sensor_refid[pair])]
    (R, S), (first, second) = ([values[geom] for geom in geoms] for values in (data.geom_xmat, data.geom_xpos))
    R, S = R.reshape(3, 3), S.reshape(3, 3)
    sizes = [model.geom_size[geom] for geom in geoms]
    sizes = [
        np.array([0.0, 0.0, size[1]]) if model.geom_type[geom] == CAPSULE else size
        for geom, size in zip(geoms, sizes, strict=True)
    ]
    axes = [*R.T, *S.T, *(np.cross(a, b) for a in R.T for b in S.T)]
    units = np.array([axis / np.linalg.norm(axis) for axis in axes if np.linalg.norm(axis) > 1e-6])
    spread = np.abs(units @ R) @ sizes[0] + np.abs(units @ S) @ sizes[1]
    return float((np.abs(units @ (second - first)) - spread).max())


@pytest.mark.parametrize("scene", SCENES)
def test_distances_are_those_of_mujoco(scene: str) -> None:
    settings = SCENES[scene]
    model = build_collision_model(settings)
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-12, 200
    data = mujoco.MjData(model)
    q_rad = configurations(COUNT)
    found = np.maximum(Clearance(settings, uncertainty=UNCERTAIN).measure(q_rad).distances_m, -CLEARANCE_CUTOFF_M)
    kinds = model.geom_type[np.stack([model.sensor_objid, model.sensor_refid])]
    tolerance = np.where((kinds == mujoco.mjtGeom.mjGEOM_MESH).any(axis=0), HULL_M, EXACT_M)
    boxes = np.flatnonzero((kinds == BOX).any(axis=0) & np.isin(kinds, [BOX, CAPSULE]).all(axis=0))
    radius = np.where(kinds == CAPSULE, model.geom_size[np.stack([model.sensor_objid, model.sensor_refid]), 0], 0.0)
    apart = overlapping = 0
    for q, distances in zip(q_rad, found, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_sensorPos(model, data)
        expected = data.sensordata.copy()
        for pair in boxes[expected[boxes] < 0.0]:
            depth = separation(data, model, pair)
            expected[pair] = depth - radius[:, pair].sum() if depth < 0.0 else expected[pair]
        off = np.abs(distances - np.clip(expected, -CLEARANCE_CUTOFF_M, CLEARANCE_CUTOFF_M))
        worst = int((off / tolerance).argmax())
        assert (off <= tolerance).all(), (model.sensor(worst).name, distances[worst], expected[worst], q.tolist())
        apart += int(((expected > 0.0) & (expected < CLEARANCE_CUTOFF_M)).sum())
        overlapping += int((expected < 0.0).sum())
    assert min(apart, overlapping) > COUNT


@pytest.mark.parametrize("scene", SCENES)
def test_legal_distances_are_those_of_the_definition(scene: str) -> None:
    """A shift of a base, plus its rotation times the reach of the geom's bounding sphere from that base."""
    settings = SCENES[scene]
    model = build_collision_model(settings)
    data = mujoco.MjData(model)
    q_rad = configurations(300)
    found = Clearance(settings, uncertainty=UNCERTAIN).measure(q_rad).allowed_m
    names = [model.geom(geom).name.split("/")[0] for geom in range(model.ngeom)]
    for q, allowed in zip(q_rad, found, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for pair, each in enumerate(allowed):
            geoms = int(model.sensor_objid[pair]), int(model.sensor_refid[pair])
            expected = MINIMUM_M
            for geom, other in (geoms, geoms[::-1]):
                if names[geom] in ARMS and names[geom] != names[other]:
                    arm = ARMS.index(names[geom])
                    away = np.linalg.norm(data.geom_xpos[geom] - settings.mounts[arm].position_m)
                    expected += UNCERTAIN[arm][0] + UNCERTAIN[arm][1] * (away + model.geom_rbound[geom])
            assert each == pytest.approx(expected, abs=1e-12), model.sensor(pair).name
