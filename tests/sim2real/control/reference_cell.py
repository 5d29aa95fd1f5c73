"""Independent reference cell: DH products, distances by hand, and unusual arms and mounts."""

from dataclasses import replace

import mujoco
import numpy as np

from dual_ur10.assets.settings import SceneSettings
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, NOMINAL_DH, DHParameters

CALIBRATED = DHParameters(
    a_m=(0.0003, -0.6111, -0.5731, 0.0002, -0.0001, 0.0),
    d_m=(0.1281, 0.004, -0.0035, 0.1632, 0.1163, 0.0919),
    alpha_rad=(1.5712, 0.0011, -0.0007, 1.5699, -1.5715, 0.0004),
    theta_rad=(0.001, -0.012, 0.02, -0.009, 0.0004, -0.0007),
    robot="ur10",
)
# Only d2 + d3 + d4 can be observed, so a calibration may move the frames by metres.
SHIFTED = replace(
    NOMINAL_DH,
    d_m=(0.1273, 2.0, -1.9985, 0.1624, 0.1157, 0.0922),
    alpha_rad=(np.pi / 2, 0.001, 0, np.pi / 2, -np.pi / 2, 0),
)
UNEQUAL = SceneSettings(
    left=ArmMount((-0.75, 0.6, 0.0), 0.3, CALIBRATED), right=ArmMount((-0.92, -0.45, 0.08), -2.1, NOMINAL_DH)
)


def dh_product(q, dh=NOMINAL_DH):
    """Return the product of standard DH matrices: flange in UR's base frame, (4, 4)."""
    T = np.eye(4)
    for theta, a, d, alpha in zip(np.add(q, dh.theta_rad), dh.a_m, dh.d_m, dh.alpha_rad, strict=True):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return T


def planar(position, yaw):
    """Return the pose of a frame rotated about z only, (4, 4)."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = position
    return T


def angle(a, b):
    """Return the angle between two rotation matrices; exact near zero, unlike the arc cosine of the trace."""
    return 2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))


def site_pose(data, name):
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = data.site(name).xpos, data.site(name).xmat.reshape(3, 3)
    return T


def random_q(rng, n):
    return rng.uniform(-1, 1, (n, 2, 6)) * JOINT_RANGE_RAD


def contacts(model, q):
    """Return the pairs of geom names in contact at any of the joint positions, (..., 2, 6)."""
    data, found = mujoco.MjData(model), set()
    for each in np.reshape(q, (-1, 12)):
        data.qpos[:12] = each
        mujoco.mj_forward(model, data)
        found |= {tuple(pair) for pair in data.contact.geom[data.contact.dist < 0.0].tolist()}
    return {tuple(sorted(model.geom(geom).name for geom in pair)) for pair in found}


def segment(model, data, geom, n=2):
    half = model.geom_size[geom, 1]
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
    return data.geom_xpos[geom] + np.linspace(-half, half, n)[:, None] * axis


def point_to_capsule(model, data, geom, points):
    a, b = segment(model, data, geom)
    t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1) - model.geom_size[geom, 0]
