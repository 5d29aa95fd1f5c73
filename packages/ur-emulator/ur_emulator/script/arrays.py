"""Arithmetic of lists and matrices (UR's script manual, "Matrix and Array Expressions").

Two lists of the same length, or a list or matrix and a number, are combined element by element. `*` multiplies a matrix
by a matrix or by a list. Poses take no part in it: they have functions such as `pose_trans`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, Final

from ur_emulator.script.operations import add
from ur_emulator.script.values import LIST_MAX, Pose, kind

Operator = Callable[[Any, Any], Any]

_ELEMENTS_PER_STEP: Final = 8


def with_lists(word: str, scalar: Operator, spend: Callable[[int], None]) -> Operator:
    """Return an operator for numbers, lists and matrices.

    Args:
        word: The operator as programs write it.
        scalar: The operator for two numbers.
        spend: Function that charges the program with statements for long lists.
    """

    def operate(left: Any, right: Any) -> Any:
        if left.__class__ is not list and right.__class__ is not list:
            return scalar(left, right)
        return _of_lists(word, scalar, spend, left, right)

    return operate


def _of_lists(word: str, scalar: Operator, spend: Callable[[int], None], left: Any, right: Any) -> Any:
    for value in (left, right):
        if isinstance(value, Pose) or not isinstance(value, (list, int, float)):
            raise TypeError(f"{word} takes numbers, lists and matrices, found {kind(value)}")
    if word == "*" and _is_matrix(left) and isinstance(right, list):
        return _product(scalar, spend, left, right)
    if not (isinstance(left, list) and isinstance(right, list)):
        spend(_size(left if isinstance(left, list) else right) // _ELEMENTS_PER_STEP)
        return _by_number(scalar, left, right)
    if _is_matrix(left) or _is_matrix(right):
        raise TypeError(f"{word} does not combine a matrix with a list or a matrix in this order: only * does")
    if len(left) != len(right):
        raise ValueError(f"{word} needs lists of the same length, found {len(left)} and {len(right)} elements")
    spend(len(left) // _ELEMENTS_PER_STEP)
    return list(map(scalar, left, right))


def _by_number(scalar: Operator, left: Any, right: Any) -> Any:
    if isinstance(left, list):
        return [_by_number(scalar, each, right) for each in left]
    if isinstance(right, list):
        return [_by_number(scalar, left, each) for each in right]
    return scalar(left, right)


def _product(scalar: Operator, spend: Callable[[int], None], left: list[Any], right: list[Any]) -> list[Any]:
    columns = [right] if not _is_matrix(right) else [list(column) for column in zip(*_rows(right), strict=True)]
    rows = _rows(left)
    if len(rows[0]) != len(columns[0]):
        raise ValueError(f"* needs as many rows on the right as columns on the left: {len(rows[0])}")
    if len(rows) * (len(columns) + 1) > LIST_MAX:
        raise ValueError(f"a list has at most {LIST_MAX} elements with all of its rows")
    spend(len(rows) * len(columns) * len(rows[0]) // _ELEMENTS_PER_STEP)
    product = [[reduce(add, map(scalar, row, column)) for column in columns] for row in rows]
    return product if _is_matrix(right) else [row[0] for row in product]


def _rows(matrix: list[Any]) -> list[list[Any]]:
    """Return the rows of a matrix, which have one length.

    Raises:
        ValueError: They have not.
    """
    if not all(isinstance(row, list) and len(row) == len(matrix[0]) for row in matrix) or not matrix[0]:
        raise ValueError("* needs a matrix whose rows have the same length")
    return matrix


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(each, list) for each in value)


def _size(value: list[Any]) -> int:
    return sum(len(each) if isinstance(each, list) else 1 for each in value)
