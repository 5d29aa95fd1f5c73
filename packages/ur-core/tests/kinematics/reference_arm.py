"""An independent UR10 for tests: the textbook product of DH matrices, random configurations and calibrations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ur_core.kinematics.ur10 import DH_A_M, DH_ALPHA_RAD, DH_D_M, JOINT_RANGE_RAD, NOMINAL_DH, DHParameters


def random_q(count: int, seed: int = 0, limit: np.ndarray = JOINT_RANGE_RAD) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-limit, limit, (count, 6))


def independent_pose(q: np.ndarray, dh: DHParameters = NOMINAL_DH) -> tuple[np.ndarray, np.ndarray]:
    """The textbook product of DH matrices, one configuration at a time."""
    poses = []
    for row in np.reshape(q, (-1, 6)):
        pose = np.eye(4)
        for a, d, alpha, offset, angle in zip(dh.a_m, dh.d_m, dh.alpha_rad, dh.theta_rad, row, strict=True):
            ct, s_t, ca, sa = np.cos(angle + offset), np.sin(angle + offset), np.cos(alpha), np.sin(alpha)
            pose = pose @ [
                [ct, -s_t * ca, s_t * sa, a * ct],
                [s_t, ct * ca, -ct * sa, a * s_t],
                [0, sa, ca, d],
                [0, 0, 0, 1],
            ]
        poses.append(pose)
    stack = np.reshape(poses, (*np.shape(q)[:-1], 4, 4))
    return stack[..., :3, 3], stack[..., :3, :3]


def angle_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix((first @ np.swapaxes(second, -1, -2)).reshape(-1, 3, 3)).magnitude()


def assert_reaches(
    q: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    dh: DHParameters = NOMINAL_DH,
    tolerance: float = 1e-10,
) -> None:
    found = independent_pose(q, dh)
    assert np.abs(found[0] - position).max() < tolerance
    assert angle_between(found[1], rotation).max() < tolerance


def calibration(seed: int, exchange_m: float = 0.0) -> DHParameters:
    """A calibrated arm: ±2 mm and ±3 mrad, and an exchange between d2 and d3 as UR's own calibrations show."""
    rng = np.random.default_rng(seed)
    d = DH_D_M + rng.uniform(-2e-3, 2e-3, 6) + np.array([0, exchange_m, -exchange_m, 0, 0, 0])
    return DHParameters(
        tuple(DH_A_M + rng.uniform(-2e-3, 2e-3, 6)),
        tuple(d),
        tuple(DH_ALPHA_RAD + rng.uniform(-3e-3, 3e-3, 6)),
        tuple(rng.uniform(-3e-3, 3e-3, 6)),
        robot="ur10",
    )
