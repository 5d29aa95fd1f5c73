"""Obstacles: exact distances, refusals of the safety gate, and contacts in simulation."""

from __future__ import annotations

import dataclasses
import pickle

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dual_ur10.assets.collision_model import (
    CLEARANCE_CUTOFF_M,
    CLEARANCE_PAIRS,
    build_collision_model,
    clearance_pairs,
    compose_collision_model,
)
from dual_ur10.assets.obstacles import Box, Capsule, Obstacle, Plane, geom_name
from dual_ur10.assets.props import BLOCK, BLOCK_SIZE_M
from dual_ur10.assets.scene import build_model, compose
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.errors import CollisionAtStartError
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import MINIMUM_M, Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from tests.sim2real.control.motion_checks import HARD
from tests.sim2real.control.reference_cell import UNEQUAL, contacts, random_q
from tests.soak import scaled
from ur_core.errors import SettingsError
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS, LINKS, NOMINAL_DH
from ur_core.mjcf.gains import COMPLIANT
from ur_core.servoj import ServojProfile

BOX = Box(name="box", position_m=(-0.1, 0.4, 0.6), size_m=(0.3, 0.5, 0.2), rotation_rad=(0.4, -0.3, 0.8))
PLATE = Box(name="plate", position_m=(-0.4, -0.3, 0.5), size_m=(1.5, 0.01, 1.5), rotation_rad=(0.1, 0.0, 0.2))
POST = Capsule(name="post", from_m=(0.0, 0.7, 0.0), to_m=(-0.1, 0.8, 1.2), radius_m=0.05)
BALL = Capsule(name="ball", from_m=(-0.3, 0.5, 0.7), to_m=(-0.3, 0.5, 0.7), radius_m=0.2)
WALL = Plane(name="wall", point_m=(0.3, 0.0, 0.0), normal=(-0.6, 0.8, 0.0))
CEILING = Plane(name="ceiling", point_m=(0.0, 0.0, 1.0), normal=(0.0, 0.0, -1.0))
ALL: tuple[Obstacle, ...] = (BOX, PLATE, POST, BALL, WALL, CEILING)
GRIPPERS = Equipment(grippers=True)
HOME_Z_M = 0.4  # of the flanges


