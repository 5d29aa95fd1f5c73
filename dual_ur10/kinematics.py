"""Kinematics of one UR10: flange pose, Jacobian, inverse kinematics in closed form, inverse dynamics.

All functions are batched: joint angles have shape (..., 6) and results keep the leading axes. Units are m, rad, kg, s
and N·m. Every pose is that of the flange (UR's tool with a zero TCP; ``tool0`` in ROS) in UR's own ``base`` frame, the
one the controller's ``getActualTCPPose`` uses. ROS' ``base_link`` is turned by 180° about z against it: see
[to_base_link][dual_ur10.kinematics.to_base_link].

Inverse kinematics names its 8 branches by three signs, in C order of (elbow, wrist, shoulder), + first: index
``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_ur10.errors import SettingsError, UnreachableError
from dual_ur10.rotations import quat_from_matrix, quat_multiply
from dual_ur10.ur10 import (
    JOINT_RANGE_RAD,
    LINK_COM_M,
    LINK_INERTIA_KG_M2,
    LINK_MASS_KG,
    NOMINAL_DH,
    DHParameters,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def _constant(values: object) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


BASE_TO_BASE_LINK: Final = _constant([[-1, 0, 0], [0, -1, 0], [0, 0, 1]])
"""Rotation from coordinates in ``base`` to coordinates in ``base_link``; it is its own inverse. No offset."""

BASE_TO_BASE_LINK_QUAT: Final = _constant([0, 0, 0, 1])
"""The same as a quaternion (w, x, y, z); its inverse is the same rotation."""

_TWO_PI: Final = 2 * np.pi
_TINY: Final = 1e-300
_IDENTITY: Final = _constant(np.eye(3))

# Below this sine of theta5 the axes of wrists 1 and 3 are one line, and theta6 is free: it moves the flange by less.
_WRIST_SINGULAR: Final = 1e-8
# Up to this sine, rounding of the pose blurs theta6 enough to matter to a stretched arm.
_WRIST_BLURRED: Final = 1e-3
_BLUR_RAD: Final = 1e-11

# How far (in the cosine of theta3) rounding may put a stretched arm's pose outside the workspace; 1e-7 m at most.
_EDGE: Final = 1e-7
# The same before the polish for a calibrated arm, whose edges lie some mm elsewhere.
_CALIBRATED_EDGE: Final = 0.05

_LOWEST_RAD: Final = _constant(-JOINT_RANGE_RAD)
_TURN_LIMIT_RAD: Final = _constant(JOINT_RANGE_RAD + 1e-9)  # rounding may put a solution just past a joint limit
_POLISH_STEPS: Final = 12
_POLISH_DONE: Final = 1e-13  # m and rad; rounding leaves some 1e-15
_POLISH_ACCEPTED: Final = 1e-7  # as at the nominal arm's edge; elsewhere the steps end at _POLISH_DONE

_ORTHONORMAL_TOLERANCE: Final = 1e-5  # lets float32 rotations pass


def to_base_link(position_m: ArrayLike, rotation: ArrayLike) -> tuple[Array, Array]:
    """Turn poses in ``base`` into ``base_link``; the same function leads back.

    Args:
        position_m: (..., 3).
        rotation: (..., 3, 3).

    Returns:
        Position (..., 3) and rotation (..., 3, 3).
    """
    return np.asarray(position_m) @ BASE_TO_BASE_LINK, BASE_TO_BASE_LINK @ np.asarray(rotation)


def quat_to_base_link(quat: ArrayLike) -> Array:
    """Turn orientations (..., 4) in ``base`` into ``base_link``; twice gives the opposite sign of the same rotation."""
    return quat_multiply(BASE_TO_BASE_LINK_QUAT, quat)


# ---------------------------------------------------------------------------------------------------------------------
# Forward
# ---------------------------------------------------------------------------------------------------------------------


class _Chain(NamedTuple):
    """The link transforms as ``cos(q) * cosine + sin(q) * sine + constant``, each (6, 4, 4)."""

    cosine: Array
    sine: Array
    constant: Array


def _fixed_transforms(dh: DHParameters) -> Array:
    """(6, 4, 4): what follows each joint's rotation, ``Tz(d) Tx(a) Rx(alpha)``."""
    cos, sin = np.cos(dh.alpha_rad), np.sin(dh.alpha_rad)
    fixed = np.tile(np.eye(4), (6, 1, 1))
    fixed[:, 0, 3], fixed[:, 2, 3] = dh.a_m, dh.d_m
    fixed[:, 1, 1], fixed[:, 1, 2], fixed[:, 2, 1], fixed[:, 2, 2] = cos, -sin, sin, cos
    return fixed


