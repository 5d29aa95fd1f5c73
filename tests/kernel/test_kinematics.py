"""The kernel's sines and forward kinematics, through the Cartesian speeds that it finds, against numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10.sim2real.control.limits import POINTS, Envelope, MotionLimits
from tests.sim2real.control.motion_checks import cartesian_use, elbow_position, flange
from tests.sim2real.control.reference_cell import dh_product
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD

TICK_S = 0.008
TOOLS = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.02, -0.03, 0.19), (0.0, 0.25, 0.1)), ((0.3, 0, 0), (0, 0, 0))]


def points(q_rad: np.ndarray, tcp_m) -> np.ndarray:
    """Return elbow, flange and TCP of both arms, (..., 2, 3, 3)."""
    position, rotation = flange(q_rad)
    tcp = position + np.einsum("...aij,aj->...ai", rotation, np.asarray(tcp_m))
    return np.stack([elbow_position(q_rad), position, tcp], axis=-2)


def test_the_reference_is_the_product_of_the_dh_matrices() -> None:
    for q in np.random.default_rng(0).uniform(-6.0, 6.0, (100, 6)):
        position, rotation = flange(q)
        np.testing.assert_allclose(position, dh_product(q)[:3, 3], atol=1e-14)
        np.testing.assert_allclose(rotation, dh_product(q)[:3, :3], atol=1e-14)


REST = 3e-10  # fraction of the limit at which a brake from rest moves, by the rounding of its coefficients


@pytest.mark.parametrize("tcp_m", TOOLS)
@pytest.mark.parametrize("size", [1.0, 1e-2, 1e-5])
def test_steps_are_those_of_the_forward_kinematics(tcp_m, size: float) -> None:
    limits = MotionLimits(tcp_m=tcp_m)
    envelope, rng, n = Envelope(limits, TICK_S, 3), np.random.default_rng(0), 5000
    begin = rng.uniform(-1, 1, (n, 2, 6)) * JOINT_RANGE_RAD
    end = begin + size * rng.uniform(-1, 1, (n, 2, 6)) * rng.integers(0, 2, (n, 1, 6))
    # One step, after which the arms are at rest.
    fraction, point = cartesian_use(envelope, np.stack([begin] * 3 + [end] * 3, axis=1).reshape(n, 6, 12))
    moved = np.linalg.norm(points(end, tcp_m) - points(begin, tcp_m), axis=-1) / (TICK_S * limits.tcp_speed_m_s)
    np.testing.assert_allclose(fraction, moved.max(axis=-1), rtol=1e-12, atol=REST)
    named = np.take_along_axis(moved, point[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(named, fraction, rtol=1e-12, atol=REST)
    assert {POINTS[each] for each in np.unique(point)} >= {"elbow", "flange"}
    assert ("TCP" in {POINTS[each] for each in np.unique(point)}) == bool(np.any(tcp_m))


@pytest.mark.parametrize("joint", range(5))
def test_sines_of_large_angles_are_reduced_exactly(joint: int) -> None:
    envelope, n = Envelope(MotionLimits(), TICK_S, 4), 20_000
    rng = np.random.default_rng(joint)
    q = np.zeros((n, 2, 6))
    q[:, :, joint] = rng.uniform(-1, 1, (n, 2)) * 10.0 ** rng.uniform(0, 5, (n, 2))
    # Next to multiples of a quarter turn, where reduction cancels.
    q[: n // 2, :, joint] = np.round(q[: n // 2, :, joint] / (np.pi / 2)) * (np.pi / 2)
    q[: n // 4, :, joint] *= 1.0 + rng.integers(-3, 4, (n // 4, 2)) * 2.0**-52
    # There and back to zero, where a brake does not move at all.
    window = np.zeros((n, 7, 12))
    window[:, 3] = q.reshape(n, 12)
    fraction, _ = cartesian_use(envelope, window)
    moved = np.linalg.norm(points(q, TOOLS[0]) - points(np.zeros((2, 6)), TOOLS[0]), axis=-1).max(axis=-1)
    np.testing.assert_allclose(fraction * (TICK_S * 1.5), moved, rtol=0, atol=3e-15)
