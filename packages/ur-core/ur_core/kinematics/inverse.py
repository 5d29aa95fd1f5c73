"""Inverse kinematics of one arm: all branches, or the configuration nearest to another one.

The closed form solves a nominal arm. The axes of a calibrated arm are not exactly parallel and perpendicular: there the
closed form is the start of some damped Newton steps.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ur_core.errors import SettingsError, UnreachableError
from ur_core.kernel import Constants, call
from ur_core.kinematics.forward import checked_joints, lengths_m, pose_and_jacobian
from ur_core.kinematics.ur10 import JOINT_RANGE_RAD, DHParameters
from ur_core.types import Array, Mask, constant

_EDGE: Final = 1e-7
"""Tolerance, in the cosine of theta3, for a stretched arm's pose that rounding puts outside the workspace; 1e-7 m."""


class _Branches(NamedTuple):
    """All branches of n poses, before any check of reach.

    They are named by three signs, in C order of (elbow, wrist, shoulder), + first: index
    ``4 * elbow + 2 * wrist + shoulder``. Elbow + is theta3 >= 0, wrist + is theta5 >= 0.
    """

    q: Array  # (n, 8, 6), not wrapped; meaningless where out of reach
    wrist_offset_m2: Array  # (n,) square of the wrist centre's distance from the base axis, less that of d4
    elbow_cosine: Array  # (n, 8) cosine of theta3; beyond ±1 where the wrist is out of reach


@lru_cache(maxsize=32)
def _coefficients(dh: DHParameters) -> Constants:
    """Return the arm as the kernel takes it: lengths, twists ignored, theta offsets, and the tolerance at the edge."""
    return Constants(np.concatenate([lengths_m(dh), dh.theta_rad, [_EDGE]]))


def _pose_block(position: Array, rotation: Array, reference: Array, size: int) -> Array:
    """Return rows of the kernel's input and output, (n, size), of poses (n, 3), (n, 3, 3) and references (n, 6)."""
    n = len(position)
    block: Array = np.empty((n, size))
    block[:, :3], block[:, 3:12], block[:, 12:18] = position, rotation.reshape(n, 9), reference
    return block


def _closed_form(position: Array, rotation: Array, dh: DHParameters, reference: Array | None) -> _Branches:
    """Solve an arm whose axes are exactly parallel and perpendicular, with the lengths of ``dh``.

    Args:
        position: (n, 3).
        rotation: (n, 3, 3).
        dh: Lengths and theta offsets; twists, and lengths that are zero on a nominal arm, are ignored.
        reference: (n, 6) angles from which a free theta6 is taken if the pose stays in reach; None: zero.
    """
    block = _pose_block(position, rotation, -np.asarray(dh.theta_rad) if reference is None else reference, 75)
    call("inverse_branches", _coefficients(dh), block, len(block))
    return _Branches(block[:, 18:66].reshape(-1, 8, 6), block[:, 74], block[:, 66:74])


def _within(branches: _Branches, edge: float) -> Mask:
    """(n, 8): which branches reach their pose, give or take ``edge``."""
    reached: Mask = np.abs(branches.elbow_cosine) <= 1.0 + edge
    reached &= (branches.wrist_offset_m2 >= -edge)[:, None]
    return reached


_TWO_PI: Final = 2 * np.pi
_IDENTITY: Final = constant(np.eye(3))

# Allowed at the edge of the workspace before the polish: a calibrated arm's edges lie some mm elsewhere.
_CALIBRATED_EDGE: Final = 0.05

_POLISH_STEPS: Final = 12
_POLISH_DONE: Final = 1e-13  # m and rad; rounding leaves some 1e-15
_POLISH_ACCEPTED: Final = 1e-7  # as at the nominal arm's edge; elsewhere the steps end at _POLISH_DONE

_ORTHONORMAL_TOLERANCE: Final = 1e-5  # lets float32 rotations pass
_LIMITS: Final = Constants(np.append(JOINT_RANGE_RAD, _ORTHONORMAL_TOLERANCE))
_POSITION, _ROTATION = -1.0, -2.0  # parts at fault in the kernel's check; the third is the reference


