"""Forward kinematics of one UR10: flange pose, Jacobian, and positions of elbow, flange and TCP.

Joint angles have shape (..., 6) and results keep the leading axes. Poses are those of the flange in UR's own ``base``
frame; see [kinematics][dual_ur10.kinematics].
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.rotations import quat_from_matrix
from dual_ur10.kinematics.ur10 import NOMINAL_DH, DHParameters
from dual_ur10.types import Array


class _Chain(NamedTuple):
    """The link transforms as ``cos(q) * cosine + sin(q) * sine + constant``, each (6, 4, 4)."""

    cosine: Array
    sine: Array
    constant: Array


def fixed_transforms(dh: DHParameters) -> Array:
    """Return the transforms (6, 4, 4) after each joint's rotation, ``Tz(d) Tx(a) Rx(alpha)``."""
    cos, sin = np.cos(dh.alpha_rad), np.sin(dh.alpha_rad)
    fixed = np.tile(np.eye(4), (6, 1, 1))
    fixed[:, 0, 3], fixed[:, 2, 3] = dh.a_m, dh.d_m
    fixed[:, 1, 1], fixed[:, 1, 2], fixed[:, 2, 1], fixed[:, 2, 2] = cos, -sin, sin, cos
    return fixed


@lru_cache(maxsize=32)
def _chain(dh: DHParameters) -> _Chain:
    fixed = fixed_transforms(dh)
    rotated = np.zeros((6, 4, 4))
    rotated[:, 0], rotated[:, 1] = -fixed[:, 1], fixed[:, 0]
    cosine, constant = fixed.copy(), fixed.copy()
    cosine[:, 2:] = 0.0
    constant[:, :2] = 0.0
    # The offsets in theta go into the constants.
    cos, sin = np.cos(dh.theta_rad)[:, None, None], np.sin(dh.theta_rad)[:, None, None]
    return _Chain(cosine * cos + rotated * sin, rotated * cos - cosine * sin, constant)


def checked_joints(q_rad: ArrayLike) -> Array:
    """Return joint angles as an array.

    Raises:
        SettingsError: Not six joints.
    """
    q = np.asarray(q_rad, dtype=np.float64)
    if q.shape[-1:] != (6,):
        raise SettingsError(f"joint angles need the shape (..., 6), found {q.shape}")
    return q


def _links(q: Array, dh: DHParameters) -> Array:
    """(..., 6, 4, 4): the transform across each joint and its link."""
    chain = _chain(dh)
    links: Array = np.cos(q)[..., None, None] * chain.cosine
    links += np.sin(q)[..., None, None] * chain.sine
    links += chain.constant
    return links


def flange_pose(q_rad: ArrayLike, dh: DHParameters = NOMINAL_DH) -> tuple[Array, Array]:
    """Return the flange pose in ``base``.

    Args:
        q_rad: (..., 6) joint angles.
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        Position (..., 3) in m and rotation matrix (..., 3, 3).

    Raises:
        SettingsError: Not six joints.
    """
    links = _links(checked_joints(q_rad), dh)
    pairs = links[..., 0::2, :, :] @ links[..., 1::2, :, :]
    flange = pairs[..., 0, :, :] @ pairs[..., 1, :, :] @ pairs[..., 2, :, :]
    return flange[..., :3, 3], flange[..., :3, :3]


def flange_pose_quat(q_rad: ArrayLike, dh: DHParameters = NOMINAL_DH) -> tuple[Array, Array]:
    """Return the flange pose in ``base`` as position (..., 3) and quaternion (..., 4), w >= 0; see ``flange_pose``."""
    position, rotation = flange_pose(q_rad, dh)
    return position, quat_from_matrix(rotation)


def jacobian(q_rad: ArrayLike, dh: DHParameters = NOMINAL_DH) -> Array:
    """Return the geometric Jacobian of the flange in ``base``.

    Args:
        q_rad: (..., 6) joint angles.
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        (..., 6, 6): three rows of m/s, then three rows of rad/s, per rad/s of each joint.

    Raises:
        SettingsError: Not six joints.
    """
    return pose_and_jacobian(checked_joints(q_rad), dh)[2]


def pose_and_jacobian(q: Array, dh: DHParameters) -> tuple[Array, Array, Array]:
    """Return flange position, rotation and Jacobian, which share most of their work; unchecked."""
    links = _links(q, dh)
    frames = np.empty_like(links)  # joint i rotates about the z axis of frames[i]
    frames[..., 0, :, :] = np.eye(4)
    for joint in range(5):
        np.matmul(frames[..., joint, :, :], links[..., joint, :, :], out=frames[..., joint + 1, :, :])
    flange = frames[..., 5, :, :] @ links[..., 5, :, :]
    position = flange[..., :3, 3]
    axis = np.moveaxis(frames[..., :3, 2], -1, -2)  # (..., 3, 6)
    arm = position[..., :, None] - np.moveaxis(frames[..., :3, 3], -1, -2)
    jac = np.empty((*q.shape[:-1], 6, 6))
    for row, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        jac[..., row, :] = axis[..., i, :] * arm[..., j, :] - axis[..., j, :] * arm[..., i, :]
    jac[..., 3:, :] = axis
    return position, flange[..., :3, :3], jac


