"""Inverse dynamics against MuJoCo and known torques."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.kinematics.reference_arm import random_q
from ur_core import kinematics
from ur_core.errors import SettingsError
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import DH_ALPHA_RAD


def mujoco_arm(payload_kg: float, com: tuple[float, float, float], robot: str) -> mujoco.MjModel:
    """The arm as nested MuJoCo bodies, each frame a DH frame."""
    facts = ROBOTS[robot]
    spec = mujoco.MjSpec()
    body = spec.worldbody
    place, turn = np.zeros(3), Rotation.identity()
    for link in range(6):
        body = body.add_body(name=f"link_{link}", pos=place, quat=np.roll(turn.as_quat(), 1))
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        place = np.array([facts.a_m[link], 0.0, facts.d_m[link]])
        turn = Rotation.from_euler("x", DH_ALPHA_RAD[link])
        distal = body.add_body(name=f"inertia_{link}", pos=place, quat=np.roll(turn.as_quat(), 1))
        distal.mass, distal.ipos, distal.fullinertia = facts.mass_kg[link], facts.com_m[link], facts.inertia_kg_m2[link]
        distal.explicitinertial = True
    if payload_kg:
        payload = distal.add_body(name="payload", pos=com)
        payload.mass, payload.ipos, payload.inertia = payload_kg, [0, 0, 0], [1e-12] * 3
        payload.explicitinertial = True
    return spec.compile()


@pytest.mark.parametrize(("payload", "com"), [(0.0, (0.0, 0.0, 0.0)), (5.0, (0.02, -0.03, 0.15))])
@pytest.mark.parametrize("robot", ROBOTS)
def test_inverse_dynamics_matches_mujoco(robot: str, payload: float, com: tuple[float, float, float]) -> None:
    model = mujoco_arm(payload, com, robot)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(18)
    q, qd, qdd = random_q(50, 18), rng.uniform(-2, 2, (50, 6)), rng.uniform(-10, 10, (50, 6))
    torque = kinematics.inverse_dynamics(q, qd, qdd, payload, com, robot=robot)
    without = kinematics.inverse_dynamics(q, qd, qdd, payload, com, gravity=False, robot=robot)
    for row in range(50):
        data.qpos, data.qvel, data.qacc = q[row], qd[row], qdd[row]
        model.opt.gravity[2] = -9.81
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(torque[row], data.qfrc_inverse, atol=1e-8)
        model.opt.gravity[2] = 0.0
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(without[row], data.qfrc_inverse, atol=1e-8)


def test_largest_gravity_torques() -> None:
    q, zero = random_q(4000, 19), np.zeros(6)
    torque = np.abs(kinematics.inverse_dynamics(q, zero, zero, robot="ur10")).max(0)
    assert torque[0] < 1e-12  # the base axis is upright
    # The largest torque of the random configurations is a little below the largest of all.
    for joint, largest, short in ((1, 121.0, 6.0), (2, 41.0, 2.0), (3, 3.0, 0.3), (4, 0.6, 0.06)):
        assert largest - short < torque[joint] < largest * 1.03


def test_armature_adds_to_the_inertia_alone() -> None:
    q, qd, qdd = random_q(3, 20), random_q(3, 21), random_q(3, 22)
    bare = kinematics.inverse_dynamics(q, qd, qdd, robot="ur10")
    geared = kinematics.inverse_dynamics(q, qd, qdd, armature_kg_m2=0.1, robot="ur10")
    np.testing.assert_allclose(geared - bare, 0.1 * qdd, atol=1e-12)


def test_payloads_are_checked() -> None:
    zero = np.zeros(6)
    for payload, com in ((-1.0, (0, 0, 0)), (np.nan, (0, 0, 0)), (1.0, (0, np.inf, 0))):
        with pytest.raises(SettingsError, match="payload"):
            kinematics.inverse_dynamics(zero, zero, zero, payload, com, robot="ur10")