def signed(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    """Return distances (...) of points (..., 3) by the definition of the shape; negative inside."""
    if isinstance(obstacle, Plane):
        return (points - obstacle.point_m) @ np.array(obstacle.normal)
    if isinstance(obstacle, Capsule):
        a, b = np.array(obstacle.from_m), np.array(obstacle.to_m)
        along = b - a
        t = np.clip((points - a) @ along / max(along @ along, 1e-12), 0, 1)
        return np.linalg.norm(points - a - t[..., None] * along, axis=-1) - obstacle.radius_m
    local = (points - obstacle.position_m) @ Rotation.from_rotvec(obstacle.rotation_rad).as_matrix()
    beyond = np.abs(local) - np.array(obstacle.size_m) / 2
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def nearest(obstacle: Obstacle, ends: np.ndarray) -> np.ndarray:
    """Return least distances (...) of lines (..., 2, 3) by ternary search: convex bodies have convex distances."""
    low, high = np.zeros(ends.shape[:-2]), np.ones(ends.shape[:-2])

    def at(t: np.ndarray) -> np.ndarray:
        return signed(obstacle, ends[..., 0, :] + t[..., None] * (ends[..., 1, :] - ends[..., 0, :]))

    for _ in range(45):
        first, second = low + (high - low) / 3, high - (high - low) / 3
        left = at(first) <= at(second)
        low, high = np.where(left, low, first), np.where(left, second, high)
    return at((low + high) / 2)


def test_distances_are_those_of_the_shapes() -> None:
    settings = dataclasses.replace(UNEQUAL, equipment=GRIPPERS, obstacles=ALL)
    model = build_collision_model(settings)
    data = mujoco.MjData(model)
    clearance = Clearance(settings)
    names = [f"{arm}/{part}" for arm in ARMS for part in (*LINKS, "palm")]
    geoms = [model.geom(name).id for name in names]
    boxes = [model.geom(f"{arm}/fingers").id for arm in ARMS]
    radius, half = model.geom_size[geoms, 0], model.geom_size[geoms, 1]
    corners = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    drawn = [*random_q(rng, scaled(1000)), *(HOME_Q_RAD + rng.uniform(-0.8, 0.8, (scaled(3000), 2, 6)))]
    found = clearance.measure(np.reshape(drawn, (-1, 12))).distances_m
    ends, points = [], []  # of the lines in the capsules, and all over the fingers' boxes
    for q in drawn:
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat[geoms].reshape(-1, 3, 3)[:, :, 2] * half[:, None]
        ends.append(np.stack([data.geom_xpos[geoms] - axes, data.geom_xpos[geoms] + axes], axis=1))
        turned = [corners * model.geom_size[box] @ data.geom_xmat[box].reshape(3, 3).T for box in boxes]
        points.append([data.geom_xpos[box] + each for box, each in zip(boxes, turned, strict=True)])
    for obstacle in ALL:
        true = nearest(obstacle, np.array(ends)) - radius
        measured = found[:, [clearance.pairs.index((name, geom_name(obstacle))) for name in names]]
        # Spheres represent the wrists at boxes: nearer by half their length at most.
        slack = np.array([0.0126 if "wrist" in name and isinstance(obstacle, Box) else 0.0 for name in names])
        apart = true > 0.0
        assert (measured <= np.where(apart, true, 0.0) + 1e-6).all(), obstacle
        assert (measured >= np.minimum(true - slack, CLEARANCE_CUTOFF_M) - 1e-6)[apart].all(), obstacle
        assert (apart & (true < CLEARANCE_CUTOFF_M)).sum() > 30
        assert (~apart).sum() > 30
        true = signed(obstacle, np.array(points)).min(axis=-1)  # at points of the boxes: an upper bound
        measured = found[:, [clearance.pairs.index((f"{arm}/fingers", geom_name(obstacle))) for arm in ARMS]]
        slack = 0.037 if isinstance(obstacle, Capsule) else 0.0
        apart = true > 0.0
        assert (measured <= np.where(apart, true, 0.0) + 1e-6).all(), obstacle
        assert (measured >= np.minimum(true - slack, CLEARANCE_CUTOFF_M) - 0.009)[apart].all(), obstacle


def test_rods_through_the_fingers_have_negative_distances() -> None:
    # MuJoCo's own distance of this pair, too, may be positive: the fingers' box and a thin capsule.
    rng, middle = np.random.default_rng(0), np.array([0.0, 0.6, HOME_Z_M - 0.14])
    rods = []
    for row in range(60):
        along = rng.normal(size=3)
        along *= 0.4 / np.linalg.norm(along)
        through = middle + rng.uniform(-0.01, 0.01, 3)
        rods.append(Capsule(name=f"rod-{row}", from_m=through - along, to_m=through + along, radius_m=0.002))
    clearance = Clearance(SceneSettings(equipment=GRIPPERS, obstacles=tuple(rods)))
    found = clearance.measure(HOME_Q_RAD.reshape(1, 12)).distances_m[0]
    for rod in rods:
        assert found[clearance.pairs.index(("left/fingers", geom_name(rod)))] < 0.0


def test_every_moving_part_is_paired_with_every_obstacle() -> None:
    for equipment, parts in ((Equipment(), LINKS), (GRIPPERS, (*LINKS, "palm", "fingers"))):
        plain = SceneSettings(equipment=equipment)
        pairs = clearance_pairs(dataclasses.replace(plain, obstacles=ALL))
        before = clearance_pairs(plain)
        assert pairs[: len(before)] == before
        expected = {(f"{arm}/{part}", f"obstacle/{each.name}") for arm in ARMS for part in parts for each in ALL}
        assert len(pairs[len(before) :]) == len(expected)
        assert set(pairs[len(before) :]) == expected
    model = build_collision_model(SceneSettings(obstacles=ALL))
    assert [model.sensor(i).name for i in range(model.nsensor)] == [
        ":".join(pair) for pair in clearance_pairs(SceneSettings(obstacles=ALL))
    ]


def test_scenes_without_obstacles_do_not_change() -> None:
    assert SceneSettings(obstacles=()) == SceneSettings()
    assert clearance_pairs(SceneSettings(obstacles=[])) is CLEARANCE_PAIRS
    for spec in (compose(SceneSettings()), compose_collision_model(SceneSettings())):
        assert "obstacle" not in spec.to_xml()


def test_every_contact_with_an_obstacle_is_a_measured_pair() -> None:
    settings = SceneSettings(obstacles=ALL)
    measured = {tuple(sorted(pair)) for pair in clearance_pairs(settings)}
    for visuals in (True, False):
        model = build_model(settings, visuals=visuals)
        seen = contacts(model, random_q(np.random.default_rng(2), 150))
        assert seen <= measured
        touched = {frozenset((name.split("/")[0], other)) for pair in seen for name in pair for other in pair}
        assert all(any(geom_name(each) in pair for pair in seen) for each in ALL)
        assert all(frozenset((arm, geom_name(WALL))) in touched for arm in ARMS)


@pytest.mark.parametrize(
    "obstacle",
    [
        Box(name="step", position_m=(0.0, 0.0, 0.1), size_m=(0.3, 0.3, 0.2)),
        Plane(name="level", point_m=(0.0, 0.0, 0.2), normal=(0.0, 0.0, 1.0)),
        None,
    ],
    ids=lambda each: each and each.kind,
)
def test_props_rest_on_obstacles(obstacle: Obstacle | None) -> None:
    obstacles = () if obstacle is None else (obstacle,)
    far = ArmMount((-2.0, 1.0, 0.5)), ArmMount((-2.0, -1.0, 0.5))
    settings = SceneSettings(*far, equipment=Equipment(props=(BLOCK,)), obstacles=obstacles)
    model = build_model(settings, visuals=False)
    data = mujoco.MjData(model)
    data.qpos[:12] = data.ctrl[:12] = HOME_Q_RAD.ravel()
    data.qpos[12:15] = (0.0, 0.0, 0.3)
    for _ in range(400):
        mujoco.mj_step(model, data)
    top = 0.0 if obstacle is None else 0.2
    assert data.body("block/block").xpos[2] == pytest.approx(top + BLOCK_SIZE_M[2] / 2, abs=0.002)


def test_an_arm_is_stopped_by_a_wall() -> None:
    wall = Plane(name="wall", point_m=(0.08, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
    forward = HOME_Q_RAD.copy()
    forward[:, 1] += 0.3
    found = []
    for obstacles in ((), (wall,)):
        model = build_model(SceneSettings(gains=COMPLIANT, obstacles=obstacles), visuals=False)
        data = mujoco.MjData(model)
        data.qpos[:] = HOME_Q_RAD.ravel()
        for step in range(750):
            fraction = min(step / 500, 1.0)
            data.ctrl[:] = (HOME_Q_RAD + fraction * (forward - HOME_Q_RAD)).ravel()
            mujoco.mj_step(model, data)
        found.append(data.site("left/flange").xpos[0])
    assert found[0] > found[1] + 0.02


def gate_of(settings: SceneSettings) -> SafetyGate:
    gate = SafetyGate(HARD, 0.008, 5, Clearance(settings))
    gate.reset(HOME_Q_RAD[None])
    return gate


@pytest.mark.parametrize(
    "obstacle",
    [
        Plane(name="wall", point_m=(0.12, 0.0, 0.0), normal=(-1.0, 0.0, 0.0)),
        Box(name="plate", position_m=(0.15, 0.6, 0.5), size_m=(0.005, 1.0, 1.0)),
        Capsule(name="post", from_m=(0.14, 0.6, 0.0), to_m=(0.14, 0.6, 1.0), radius_m=0.02),
    ],
    ids=lambda each: each.kind,
)
def test_the_gate_refuses_a_motion_into_an_obstacle(obstacle: Obstacle) -> None:
    push = np.zeros((1, 2, 6))
    push[0, 0, 1] = 0.6  # the left arm leans forward, the right one does not move
    refused, motion = [], []
    for obstacles, periods in (((), 5), ((obstacle,), 40)):
        adapter = ServojAdapter(ServojProfile("cb3"), HARD, 5, n=1, dh=[NOMINAL_DH] * 2)
        adapter.reset(HOME_Q_RAD[None])
        gate = gate_of(SceneSettings(obstacles=obstacles))
        for period in range(periods):
            result = gate(adapter(push).targets_rad.copy())
            motion.append(result.targets_rad[0])
            refused += result.verdicts.values()
            assert bool(obstacles and period >= 3) <= bool(result.verdicts) <= bool(obstacles)
    motion = motion[5:]
    assert refused[0].kind == "distance"
    assert refused[0].subject.startswith("left/")
    assert refused[0].subject.endswith(f" and obstacle/{obstacle.name}")
    assert refused[0].found < refused[0].allowed == MINIMUM_M
    assert f"obstacle/{obstacle.name}: distance" in str(refused[0])
    left = np.concatenate(motion).reshape(-1, 12)
    np.testing.assert_allclose(left[-1], left[-2], atol=1e-4)  # stopped, before the obstacle
    clearance = Clearance(SceneSettings(obstacles=(obstacle,)))
    rows = [i for i, pair in enumerate(clearance.pairs) if pair[1] == geom_name(obstacle)]
    distances = clearance.measure(left).distances_m[:, rows].min(axis=1)
    assert distances.min() > MINIMUM_M - 1e-6
    assert distances[-1] < 0.12  # it moved towards the obstacle


def test_a_start_in_an_obstacle_names_it() -> None:
    for size in (0.1, 3.0):  # around the flange; around the whole arm
        box = Box(name="crate-7", position_m=(0.0, 0.6, 0.4), size_m=(size, size, size))
        clearance = Clearance(SceneSettings(obstacles=(box,)))
        with pytest.raises(
            CollisionAtStartError, match=r"left/\w+ and obstacle/crate-7 .* move the obstacle 'crate-7'"
        ):
            clearance.check_start(HOME_Q_RAD[None])
    away = dataclasses.replace(box, position_m=(2.5, 0.0, 0.0))
    Clearance(SceneSettings(obstacles=(away,))).check_start(HOME_Q_RAD[None])


def test_the_thinnest_and_longest_boxes_are_measured() -> None:
    for size in ((0.001, 0.001, 0.001), (0.001, 20.0, 0.001), (20.0, 20.0, 0.001), (20.0, 20.0, 20.0)):
        box = Box(name="box", position_m=(0.0, 0.6, 1.2 + size[2] / 2), size_m=size)
        clearance = Clearance(SceneSettings(obstacles=(box,)))
        up = HOME_Q_RAD.reshape(12).copy()
        up[:6] = (0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0)  # straight up, 1.3 m high, beside a small box
        below = HOME_Q_RAD.reshape(12)
        reading = dict(zip(clearance.pairs, clearance.measure(below[None]).distances_m[0], strict=True))
        assert min(d for pair, d in reading.items() if pair[1] == "obstacle/box") == CLEARANCE_CUTOFF_M
        assert clearance.is_clear(below[None])[0]
        assert clearance.is_clear(up[None])[0] == (size[0] < 1.0)


def test_equal_obstacles_are_equal_scenes() -> None:
    one = Box(name="b", position_m=[1, 0, 0], size_m=np.array([1, 1, 1]))
    two = Box(name="b", position_m=(1.0, 0.0, 0.0), size_m=(1.0, 1.0, 1.0))
    assert one == two
    assert hash(one) == hash(two)
    first, second = (SceneSettings(obstacles=each) for each in ([one, POST], (two, POST)))
    assert first == second
    assert hash(first) == hash(second)
    assert pickle.loads(pickle.dumps(first)) == first
    assert type(Capsule(name="c", from_m=(0, 0, 0), to_m=(0, 0, 1), radius_m=1).radius_m) is float


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Box(name="b", position_m=(0, 0), size_m=(1, 1, 1)), "position_m of the obstacle 'b' must be 3 finite"),
        (lambda: Box(name="b", position_m=(0, 0, 20.1), size_m=(1, 1, 1)), "allowed is -20 to 20"),
        (lambda: Box(name="b", position_m=(0, 0, 0), size_m=(1, 0, 1)), "allowed is 0.001 to 20"),
        (lambda: Box(name="b", position_m=(0, 0, 0), size_m=(1, 1, 20.1)), "allowed is 0.001 to 20"),
        (lambda: Box(name="b", position_m=(0, 0, 0), size_m=(1, 1, 1), rotation_rad=(0, 0, 90)), "rotation_rad"),
        (lambda: Capsule(name="c", from_m=(0, 0, np.nan), to_m=(0, 0, 1), radius_m=0.1), "from_m"),
        (
            lambda: Capsule(name="c", from_m=(0, 0, 0), to_m=(0, 0, 1), radius_m=0),
            "0: allowed is 0.001 to 10|0.0: allow",
        ),
        (lambda: Capsule(name="c", from_m=(0, 0, 0), to_m=(0, 0, 1), radius_m=(1, 2)), "radius_m"),
        (lambda: Plane(name="p", point_m=(0, 0, 0), normal=(0, 0, 0.99)), "has the length 0.99: allowed is 1"),
        (lambda: Plane(name="p", point_m=(0, 0, 0), normal=(0, 0, 2)), "normal"),
        (lambda: Plane(name="a b", point_m=(0, 0, 0), normal=(0, 0, 1)), "named 'a b': allowed are up to 64 letters"),
        (lambda: Plane(name=7, point_m=(0, 0, 0), normal=(0, 0, 1)), "named 7"),
        (lambda: Plane(name="p\n", point_m=(0, 0, 0), normal=(0, 0, 1)), "named"),
        (lambda: SceneSettings(obstacles=BOX), "must be a tuple of Box, Capsule and Plane"),
        (lambda: SceneSettings(obstacles=("box",)), "must be a tuple of Box, Capsule and Plane"),
        (lambda: SceneSettings(obstacles=None), "must be a tuple of Box, Capsule and Plane"),
        (lambda: SceneSettings(obstacles=(BOX, dataclasses.replace(POST, name="box"))), "2 obstacles are named 'box'"),
    ],
)
def test_bad_obstacles(make, match) -> None:
    with pytest.raises(SettingsError, match=match):
        make()
