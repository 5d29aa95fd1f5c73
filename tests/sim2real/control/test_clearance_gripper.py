"""Grippers in the collision model: complete, and with exact boxes."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from dual_ur10.assets.cell_spec import joint_names
from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M, CLEARANCE_PAIRS, build_collision_model, clearance_pairs
from dual_ur10.assets.props import BAR
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from tests.sim2real.control.reference_cell import UNEQUAL, contacts, random_q, segment
from ur_core.kinematics.frames import ArmMount
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

GRIPPERS = SceneSettings(equipment=Equipment(grippers=True))
BOX = mujoco.mjtGeom.mjGEOM_BOX
FACING = HOME_Q_RAD + np.array([[-0.7], [0.7]]) * np.eye(6)[0]  # the grippers are near each other


@pytest.fixture(scope="module")
def collision():
    return build_collision_model(GRIPPERS)


def with_fingers(q, opening):
    return np.pad(np.reshape(q, (2, 6)), ((0, 0), (0, 2)), constant_values=opening / 2).ravel()


def test_pairs(collision):
    pairs = clearance_pairs(GRIPPERS)
    assert clearance_pairs(SceneSettings()) is CLEARANCE_PAIRS
    assert clearance_pairs(SceneSettings(equipment=Equipment(props=(BAR,)))) is CLEARANCE_PAIRS
    assert pairs[: len(CLEARANCE_PAIRS)] == CLEARANCE_PAIRS
    assert len({frozenset(pair) for pair in pairs}) == len(pairs) == collision.nsensordata
    assert [collision.sensor(i).name for i in range(collision.nsensor)] == [":".join(pair) for pair in pairs]
    assert [collision.joint(i).name for i in range(collision.njnt)] == list(joint_names(SceneSettings()))
    assert (collision.nu, collision.neq, collision.ntendon) == (0, 0, 0)


@pytest.mark.parametrize("apart_m", [1.2, 0.3])
def test_every_possible_contact_is_measured(apart_m):
    settings = SceneSettings(
        left=ArmMount((-0.75, apart_m / 2, 0.0)),
        right=ArmMount((-0.75, -apart_m / 2, -0.5)),
        equipment=Equipment(grippers=True),
    )
    model = build_model(settings, visuals=False)
    measured = {frozenset(pair) for pair in clearance_pairs(settings)}
    seen = set()
    data = mujoco.MjData(model)
    for q in random_q(np.random.default_rng(2), 2000):
        data.qpos[:] = with_fingers(q, TOOL.stroke_m)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            if contact.dist < 0.0:
                names = [model.geom(g).name for g in contact.geom]
                seen.add(frozenset(reach(name) for name in names))
    assert seen <= measured
    assert len(seen) > len(measured) / 3
    own = frozenset(("left/fingers", "left/upper_arm_link"))
    assert own in seen


def reach(name):
    """Return the geom of the collision model that stands for one of the cell."""
    arm, _, part = name.partition("/")
    return f"{arm}/fingers" if part.startswith(("finger", "pad")) else name


def test_contacts_of_the_cell_overlap_in_the_collision_model(collision):
    model = build_model(GRIPPERS, visuals=False)
    pairs = {frozenset(pair): i for i, pair in enumerate(clearance_pairs(GRIPPERS))}
    data, distances = mujoco.MjData(model), mujoco.MjData(collision)
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(1500):
        q = FACING + rng.uniform(-0.6, 0.6, (2, 6))
        data.qpos[:] = with_fingers(q, rng.uniform(0, TOOL.stroke_m))
        distances.qpos[:] = q.ravel()
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(collision, distances)
        for contact in data.contact:
            names = frozenset(reach(model.geom(g).name) for g in contact.geom)
            if contact.dist < 0.0 and any("fingers" in name or "palm" in name for name in names):
                assert distances.sensordata[pairs[names]] < 1e-6
                compared += 1
    assert compared > 300


def test_the_box_of_the_fingers_contains_them_at_any_width(collision):
    model = build_model(GRIPPERS)
    data, distances = mujoco.MjData(model), mujoco.MjData(collision)
    distances.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_kinematics(collision, distances)
    box = collision.geom("left/fingers").id
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    for opening in (0.0, TOOL.stroke_m):
        data.qpos[:] = with_fingers(HOME_Q_RAD, opening)
        mujoco.mj_kinematics(model, data)
        found = []
        for geom in range(model.ngeom):
            if model.body(model.geom_bodyid[geom]).name.startswith("left/finger_"):
                size = model.geom_size[geom].copy()
                if model.geom_type[geom] != BOX:  # a rod: as a box around it
                    round_end = size[0] * (model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE)
                    size = np.array([size[0], size[0], size[1] + round_end])
                points = data.geom_xpos[geom] + corners * size @ data.geom_xmat[geom].reshape(3, 3).T
                inside = (points - distances.geom_xpos[box]) @ distances.geom_xmat[box].reshape(3, 3)
                found.append(np.abs(inside).max(axis=0))
                assert (found[-1] <= collision.geom_size[box] + 0.0003).all(), opening
        assert (collision.geom_size[box] - np.max(found, axis=0))[2] < 1e-6  # and no longer than they are
    tip = distances.site("left/flange").xpos[2] - TOOL.fingertip_m
    assert distances.geom_xpos[box][2] - collision.geom_size[box, 2] == pytest.approx(tip)


def test_the_capsule_of_the_palm_hugs_the_drawn_palm():
    model = build_model(GRIPPERS)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    line = segment(model, data, model.geom("left/palm").id, 501)
    angles = np.linspace(0, 2 * np.pi, 24)
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    rims = np.array([[np.cos(t), np.sin(t), end] for t in angles for end in (-1, 1)])
    away = []
    for geom in np.flatnonzero(model.geom_bodyid == model.body("left/gripper").id):
        if model.geom_group[geom] == 2:
            size = model.geom_size[geom]
            local = corners * size if model.geom_type[geom] == BOX else rims * size[[0, 0, 1]]
            points = data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
            away.append(np.linalg.norm(points[:, None] - line, axis=-1).min(axis=1).max())
    assert 0.0 < max(away) - model.geom("left/palm").size[0] < 0.012


def test_the_capsule_of_the_fingers_contains_their_box(collision):
    data = mujoco.MjData(collision)
    data.qpos[:] = FACING.ravel()
    mujoco.mj_kinematics(collision, data)
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    for arm in ("left", "right"):
        box, capsule = (collision.geom(f"{arm}/{name}").id for name in ("fingers", "fingers_round"))
        points = data.geom_xpos[box] + corners * collision.geom_size[box] @ data.geom_xmat[box].reshape(3, 3).T
        line = segment(collision, data, capsule, 2001)
        away = np.linalg.norm(points[:, None] - line, axis=-1).min(axis=1) - collision.geom_size[capsule, 0]
        assert away.max() < 1e-6
        # It exceeds the box by at most the documented margin.
        assert collision.geom_size[capsule, 0] - collision.geom_size[box, 0] < 0.037
        assert collision.geom_size[capsule, :2].sum() - collision.geom_size[box, 1] < 0.037


def box_to_box(model, data, a, b):
    """Return the distance of two boxes by least squares; negative by the axis of least overlap."""
    (pa, Ra, sa), (pb, Rb, sb) = (
        (data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3), model.geom_size[g]) for g in (a, b)
    )
    limits = np.concatenate([sa, sb])
    found = lsq_linear(np.hstack([Ra, -Rb]), pb - pa, (-limits, limits), method="bvls", tol=1e-14)
    distance = np.sqrt(2 * found.cost)
    if distance > 1e-7:
        return distance
    axes = [*Ra.T, *Rb.T, *(np.cross(x, y) for x in Ra.T for y in Rb.T)]
    axes = [axis / np.linalg.norm(axis) for axis in axes if np.linalg.norm(axis) > 1e-9]
    return -min(np.abs(Ra.T @ n) @ sa + np.abs(Rb.T @ n) @ sb - abs((pb - pa) @ n) for n in axes)


def box_to_capsule(model, data, box, capsule):
    """Return the distance of box and capsule; any negative number if they meet."""
    points = (segment(model, data, capsule, 2001) - data.geom_xpos[box]) @ data.geom_xmat[box].reshape(3, 3)
    beyond = np.maximum(np.abs(points) - model.geom_size[box], 0.0)
    return np.linalg.norm(beyond, axis=1).min() - model.geom_size[capsule, 0]


def test_distances_from_boxes_are_exact(collision):
    data = mujoco.MjData(collision)
    rng = np.random.default_rng(4)
    boxed = [
        (i, pair)
        for i, pair in enumerate(clearance_pairs(GRIPPERS))
        if pair[1] in ("table", "left/palm", "right/palm", "left/fingers", "right/fingers")
        and pair[0].endswith(("palm", "fingers"))
        and not all(name.endswith("palm") for name in pair)
    ]
    assert len(boxed) == 7
    apart, overlapping = dict.fromkeys(boxed, 0), dict.fromkeys(boxed, 0)
    for _ in range(1500):
        q = FACING + rng.uniform(-0.5, 0.5, (2, 6))
        data.qpos[:] = q.ravel()
        mujoco.mj_forward(collision, data)
        for i, pair in boxed:
            a, b = (collision.geom(name).id for name in pair)
            # The palm is measured against a mesh of the same shape as the box.
            other = collision.geom(f"{pair[1]}:hull").id if pair[0].endswith("palm") and pair[1] == "table" else b
            assert {a, other} == {collision.sensor_objid[i], collision.sensor_refid[i]}
            if data.sensordata[i] >= CLEARANCE_CUTOFF_M:
                continue
            boxes = [g for g in (a, b) if collision.geom_type[g] == BOX]
            others = [g for g in (a, b) if collision.geom_type[g] != BOX]
            by_hand = (box_to_capsule if others else box_to_box)(collision, data, *boxes, *others)
            if by_hand > 0.0:
                apart[i, pair] += 1
                assert data.sensordata[i] == pytest.approx(by_hand, abs=1e-6)
            else:
                overlapping[i, pair] += 1
                assert data.sensordata[i] <= 1e-9
                if not others:
                    assert data.sensordata[i] == pytest.approx(by_hand, abs=1e-4)
    assert min(apart.values()) > 50
    assert min(overlapping.values()) > 2


def test_home_is_clear_with_grippers(collision):
    data = mujoco.MjData(collision)
    data.qpos[:] = HOME_Q_RAD.ravel()
    mujoco.mj_forward(collision, data)
    assert data.sensordata.min() > 0.04
    assert not contacts(build_model(GRIPPERS), with_fingers(HOME_Q_RAD, 0.0)[:12])


@pytest.mark.parametrize("settings", [SceneSettings(), UNEQUAL], ids=["nominal", "calibrated"])
def test_the_collision_model_has_the_inertia_of_the_cell(settings):
    # The controller's model of the arms is made of it. Fingers half open, for they are so in the collision.
    settings = dataclasses.replace(settings, equipment=Equipment(grippers=True))
    model, collision = build_model(settings), build_collision_model(settings)
    data, rigid = mujoco.MjData(model), mujoco.MjData(collision)
    model.opt.gravity[:] = 0.0
    arms = np.r_[0:6, 8:14]
    rng = np.random.default_rng(4)
    for q in random_q(rng, 20):
        data.qpos[:], rigid.qpos[:] = with_fingers(q, TOOL.stroke_m / 2), q.ravel()
        data.qvel[arms] = rigid.qvel[:] = rng.normal(size=12)
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(collision, rigid)
        for j, dof in enumerate(arms):
            found, expected = np.zeros(model.nv), np.zeros(12)
            mujoco.mj_mulM(model, data, found, np.eye(model.nv)[dof])
            mujoco.mj_mulM(collision, rigid, expected, np.eye(12)[j])
            assert np.abs(found[arms] - expected).max() < 1e-9
        assert np.abs(data.qfrc_bias[arms] - rigid.qfrc_bias).max() < 1e-9