@lru_cache(maxsize=32)
def _chain(dh: DHParameters) -> _Chain:
    fixed = _fixed_transforms(dh)
    turned = np.zeros((6, 4, 4))
    turned[:, 0], turned[:, 1] = -fixed[:, 1], fixed[:, 0]
    cosine, constant = fixed.copy(), fixed.copy()
    cosine[:, 2:] = 0.0
    constant[:, :2] = 0.0
    # The offsets in theta go into the constants.
    cos, sin = np.cos(dh.theta_rad)[:, None, None], np.sin(dh.theta_rad)[:, None, None]
    return _Chain(cosine * cos + turned * sin, turned * cos - cosine * sin, constant)


def _joints(q_rad: ArrayLike) -> Array:
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
    links = _links(_joints(q_rad), dh)
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
    return _pose_and_jacobian(_joints(q_rad), dh)[2]


def _pose_and_jacobian(q: Array, dh: DHParameters) -> tuple[Array, Array, Array]:
    links = _links(q, dh)
    frames = np.empty_like(links)  # frames[i] is the frame whose z axis joint i turns about
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
    """Elbow and flange position as a sum of sines: ``sin(q @ turns + phase) @ weights``.

    With theta1 to theta5, both positions are products of sines and cosines of sums of joint angles, and so sums of
    sines of sums of joint angles.

    Returns:
        turns (6, K), phase (K,), weights (K, 6): columns elbow x, y, z, flange x, y, z.
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

    def add(turns: Sequence[int], phase: float, column: int, weight: float) -> None:
        rows.setdefault((tuple(turns), phase), np.zeros(6))[column] += weight

    for first, terms in ((0, elbow), (3, flange)):
        add((0,) * 6, quarter, first + 2, d[0])
        for weight, turns, phase in terms:
            add(turns, phase, first + 2, weight)
            for sign in (1, -1):  # cos A cos B and cos A sin B, with A = turns + phase and B = theta1
                sum_ = (sign, *turns[1:])
                add(sum_, phase + quarter, first, weight / 2)
                add(sum_, phase, first + 1, sign * weight / 2)
    # Sideways of the plane, along (sin, -cos)(theta1): d4 + d6 cos(theta5).
    for turns, weight in (
        ((1, 0, 0, 0, 0, 0), d[3]),
        ((1, 0, 0, 0, 1, 0), d[5] / 2),
        ((1, 0, 0, 0, -1, 0), d[5] / 2),
    ):
        add(turns, 0.0, 3, weight)
        add(turns, quarter, 4, -weight)
    return (
        np.array([key[0] for key in rows], dtype=np.float64).T.copy(),
        np.array([key[1] for key in rows]),
        np.array(list(rows.values())),
    )


_TURNS, _PHASE, _WEIGHTS = _position_terms()


def elbow_and_flange_position(q_rad: ArrayLike) -> tuple[Array, Array]:
    """Return where the elbow and the flange of a nominal arm are, in ``base``; four numpy calls.

    Args:
        q_rad: (..., 6) joint angles.

    Returns:
        Elbow position (..., 3), the origin of DH frame 2, and flange position (..., 3), in m.

    Raises:
        SettingsError: Not six joints.
    """
    q = _joints(q_rad)
    angles = q.reshape(-1, 6) @ _TURNS
    angles += _PHASE
    positions = (np.sin(angles, out=angles) @ _WEIGHTS).reshape(q.shape)
    return positions[..., :3], positions[..., 3:]


# ---------------------------------------------------------------------------------------------------------------------
# Inverse
# ---------------------------------------------------------------------------------------------------------------------

# Signs of the 8 branches, as columns against the poses.
_SHOULDER: Final = _constant([[1], [-1], [1], [-1], [1], [-1], [1], [-1]])
_WRIST: Final = _constant([[1], [1], [-1], [-1], [1], [1], [-1], [-1]])
_ELBOW: Final = _constant([[1], [1], [1], [1], [-1], [-1], [-1], [-1]])


class _Branches(NamedTuple):
    """All branches of n poses, before any check of reach."""

    q: Array  # (n, 8, 6), not wrapped; meaningless where out of reach
    wrist_offset_m2: Array  # (n,) square of the wrist centre's distance from the base axis, less that of d4
    elbow_cosine: Array  # (n, 8) cosine of theta3; beyond ±1 where the wrist is out of reach


def _wrap(q: Array) -> Array:
    """Return angles in (-pi, pi]."""
    wrapped: Array = q - _TWO_PI * np.ceil((q - np.pi) / _TWO_PI)
    return wrapped


def _closed_form(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> _Branches:
    """Solve an arm whose axes are exactly parallel and square, with the lengths of ``dh``.

    Arrays have the shape (8, n), the poses last. Every angle comes from an arc tangent of its sine and cosine, and each
    later one makes up for the rounding of the ones before it, so that the pose stays right to rounding at the
    singularities too.

    Args:
        position: (n, 3).
        rotation: (n, 3, 3).
        dh: Lengths and theta offsets; twists, and lengths that are zero on a nominal arm, are left out.
        reference: (n, 6), where to take theta6 from if it is free and this in reach; zero without.
    """
    a2, a3 = dh.a_m[1], dh.a_m[2]
    d1, d4, d5, d6 = dh.d_m[0], dh.d_m[1] + dh.d_m[2] + dh.d_m[3], dh.d_m[4], dh.d_m[5]
    px, py, pz = (position - d6 * rotation[:, :, 2]).T  # wrist centre
    rows = np.ascontiguousarray(rotation.transpose(1, 2, 0))[:, :, None]  # [i, j]: base axis i along flange axis j

    # Theta1 puts the wrist centre at d4 beside the arm's plane; along the plane it is then at `along`.
    radius2 = px * px + py * py
    offset2 = radius2 - d4 * d4
    along = _SHOULDER * np.sqrt(np.maximum(offset2, 0.0))
    scale = 1.0 / np.maximum(radius2, _TINY)
    sin1, cos1 = (along * py + d4 * px) * scale, (along * px - d4 * py) * scale

    # Theta5 and theta6 from the normal of the arm's plane, seen from the flange.
    normal_x, normal_y, cos5 = rows[0] * sin1 - rows[1] * cos1
    sin5 = np.sqrt(normal_x * normal_x + normal_y * normal_y)
    scale = _WRIST / np.maximum(sin5, _TINY)
    cos6, sin6 = normal_x * scale, -normal_y * scale
    if sin5.min(initial=1.0) < _WRIST_BLURRED:
        theta6 = np.zeros(len(position)) if reference is None else reference[:, 5] + dh.theta_rad[5]
        cos_ref, sin_ref = _WRIST * np.cos(theta6), _WRIST * np.sin(theta6)
        # Take the reference's theta6 wherever that turns the flange by hardly more than rounding does.
        blurred = np.abs(normal_x * sin_ref + normal_y * cos_ref) < _BLUR_RAD
        free = (sin5 < _WRIST_SINGULAR) | (blurred & (cos6 * cos_ref + sin6 * sin_ref > 0.0))
        cos6, sin6 = np.where(free, cos_ref, cos6), np.where(free, sin_ref, sin6)
        # Where that asks too much of a stretched arm, let wrist 2's axis point from the shoulder to the wrist centre,
        # which spares it most.
        height = pz - d1
        length = np.sqrt(along * along + height * height)
        axis_x, axis_y, axis_z = rows[:, 0] * sin6 + rows[:, 1] * cos6
        gain = -d5 * ((axis_x * cos1 + axis_y * sin1) * along + axis_z * height)
        far = length * length + d5 * d5 - 2 * gain > (a2 + a3) ** 2 * (1 + 0.1 * _EDGE)
        outward = (np.stack((cos1 * along, sin1 * along, height + 0 * along)) / np.maximum(length, _TINY))[:, None]
        sin_out, cos_out = -(rows[:, :2] * outward).sum(0)
        far &= sin5 < _WRIST_SINGULAR
        cos6, sin6 = np.where(far, cos_out, cos6), np.where(far, sin_out, sin6)

    # Wrist 2's axis lies in the arm's plane, a quarter turn behind theta2 + theta3 + theta4.
    axis_x, axis_y, cos234 = rows[:, 0] * sin6 + rows[:, 1] * cos6
    sin234 = -(axis_x * cos1 + axis_y * sin1)

    # A triangle of upper arm and forearm remains.
    x, y = along - d5 * sin234, (pz - d1) + d5 * cos234
    cos3 = (x * x + y * y - (a2 * a2 + a3 * a3)) * (0.5 / (a2 * a3))
    sin3 = _ELBOW * np.sqrt(np.maximum(1.0 - cos3 * cos3, 0.0))
    near, beside = a2 + a3 * cos3, a3 * sin3

    out = np.empty((6, 8, len(position)))
    out[0] = np.arctan2(sin1, cos1)
    out[1] = theta2 = np.arctan2(y * near - x * beside, x * near + y * beside)
    out[2] = theta3 = np.arctan2(sin3, cos3)
    out[3] = np.arctan2(sin234, cos234) - theta2 - theta3
    out[4] = np.arctan2(_WRIST * sin5, cos5)
    out[5] = np.arctan2(sin6, cos6)
    if dh is not NOMINAL_DH:
        out -= np.reshape(dh.theta_rad, (6, 1, 1))
    return _Branches(out.T, offset2, cos3.T)


def _within(branches: _Branches, edge: float) -> Mask:
    """(n, 8): which branches reach their pose, give or take ``edge``."""
    reached: Mask = np.abs(branches.elbow_cosine) <= 1.0 + edge
    reached &= (branches.wrist_offset_m2 >= -edge)[:, None]
    return reached


def _polish(q: Array, position: Array, rotation: Array, dh: DHParameters) -> tuple[Array, Mask]:
    """Refine m solutions on the true chain by Levenberg-Marquardt, whose damping fades with the error.

    Args:
        q: (m, 6) start.
        position: (m, 3).
        rotation: (m, 3, 3).
        dh: The true chain.

    Returns:
        Angles (m, 6), not wrapped, and which of them (m,) hold their pose to 1e-7 m and 1e-7 rad.
    """
    q = q.copy()
    good = np.zeros(len(q), dtype=np.bool_)
    todo = np.arange(len(q))
    for _ in range(_POLISH_STEPS):
        at, turned, jac = _pose_and_jacobian(q[todo], dh)
        error = np.empty((len(todo), 6, 1))
        error[:, :3, 0] = position[todo] - at
        off = rotation[todo] @ turned.transpose(0, 2, 1)
        # The sine of the angle times its axis: enough near zero, where it counts.
        error[:, 3:, 0] = 0.5 * (off[:, (2, 0, 1), (1, 2, 0)] - off[:, (1, 2, 0), (2, 0, 1)])
        size = np.abs(error).max((1, 2))
        # Half a turn off has a zero sine as well; its trace tells.
        good[todo] = (size < _POLISH_ACCEPTED) & (off.trace(axis1=1, axis2=2) > 0.0)
        more = size > _POLISH_DONE
        todo, error, jac = todo[more], error[more], jac[more]
        if not len(todo):
            break
        transposed = jac.transpose(0, 2, 1)
        damping = (0.1 * (error * error).sum(1, keepdims=True) + 1e-13) * np.eye(6)
        q[todo] += np.linalg.solve(transposed @ jac + damping, transposed @ error)[:, :, 0]
    return q, good


def _solve(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> tuple[Array, Mask]:
    """All branches of n poses: angles (n, 8, 6), not wrapped, and which (n, 8) hold.

    A calibrated arm near a singularity can lose a branch, as two starts meet in one solution. With a reference, what is
    found from there becomes a ninth.
    """
    nominal = dh is NOMINAL_DH or dh.is_nominal
    branches = _closed_form(position, rotation, NOMINAL_DH if nominal else dh, reference)
    valid = _within(branches, _EDGE if nominal else _CALIBRATED_EDGE)
    if nominal:
        return branches.q, valid
    q = branches.q.copy()
    if reference is not None:
        q = np.concatenate((q, reference[:, None]), axis=1)
        valid = np.concatenate((valid, np.ones((len(q), 1), dtype=np.bool_)), axis=1)
    rows, columns = valid.nonzero()
    q[rows, columns], valid[rows, columns] = _polish(q[rows, columns], position[rows], rotation[rows], dh)
    return q, valid


def _poses(position: ArrayLike, rotation: ArrayLike) -> tuple[tuple[int, ...], Array, Array]:
    """Check poses and flatten them: batch shape, positions (n, 3), rotations (n, 3, 3)."""
    p, r = np.asarray(position, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
    if p.shape[-1:] != (3,) or r.shape[-2:] != (3, 3):
        raise SettingsError(f"poses need the shapes (..., 3) and (..., 3, 3), found {p.shape} and {r.shape}")
    if p.shape[:-1] != r.shape[:-2]:
        batch = np.broadcast_shapes(p.shape[:-1], r.shape[:-2])
        p, r = np.broadcast_to(p, (*batch, 3)), np.broadcast_to(r, (*batch, 3, 3))
    batch, p, r = p.shape[:-1], p.reshape(-1, 3), r.reshape(-1, 3, 3)
    if not np.isfinite(p).all():
        row = int((~np.isfinite(p).all(-1)).argmax())
        raise SettingsError(f"position of pose {row} is {p[row].tolist()}: positions must be finite")
    off = np.abs(r @ r.transpose(0, 2, 1) - _IDENTITY)
    if off.size and not off.max() < _ORTHONORMAL_TOLERANCE:
        row = int((~(off.max((1, 2)) < _ORTHONORMAL_TOLERANCE)).argmax())
        raise SettingsError(
            f"rotation of pose {row} is no rotation matrix (R R' differs from 1 by {off[row].max():.3g}, allowed "
            f"{_ORTHONORMAL_TOLERANCE:g}): {r[row].tolist()}. Normalise it, and look for NaN"
        )
    return batch, p, r


def _reference(reference_q_rad: ArrayLike, batch: tuple[int, ...]) -> Array:
    """Check the reference, bring it into the joint range, and shape it (n, 6)."""
    reference = _joints(reference_q_rad)
    if not np.isfinite(reference).all():
        raise SettingsError(f"reference joint angles must be finite, found {reference.tolist()}")
    if reference.shape[:-1] != batch:
        reference = np.broadcast_to(reference, (*batch, 6))
    return np.minimum(np.maximum(reference.reshape(-1, 6), _LOWEST_RAD), JOINT_RANGE_RAD)


def inverse(
    position: ArrayLike,
    rotation: ArrayLike,
    dh: DHParameters = NOMINAL_DH,
    reference_q_rad: ArrayLike | None = None,
) -> tuple[Array, Mask]:
    """Return all joint angles that put the flange at given poses in ``base``.

    Answers are exact to rounding, but for the singularities: a stretched arm's pose that rounding puts outside the
    workspace is solved within 1e-7 m, and where theta5 is within 1e-8 of a multiple of pi, theta6 is free and taken
    from the reference (zero without one). For a calibrated arm, the closed form is the start of some damped Newton
    steps on its true chain; a branch that fails to converge is not valid.

    Args:
        position: (..., 3) in m.
        rotation: (..., 3, 3).
        dh: Denavit-Hartenberg parameters of this arm.
        reference_q_rad: (..., 6) or None.

    Returns:
        Solutions (..., 8, 6), angles in (-pi, pi], NaN where not valid; and valid (..., 8).

    Raises:
        SettingsError: Wrong shapes, NaN or infinity, or no rotation matrix.
    """
    batch, p, r = _poses(position, rotation)
    q, valid = _solve(p, r, dh, None if reference_q_rad is None else _reference(reference_q_rad, batch))
    q, valid = _wrap(q[:, :8]), valid[:, :8]
    return np.where(valid[..., None], q, np.nan).reshape(*batch, 8, 6), valid.reshape(*batch, 8)


def try_nearest(
    position: ArrayLike,
    rotation: ArrayLike,
    reference_q_rad: ArrayLike,
    dh: DHParameters = NOMINAL_DH,
) -> tuple[Array, Mask]:
    """Return the joint angles nearest to a reference that put the flange at given poses in ``base``.

    Nearest among all branches and all turns within ``JOINT_RANGE_RAD``, by the plain Euclidean norm over six joints.

    Args:
        position: (..., 3) in m.
        rotation: (..., 3, 3).
        reference_q_rad: (..., 6); brought into the joint range first.
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        Angles (..., 6), and which poses (...) were reached. The others hold their reference.

    Raises:
        SettingsError: Wrong shapes, NaN or infinity, or no rotation matrix.
    """
    batch, p, r = _poses(position, rotation)
    reference = _reference(reference_q_rad, batch)
    q, valid = _solve(p, r, dh, reference)
    here = reference[:, None, :]
    q = q + _TWO_PI * np.rint((here - q) / _TWO_PI)
    beyond = np.abs(q) > _TURN_LIMIT_RAD
    if beyond.any():
        q -= _TWO_PI * np.copysign(beyond, q)
    away = q - here
    distance = (away * away).sum(-1)
    distance[~valid] = np.inf
    rows, best = np.arange(len(q)), distance.argmin(1)
    ok: Mask = valid[rows, best]
    chosen = np.minimum(np.maximum(q[rows, best], _LOWEST_RAD), JOINT_RANGE_RAD)
    if not ok.all():
        chosen = np.where(ok[:, None], chosen, reference)
    return chosen.reshape(*batch, 6), ok.reshape(batch)


def nearest(
    position: ArrayLike,
    rotation: ArrayLike,
    reference_q_rad: ArrayLike,
    dh: DHParameters = NOMINAL_DH,
) -> Array:
    """Return the joint angles nearest to a reference; like ``try_nearest``, but every pose must be in reach.

    Args:
        position: (..., 3) in m.
        rotation: (..., 3, 3).
        reference_q_rad: (..., 6).
        dh: Denavit-Hartenberg parameters of this arm.

    Returns:
        Angles (..., 6).

    Raises:
        SettingsError: Wrong shapes, NaN or infinity, or no rotation matrix.
        UnreachableError: A pose has no solution within the joint range.
    """
    q, ok = try_nearest(position, rotation, reference_q_rad, dh)
    if not ok.all():
        _, p, r = _poses(position, rotation)
        raise UnreachableError(_why_unreachable(p, r, dh, (~ok.reshape(-1)).nonzero()[0]))
    return q


def _why_unreachable(position: Array, rotation: Array, dh: DHParameters, rows: NDArray[np.intp]) -> str:
    row = int(rows[0])
    branches = _closed_form(position[row : row + 1], rotation[row : row + 1], dh, None)
    shown = ", ".join(str(index) for index in rows[:8]) + (", ..." if len(rows) > 8 else "")
    where = f"{len(rows)} of {len(position)} flange poses out of reach (row {shown}). Row {row}, at "
    where += f"({', '.join(f'{value:.4f}' for value in position[row])}) m in base: "
    a2, a3, d4 = abs(dh.a_m[1]), abs(dh.a_m[2]), abs(sum(dh.d_m[1:4]))
    offset2 = float(branches.wrist_offset_m2[0])
    cosine = branches.elbow_cosine[0]
    cosine = float(cosine[np.abs(cosine).argmin()])
    if offset2 < 0.0:
        found = (
            f"the wrist centre is {np.sqrt(max(offset2 + d4 * d4, 0.0)):.4f} m from the base's vertical axis, allowed "
            f"is at least {d4:.4f} m. Move the pose away from the axis, or turn the tool"
        )
    elif abs(cosine) > 1.0:
        length = np.sqrt(max(a2 * a2 + a3 * a3 + 2 * a2 * a3 * cosine, 0.0))
        found = (
            f"wrist 1 would have to be {length:.4f} m from the shoulder, allowed are {abs(a2 - a3):.4f} to "
            f"{a2 + a3:.4f} m. Move the pose {'towards' if cosine > 1 else 'away from'} the base, or turn the tool"
        )
    else:
        found = (
            "it is at the very edge of what this calibrated arm reaches. Move the pose inwards, or start from a nearer "
            "reference"
        )
    return where + found


# ---------------------------------------------------------------------------------------------------------------------
# Dynamics
# ---------------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=32)
def _dynamics(payload_kg: float, payload_com_m: tuple[float, float, float], gravity: bool) -> tuple[Any, Any, Any]:
    """Return pinocchio's module, model and data of a nominal arm with a point mass at the flange."""
    pin = importlib.import_module("pinocchio")  # here, because it takes longer to import than the rest of the package
    model = pin.Model()
    joint, placement = 0, np.eye(4)
    for link, fixed in enumerate(_fixed_transforms(NOMINAL_DH)):
        joint = model.addJoint(joint, pin.JointModelRZ(), pin.SE3(placement), f"joint_{link + 1}")
        xx, yy, zz, xy, xz, yz = LINK_INERTIA_KG_M2[link]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pin.Inertia(LINK_MASS_KG[link], LINK_COM_M[link], inertia)
        model.appendBodyToJoint(joint, body, pin.SE3(fixed))
        placement = fixed
    if payload_kg:
        payload = pin.Inertia(payload_kg, np.array(payload_com_m), np.zeros((3, 3)))
        model.appendBodyToJoint(joint, payload, pin.SE3(placement))
    if not gravity:
        model.gravity = pin.Motion.Zero()
    return pin, model, model.createData()


