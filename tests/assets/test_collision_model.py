"""Collision model: possible contacts, and distances of all pairs."""

import itertools

import mujoco
import numpy as np
import pytest
from mujoco import batch

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M, build_collision_model, clearance_pairs
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import HOME_Q_RAD, SceneSettings
from tests.sim2real.control.reference_cell import UNEQUAL, contacts, point_to_capsule, random_q, segment
from ur_core.kinematics.frames import FLOOR_Z_M, ArmMount
from ur_core.kinematics.ur10 import ARMS, LINKS

CROSSING = (-0.9, 0.9)


@pytest.fixture(scope="module")
def model():
    return build_model(SceneSettings())


@pytest.fixture(scope="module")
def clearance():
    return build_collision_model(SceneSettings())


def test_one_collision_capsule_per_link(model):
    for arm in ARMS:
        for link in ("base_link", *LINKS):
            geoms = np.flatnonzero(model.geom_bodyid == model.body(f"{arm}/{link}").id)
            solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
            assert [model.geom(g).name for g in solid] == [f"{arm}/{link}"]
            assert model.geom_type[solid[0]] == mujoco.mjtGeom.mjGEOM_CAPSULE
            assert model.geom_group[solid[0]] == 3
            assert (model.geom_group[np.setdiff1d(geoms, solid)] == 2).all()


def test_capsules_enclose_the_visual_arm_closely(model):
    # Points on the rims of all visual parts lie within 2 cm of some capsule of their arm, at home.
    data = mujoco.MjData(model)
    data.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_forward(model, data)
    capsules = [model.geom(f"left/{link}").id for link in ("base_link", *LINKS)]
    angles = np.linspace(0, 2 * np.pi, 24)
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name
        if name.startswith("left/") and model.geom_group[geom] == 2 and model.geom_type[geom] == 5:
            radius, half = model.geom_size[geom, :2]
            rim = np.concatenate(
                [np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles + z], 1) for z in (-half, half)]
            )
            points = data.geom_xpos[geom] + rim @ data.geom_xmat[geom].reshape(3, 3).T
            outside = np.min([point_to_capsule(model, data, c, points) for c in capsules], axis=0)
            assert outside.max() < 0.02, (name, geom)


def test_neighbours_never_touch(model):
    """Neighbours never touch, nor do parts that the design of the arm keeps apart."""
    chain = ("base_link", *LINKS)
    filtered = {frozenset(pair) for pair in itertools.pairwise(chain)}
    filtered |= {
        frozenset(pair)
        for pair in (
            ("wrist_1_link", "wrist_3_link"),
            ("forearm_link", "wrist_2_link"),
            ("base_link", "upper_arm_link"),
            ("base_link", "wrist_1_link"),
            ("base_link", "wrist_2_link"),
            ("shoulder_link", "wrist_1_link"),
            ("shoulder_link", "wrist_2_link"),
        )
    }
    own = set()
    for a, b in contacts(model, random_q(np.random.default_rng(1), 1500)):
        if a.split("/")[0] == b.split("/")[0]:
            own.add(frozenset((a.split("/")[1], b.split("/")[1])))
    assert not own & filtered
    assert frozenset(("wrist_3_link", "shoulder_link")) in own  # the filter does not hide real self-collision


@pytest.mark.parametrize("apart_m", [1.2, 0.3])
def test_every_possible_contact_is_measured(apart_m):
    settings = SceneSettings(left=ArmMount((-0.75, apart_m / 2, 0.0)), right=ArmMount((-0.75, -apart_m / 2, -0.5)))
    model = build_model(settings)
    measured = {tuple(sorted(pair)) for pair in clearance_pairs(SceneSettings())}
    seen = contacts(model, random_q(np.random.default_rng(2), 1500))
    assert seen <= measured
    assert len(seen) > len(measured) / 3


def test_arms_meet(model):
    q = HOME_Q_RAD.copy()
    q[:, 0] += CROSSING  # the left arm swings right, the right arm left, until the wrists meet midway
    assert any({a.split("/")[0], b.split("/")[0]} == set(ARMS) for a, b in contacts(model, q))
    assert not contacts(model, HOME_Q_RAD)


@pytest.mark.parametrize("arm", [0, 1])
def test_arm_meets_table_and_floor(model, arm):
    q = HOME_Q_RAD.copy()
    q[arm, 1] += 0.75  # shoulder forward: the wrist goes down on the table
    assert any("table" in pair and ARMS[arm] in pair[0] for pair in contacts(model, q))
    q = HOME_Q_RAD.copy()
    q[arm] = [np.pi, 0.8, 0.0, 0.0, 0.0, 0.0]  # straight out and down, behind the base
    assert any("floor" in pair and ARMS[arm] in pair[-1] for pair in contacts(model, q))