def _wrap(q: Array) -> Array:
    """Return angles in (-pi, pi]."""
    wrapped: Array = q - _TWO_PI * np.ceil((q - np.pi) / _TWO_PI)
    return wrapped


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
        at, orientation, jac = pose_and_jacobian(q[todo], dh)
        error = np.empty((len(todo), 6, 1))
        error[:, :3, 0] = position[todo] - at
        off = rotation[todo] @ orientation.transpose(0, 2, 1)
        # The sine of the angle times its axis: enough near zero, where it counts.
        error[:, 3:, 0] = 0.5 * (off[:, (2, 0, 1), (1, 2, 0)] - off[:, (1, 2, 0), (2, 0, 1)])
        size = np.abs(error).max((1, 2))
        # An error of 180° has a zero sine as well, but a negative trace.
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

    A calibrated arm near a singularity can lose a branch, as two starts meet in one solution. With a reference, the
    solution found from there becomes a ninth.
    """
    nominal = dh.is_nominal
    branches = _closed_form(position, rotation, dh, reference)
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


def _block(
    position: ArrayLike, rotation: ArrayLike, reference_q_rad: ArrayLike, size: int
) -> tuple[tuple[int, ...], Array]:
    """Return the batch shape of poses and their references, and rows of the kernel, (n, size), with their values."""
    p, r = np.asarray(position, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
    if p.shape[-1:] != (3,) or r.shape[-2:] != (3, 3):
        raise SettingsError(f"poses need the shapes (..., 3) and (..., 3, 3), found {p.shape} and {r.shape}")
    reference, batch = checked_joints(reference_q_rad), p.shape[:-1]
    if batch != r.shape[:-2]:
        batch = np.broadcast_shapes(batch, r.shape[:-2])
        p, r = np.broadcast_to(p, (*batch, 3)), np.broadcast_to(r, (*batch, 3, 3))
    if reference.shape[:-1] != batch:
        reference = np.broadcast_to(reference, (*batch, 6))
    return batch, _pose_block(p.reshape(-1, 3), r.reshape(-1, 3, 3), reference.reshape(-1, 6), size)


def _raise_fault(block: Array) -> None:
    """Raise what the kernel found in its check of a row."""
    row = int((block[:, -1] < 0.0).argmax())
    position, rotation, reference = block[row, :3], block[row, 3:12].reshape(3, 3), block[row, 12:18]
    fault = block[row, -1]
    if fault == _POSITION:
        raise SettingsError(f"position of pose {row} is {position.tolist()}: positions must be finite")
    if fault == _ROTATION:
        off = np.abs(rotation @ rotation.T - _IDENTITY).max()
        raise SettingsError(
            f"rotation of pose {row} is no rotation matrix (R R' differs from 1 by {off:.3g}, allowed "
            f"{_ORTHONORMAL_TOLERANCE:g}): {rotation.tolist()}. Normalise it, and look for NaN"
        )
    raise SettingsError(f"reference joint angles must be finite, found {reference.tolist()} for pose {row}")


def _checked(
    position: ArrayLike, rotation: ArrayLike, reference_q_rad: ArrayLike
) -> tuple[tuple[int, ...], Array, Array, Array]:
    """Check poses and references: batch shape, positions (n, 3), rotations (n, 3, 3), references (n, 6) in range."""
    batch, block = _block(position, rotation, reference_q_rad, 19)
    call("inverse_check", _LIMITS, block, len(block))
    if np.count_nonzero(block[:, 18]):
        _raise_fault(block)
    p, r, reference = (np.ascontiguousarray(block[:, part]) for part in (slice(3), slice(3, 12), slice(12, 18)))
    return batch, p, r.reshape(-1, 3, 3), reference


def inverse(
    position: ArrayLike,
    rotation: ArrayLike,
    dh: DHParameters,
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
    given = reference_q_rad is not None
    batch, p, r, reference = _checked(position, rotation, np.zeros(6) if reference_q_rad is None else reference_q_rad)
    q, valid = _solve(p, r, dh, reference if given else None)
    q, valid = _wrap(q[:, :8]), valid[:, :8]
    return np.where(valid[..., None], q, np.nan).reshape(*batch, 8, 6), valid.reshape(*batch, 8)


def try_nearest(
    position: ArrayLike,
    rotation: ArrayLike,
    reference_q_rad: ArrayLike,
    dh: DHParameters,
) -> tuple[Array, Mask]:
    """Return the joint angles nearest to a reference that put the flange at given poses in ``base``.

    Nearest among all branches and all full rotations within ``JOINT_RANGE_RAD``, by the Euclidean norm over six joints.

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
    if dh.is_nominal:
        batch, block = _block(position, rotation, reference_q_rad, 25)
        call("inverse_nearest", _coefficients(dh), _LIMITS, block, len(block))
        if np.count_nonzero(block[:, 24] < 0.0):
            _raise_fault(block)
        return block[:, 18:24].reshape(*batch, 6), block[:, 24].reshape(batch) > 0.0
    batch, p, r, reference = _checked(position, rotation, reference_q_rad)
    q, valid = _solve(p, r, dh, reference)
    chosen, reached = np.empty((len(p), 6)), np.empty(len(p))
    good = valid.astype(np.float64)
    call("inverse_nearest_of", q, good, reference, _LIMITS, chosen, reached, q.shape[1], len(p))
    return chosen.reshape(*batch, 6), reached.reshape(batch) > 0.0


def nearest(
    position: ArrayLike,
    rotation: ArrayLike,
    reference_q_rad: ArrayLike,
    dh: DHParameters,
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
    if np.count_nonzero(ok) < ok.size:
        _, p, r, _ = _checked(position, rotation, reference_q_rad)
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
            f"is at least {d4:.4f} m. Move the pose away from the axis, or rotate the tool"
        )
    elif abs(cosine) > 1.0:
        length = np.sqrt(max(a2 * a2 + a3 * a3 + 2 * a2 * a3 * cosine, 0.0))
        found = (
            f"wrist 1 would have to be {length:.4f} m from the shoulder, allowed are {abs(a2 - a3):.4f} to "
            f"{a2 + a3:.4f} m. Move the pose {'towards' if cosine > 1 else 'away from'} the base, or rotate the tool"
        )
    else:
        found = (
            "it is at the very edge of what this calibrated arm reaches. Move the pose inwards, or start from a nearer "
            "reference"
        )
    return where + found
