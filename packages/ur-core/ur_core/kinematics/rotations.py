"""Rotations as unit quaternions (w, x, y, z), batched.

Every function takes arrays with any leading batch axes, which broadcast against each other, and returns float64.
Products are bilinear in their factors, so each is one outer product and one multiplication with a constant table: few
numpy calls, because at these sizes a call costs more than its arithmetic. A row's result does not depend on the other
rows, in any bit. Quaternions are taken to be of unit length and are not checked.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ur_core.types import Array

# Below this a norm is replaced by it: sin(x / 2) / x and atan2(x, w) / x are then exact to the last bit.
_TINY: Final = 1e-150

_CONJUGATE: Final = np.array([1.0, -1.0, -1.0, -1.0])


def _product_table() -> Array:
    """(4, 4, 4) table of Hamilton's product: entry [i, j] is the product of the units i and j."""
    table = np.zeros((4, 4, 4))
    for unit in range(4):
        table[0, unit, unit] = table[unit, 0, unit] = 1.0
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        table[i, i, 0] = -1.0
        table[i, j, k], table[j, i, k] = 1.0, -1.0
    return table


def _matrix_table() -> Array:
    """(16, 9) table that takes the products q_i q_j to the rotation matrix, row by row."""
    products = _product_table()
    # R v = q v q*, read off for each unit vector v; [..., 1:] drops the real part.
    table: Array = np.einsum("ivm,mjr,j->ijrv", products[:, 1:], products[..., 1:], _CONJUGATE)
    return table.reshape(16, 9)


_PRODUCT: Final = _product_table().reshape(16, 4)
_BETWEEN: Final = (_product_table() * _CONJUGATE[:, None, None]).reshape(16, 4)
_MATRIX: Final = _matrix_table()

# The inverse map: 4 q_i q_j is linear in the matrix, plus a constant.
_OUTER: Final = np.zeros((9, 4, 4))
for _i, _signs in enumerate(((1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1))):
    _OUTER[4 * _i, range(4), range(4)] = _signs
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    for _a, _b in ((_i, _j), (_j, _i)):
        _OUTER[3 * _a + _b, 1 + _i, 1 + _j] = _OUTER[3 * _a + _b, 1 + _j, 1 + _i] = 1.0
    _OUTER[3 * _k + _j, 0, 1 + _i] = _OUTER[3 * _k + _j, 1 + _i, 0] = 1.0
    _OUTER[3 * _j + _k, 0, 1 + _i] = _OUTER[3 * _j + _k, 1 + _i, 0] = -1.0
_OUTER_FLAT: Final = _OUTER.reshape(9, 16)
_OUTER_CONSTANT: Final = np.eye(4).reshape(16)


def _float(values: ArrayLike) -> Array:
    # In C order, because the order of a sum's terms depends on that of the memory.
    return np.asarray(values, dtype=np.float64, order="C")


def _times(outer: Array, table: Array) -> Array:
    """Multiply outer products, (..., i, j), as rows, (..., i * j), with a table, (i * j, k)."""
    # One product per row: BLAS rounds the rows of one large product by their position in it.
    product: Array = outer.reshape(*outer.shape[:-2], 1, len(table)) @ table
    return product[..., 0, :]


def quat_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Multiply quaternions: the rotation ``second`` followed by the rotation ``first``.

    Args:
        first: (..., 4).
        second: (..., 4).

    Returns:
        (..., 4).
    """
    return _times(_float(first)[..., :, None] * _float(second)[..., None, :], _PRODUCT)


def quat_conjugate(quat: ArrayLike) -> Array:
    """Return the opposite rotation of each quaternion (..., 4)."""
    conjugate: Array = _float(quat) * _CONJUGATE
    return conjugate


def quat_between(first: Array, second: Array) -> Array:
    """Return the orientations (..., 4) of `second` in the frames of `first`: conjugate of first times second."""
    return _times(first[..., :, None] * second[..., None, :], _BETWEEN)


def quat_to_matrix(quat: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    q = _float(quat)
    return _times(q[..., :, None] * q[..., None, :], _MATRIX).reshape(*q.shape[:-1], 3, 3)


def quat_from_matrix(matrix: ArrayLike) -> Array:
    """Return the quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    Accurate at every angle: the column of q q' with the largest diagonal entry is used.
    """
    rotation = _float(matrix)
    batch = rotation.shape[:-2]
    outer = (_times(rotation, _OUTER_FLAT) + _OUTER_CONSTANT).reshape(-1, 4, 4)
    largest = outer.reshape(-1, 16)[:, ::5].argmax(-1)
    quat: Array = outer[np.arange(len(outer)), largest]
    quat /= np.copysign(np.sqrt((quat * quat).sum(-1, keepdims=True)), quat[:, :1])
    return quat.reshape(*batch, 4)


def quat_from_rotvec(rotvec: ArrayLike) -> Array:
    """Return the quaternions (..., 4) of rotation vectors (..., 3) in rad; w < 0 beyond 180°."""
    vector = _float(rotvec)
    angle = np.maximum(np.sqrt((vector * vector).sum(-1, keepdims=True)), _TINY)
    half = 0.5 * angle
    quat = np.empty((*vector.shape[:-1], 4))
    quat[..., :1] = np.cos(half)
    quat[..., 1:] = vector * (np.sin(half) / angle)
    return quat


def quat_to_rotvec(quat: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), in rad and of length [0, pi], of quaternions (..., 4)."""
    q = _float(quat)
    real, vector = q[..., :1], q[..., 1:]
    norm = np.maximum(np.sqrt((vector * vector).sum(-1, keepdims=True)), _TINY)
    # q and -q are one rotation: |w| selects the one of at most 180°.
    rotvec: Array = vector * (np.arctan2(norm, np.abs(real)) / np.copysign(0.5 * norm, real))
    return rotvec


def rotate(quat: ArrayLike, vector: ArrayLike) -> Array:
    """Rotate vectors (..., 3) by quaternions (..., 4); the batch axes broadcast."""
    rotated: Array = (quat_to_matrix(quat) @ _float(vector)[..., None])[..., 0]
    return rotated


def cross(first: Array, second: Array) -> Array:
    """Return cross products of vectors (..., 3); for small batches several times as fast as numpy's."""
    return first[..., _NEXT] * second[..., _AFTER] - first[..., _AFTER] * second[..., _NEXT]


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