def _position_terms() -> tuple[Array, Array, Array]:
    """Elbow and flange position as a sum of sines: ``sin(q @ multiples + phase) @ weights``.

    With theta1 to theta5, both positions are products of sines and cosines of sums of joint angles, and so sums of
    sines of sums of joint angles.

    Returns:
        multiples (6, K), phase (K,), weights (K, 6): columns elbow x, y, z, flange x, y, z.
    """
    a, d = NOMINAL_DH.a_m, NOMINAL_DH.d_m
    quarter = np.pi / 2
    q2, q23, q234 = (0, 1, 0, 0, 0, 0), (0, 1, 1, 0, 0, 0), (0, 1, 1, 1, 0, 0)
    open_, close = (0, 1, 1, 1, 1, 0), (0, 1, 1, 1, -1, 0)
    # In the arm's plane: the radius is the sum of weight * cos(angle), the height that of weight * sin(angle).
    # From wrist 3 on, -d6 sin(theta5) (cos, sin)(theta234) is split into sines of theta234 ± theta5.
    elbow = [(a[1], q2, 0.0)]
    flange = [
        *elbow,
        (a[2], q23, 0.0),
        (d[4], q234, -quarter),
        (d[5] / 2, open_, quarter),
        (d[5] / 2, close, -quarter),
    ]
    rows: dict[tuple[tuple[int, ...], float], Array] = {}

    def add(multiples: Sequence[int], phase: float, column: int, weight: float) -> None:
        rows.setdefault((tuple(multiples), phase), np.zeros(6))[column] += weight

    for first, terms in ((0, elbow), (3, flange)):
        add((0,) * 6, quarter, first + 2, d[0])
        for weight, multiples, phase in terms:
            add(multiples, phase, first + 2, weight)
            for sign in (1, -1):  # cos A cos B and cos A sin B, with A = multiples + phase and B = theta1
                sum_ = (sign, *multiples[1:])
                add(sum_, phase + quarter, first, weight / 2)
                add(sum_, phase, first + 1, sign * weight / 2)
    # Sideways of the plane, along (sin, -cos)(theta1): d4 + d6 cos(theta5).
    for multiples, weight in (
        ((1, 0, 0, 0, 0, 0), d[3]),
        ((1, 0, 0, 0, 1, 0), d[5] / 2),
        ((1, 0, 0, 0, -1, 0), d[5] / 2),
    ):
        add(multiples, 0.0, 3, weight)
        add(multiples, quarter, 4, -weight)
    return (
        np.array([key[0] for key in rows], dtype=np.float64).T.copy(),
        np.array([key[1] for key in rows]),
        np.array(list(rows.values())),
    )


_MULTIPLES, _PHASE, _WEIGHTS = _position_terms()


def elbow_and_flange_position(q_rad: ArrayLike) -> tuple[Array, Array]:
    """Return the positions of elbow and flange of a nominal arm, in ``base``.

    Args:
        q_rad: (..., 6) joint angles.

    Returns:
        Elbow position (..., 3), the origin of DH frame 2, and flange position (..., 3), in m.

    Raises:
        SettingsError: Not six joints.
    """
    positions = elbow_and_flange(checked_joints(q_rad))
    return positions[..., :3], positions[..., 3:]


def elbow_and_flange(q_rad: Array) -> Array:
    """Return both positions of `elbow_and_flange_position`, (..., 6) in m, unchecked and in four numpy calls.

    The last two axes are one matrix product, so that a row of an (n, m, 6) batch does not depend on n to the last bit.
    """
    angles: Array = q_rad @ _MULTIPLES
    angles += _PHASE
    positions: Array = np.sin(angles, out=angles) @ _WEIGHTS
    return positions


def elbow_flange_and_tcp(q_rad: Array, tcp_m: Sequence[Sequence[float]]) -> Array:
    """Return the positions of elbow, flange and, if one is not at its flange, tool centre point of both nominal arms.

    Args:
        q_rad: (..., 2, 6) joint angles of both arms.
        tcp_m: (2, 3) tool centre points in the flange frames; zeros: at the flange.

    Returns:
        (..., 2, 2 or 3, 3) positions in each arm's `base`, in m.
    """
    points = elbow_and_flange(q_rad.reshape(*q_rad.shape[:-3], -1, 6)).reshape(*q_rad.shape[:-1], 2, 3)
    offset = np.asarray(tcp_m, dtype=np.float64)
    if not offset.any():
        return points
    rotation = flange_pose(q_rad)[1]
    tool = points[..., 1, :] + (rotation @ offset[..., None])[..., 0]
    return np.concatenate([points, tool[..., None, :]], axis=-2)