def test_clearance_is_the_distance_of_the_capsules(model, clearance):
    pairs = clearance_pairs(SceneSettings())
    assert clearance.nsensor == clearance.nsensordata == len(pairs) == len(set(pairs))
    assert (clearance.ngeom, clearance.nu) == (23, 0)  # capsules, the wrists' spheres, table and its hull, floor
    data, distances = mujoco.MjData(model), mujoco.MjData(clearance)
    rng = np.random.default_rng(3)
    close = np.zeros(len(pairs), dtype=int)
    for _ in range(300):
        q = HOME_Q_RAD + rng.uniform(-1.5, 1.5, (2, 6))
        data.qpos[:] = distances.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_forward(clearance, distances)
        assert distances.ncon == 0
        for i, pair in enumerate(pairs):
            a, b = (model.geom(name).id for name in pair)
            expected = mujoco.mj_geomDistance(model, data, a, b, CLEARANCE_CUTOFF_M, np.zeros(6))
            if pair[1] == "table" and "wrist" in pair[0]:
                # The sphere around a capsule is never further away, and nearer by half the capsule's length at most.
                assert distances.sensordata[i] < expected + 1e-6
                assert expected < 0.0 or distances.sensordata[i] > expected - model.geom_size[a, 1] - 1e-6
            elif pair[1] == "table":
                line = np.abs(segment(model, data, a, 2001) - data.geom_xpos[b]) - model.geom_size[b]
                by_hand = np.linalg.norm(np.maximum(line, 0.0), axis=1).min() - model.geom_size[a, 0]
                if by_hand > 0.0:
                    assert distances.sensordata[i] == pytest.approx(min(by_hand, CLEARANCE_CUTOFF_M), abs=1e-6)
                else:
                    assert distances.sensordata[i] < 1e-6
            else:
                assert distances.sensordata[i] == pytest.approx(expected, abs=1e-6)
            if pair[1] == "floor":
                by_hand = segment(model, data, a)[:, 2].min() - model.geom_size[a, 0] - FLOOR_Z_M
            elif pair[1] != "table":
                by_hand = point_to_capsule(model, data, b, segment(model, data, a, 200)).min() - model.geom_size[a, 0]
            else:
                continue
            by_hand = min(by_hand, CLEARANCE_CUTOFF_M)
            if by_hand > 0.0:
                assert distances.sensordata[i] == pytest.approx(by_hand, abs=2e-3)
            close[i] += expected < CLEARANCE_CUTOFF_M
    assert (close > 0).sum() > len(pairs) / 2  # the comparison was not one of cut-off with cut-off


@pytest.mark.parametrize("x_m", [-0.75, -0.3])
def test_a_link_through_the_table_has_a_negative_distance(x_m):
    # Against a box, MuJoCo's own distance is up to the cutoff for some of them.
    settings = SceneSettings(left=ArmMount((x_m, 0.6, 0.0)), right=ArmMount((x_m, -0.6, 0.0)))
    model = build_collision_model(settings)
    data, table, pairs = mujoco.MjData(model), model.geom("table").id, clearance_pairs(settings)
    long = [(i, pair[0]) for i, pair in enumerate(pairs) if pair[1] == "table" and "arm" in pair[0]]
    stuck = misread = 0
    for q in random_q(np.random.default_rng(5), 600):
        data.qpos[:] = q.ravel()
        mujoco.mj_forward(model, data)
        for i, name in long:
            line = segment(model, data, model.geom(name).id, 400) - data.geom_xpos[table]
            if (np.abs(line) < model.geom_size[table]).all(axis=1).any():
                stuck += 1
                assert data.sensordata[i] < -model.geom(name).size[0]
                native = mujoco.mj_geomDistance(model, data, model.geom(name).id, table, 0.2, np.zeros(6))
                misread += native > 0.0
    assert stuck > 100
    assert misread > 10  # else the hull would not be needed


def test_clearance_in_a_batch(clearance):
    cells = batch.Batch(clearance, 2, 1)
    q, distances = cells.bind("qpos"), cells.bind("sensordata")
    q[0] = HOME_Q_RAD.ravel()
    q[1] = HOME_Q_RAD.ravel()
    q[1, [0, 6]] += CROSSING
    cells.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
    assert distances[0].min() > 0.04
    assert distances[1].min() < 0.0


def test_spheres_stand_in_at_the_table_only(clearance):
    # They hold the capsules, so that the table is never nearer than measured; all other pairs are the capsules' own.
    for i, (moving, other) in enumerate(clearance_pairs(SceneSettings())):
        measured = clearance.sensor(i).objid[0]
        if other != "table" or "wrist" not in moving:
            assert clearance.geom(measured).name == moving
            continue
        capsule = clearance.geom(moving).id
        assert clearance.geom_bodyid[measured] == clearance.geom_bodyid[capsule]
        off = np.linalg.norm(clearance.geom_pos[measured] - clearance.geom_pos[capsule])
        radius, half = clearance.geom_size[capsule, :2]
        assert off < 1e-9
        assert clearance.geom_size[measured, 0] == pytest.approx(radius + half)
        assert half < 0.013


@pytest.mark.parametrize("settings", [SceneSettings(), UNEQUAL], ids=["nominal", "calibrated"])
def test_the_twin_has_the_inertia_of_the_cell(settings):
    # The controller's model of the arms is made of it.
    model, clearance = build_model(settings), build_collision_model(settings)
    data, distances = mujoco.MjData(model), mujoco.MjData(clearance)
    model.opt.gravity[:] = 0.0
    rng = np.random.default_rng(4)
    for q in random_q(rng, 20):
        data.qpos[:] = distances.qpos[:] = q.ravel()
        data.qvel[:] = distances.qvel[:] = rng.normal(size=12)
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(clearance, distances)
        assert np.abs(data.M - distances.M).max() < 1e-9
        assert np.abs(data.qfrc_bias - distances.qfrc_bias).max() < 1e-9
