"""Payload geometry in the collision model of the safety gate."""

import dataclasses

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.assets.collision_model import build_collision_model, clearance_pairs, payload_pairs
from dual_ur10.assets.obstacles import Capsule
from dual_ur10.assets.props import BAR, BLOCK, TARGET
from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.envs.tasks.handover.settings import GRIPS
from dual_ur10.envs.tasks.sync_carry.settings import CarrySettings
from dual_ur10.sim2real.cell.cell_config import CellConfig
from tests.sim2real.control.reference_cell import random_q, segment
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, LINKS

PROPS = {
    "bar": SceneSettings(equipment=Equipment(grippers=True, props=(BAR,))),
    "block": SceneSettings(equipment=Equipment(grippers=True, props=(BLOCK, TARGET))),
}
EMPTY = SceneSettings(equipment=Equipment(grippers=True))
ROD = Capsule(name="rod", from_m=(-0.6, 0.0, 0.25), to_m=(0.6, 0.0, 0.25), radius_m=0.01)
GRIPS_OF = [("bar", CarrySettings(grasp=grasp).grip) for grasp in ("rigid", "friction")]
GRIPS_OF += [("block", grips) for grips in GRIPS]


@pytest.mark.parametrize("prop", PROPS)
def test_pairs(prop):
    pairs = clearance_pairs(PROPS[prop])
    collision = build_collision_model(PROPS[prop])
    bare = clearance_pairs(EMPTY)
    assert pairs == bare + payload_pairs(PROPS[prop])
    assert [collision.sensor(i).name for i in range(collision.nsensor)] == [":".join(pair) for pair in pairs]
    near = clearance_pairs(dataclasses.replace(PROPS[prop], obstacles=(ROD,)))
    assert near[: len(pairs)] == pairs
    assert {f"{arm}/held_{prop}" for arm in ARMS} <= {first for first, _ in near[len(pairs) :]}


@pytest.mark.parametrize(("prop", "grips"), GRIPS_OF)
@pytest.mark.parametrize("arm", [0, 1])
def test_the_payload_is_at_the_gripped_prop(prop: str, grips: Poses, arm: int):
    """Inside it, to its ends, or of the bar to its middle, and with all corners near."""
    model = build_model(PROPS[prop])
    collision = build_collision_model(PROPS[prop])
    data, cell = mujoco.MjData(collision), mujoco.MjData(model)
    data.qpos[:] = HOME_Q_RAD.ravel()
    cell.qpos[: model.nq - 7] = np.pad(HOME_Q_RAD, ((0, 0), (0, 2))).ravel()
    mujoco.mj_kinematics(collision, data)
    mujoco.mj_kinematics(model, cell)
    tool = cell.site(f"{ARMS[arm]}/tcp")
    grip = quat_to_matrix(grips.quat[arm])
    half = model.geom(f"{prop}/{prop}").size
    long = int(half.argmax())
    geom = collision.geom(f"{ARMS[arm]}/held_{prop}").id
    line = (segment(collision, data, geom, 101) - tool.xpos) @ tool.xmat.reshape(3, 3)
    in_prop = line @ grip.T + grips.position_m[arm]
    radius = collision.geom_size[geom, 0]
    across = np.delete(np.abs(in_prop), long, axis=1) + radius
    assert (across <= np.delete(half, long) + 0.0061).all()  # the grip is that much before the middle
    low, high = in_prop[:, long].min() - radius, in_prop[:, long].max() + radius
    ends = (-half[long], half[long])
    if prop == "bar":
        ends = (0.0, half[long]) if arm == 0 else (-half[long], 0.0)
    assert (low, high) == pytest.approx(ends, abs=1e-6)


@pytest.mark.parametrize("prop", PROPS)
def test_every_pair_of_the_payload_is_measured(prop):
    """Except the other gripper's fingers, which take it, and the other gripper's payload, which is the same object."""
    collision = build_collision_model(PROPS[prop])
    data = mujoco.MjData(collision)
    measured = set(payload_pairs(PROPS[prop]))
    fromto = np.zeros(6)
    parts = ("base_link", *LINKS, "palm")
    seen = set()
    for q in random_q(np.random.default_rng(0), 3000):
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(collision, data)
        for arm in ARMS:
            thing = collision.geom(f"{arm}/held_{prop}").id
            for other in (f"{each}/{part}" for each in ARMS for part in parts):
                if mujoco.mj_geomDistance(collision, data, thing, collision.geom(other).id, 0.02, fromto) < 0.01:
                    seen.add((f"{arm}/held_{prop}", other))
    assert seen <= measured
    assert {(f"{arm}/held_{prop}", f"{arm}/forearm_link") for arm in ARMS} <= seen


def test_the_bar_is_not_lifted_against_an_obstacle():
    """Both grippers are half a metre away from it."""
    settings = {"action_latency_ticks": 5, "cell": CellConfig(obstacles=(ROD,))}
    env = gym.make("DualUR10/SyncCarry-v0", on_refusal="terminate", at_limits="refuse", **settings)
    policy = policies.load("scripted", "DualUR10/SyncCarry-v0", **settings)
    observation, _ = env.reset(seed=0)
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        over = terminated or truncated
    assert terminated
    assert "held_bar and obstacle/rod" in info["safety"].subject
    model, data = env.unwrapped.core.cell_data(0)
    fromto = np.zeros(6)
    away = mujoco.mj_geomDistance(model, data, model.geom("bar/bar").id, model.geom("obstacle/rod").id, 1.0, fromto)
    assert away > 0.015