def inverse_dynamics(
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    payload_kg: float = 0.0,
    payload_com_m: Sequence[float] = (0.0, 0.0, 0.0),
    gravity: bool = True,
    armature_kg_m2: float = 0.0,
) -> Array:
    """Return the joint torques of a motion of a nominal arm on an upright base, without friction; by pinocchio.

    Args:
        q_rad: (..., 6) joint angles; the three arrays broadcast.
        qd_rad_s: (..., 6) joint speeds.
        qdd_rad_s2: (..., 6) joint accelerations.
        payload_kg: Mass of a point payload.
        payload_com_m: Its place in the flange frame.
        gravity: Whether to count gravity, 9.81 m/s² along -z of ``base``.
        armature_kg_m2: Reflected inertia of every rotor, ``ARMATURE_KG_M2`` on the simulated arm.

    Returns:
        Torques (..., 6) in N·m.

    Raises:
        SettingsError: Not six joints, or a payload that is negative or not finite.
    """
    com = (float(payload_com_m[0]), float(payload_com_m[1]), float(payload_com_m[2]))
    if not (np.isfinite((payload_kg, *com)).all() and payload_kg >= 0.0):
        raise SettingsError(f"payload must be finite and not negative, found {payload_kg!r} kg at {com} m")
    pin, model, data = _dynamics(float(payload_kg), com, bool(gravity))
    q, qd, qdd = np.broadcast_arrays(_joints(q_rad), _joints(qd_rad_s), _joints(qdd_rad_s2))
    torque = np.empty(q.shape)
    flat = (array.reshape(-1, 6) for array in (q, qd, qdd))
    rows = torque.reshape(-1, 6)
    for index, (position, speed, acceleration) in enumerate(zip(*flat, strict=True)):
        rows[index] = pin.rnea(model, data, position, speed, acceleration)
    if armature_kg_m2:
        torque += armature_kg_m2 * qdd
    return torque
