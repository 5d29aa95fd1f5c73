"""Operators of URScript. The arithmetic ones are for numbers here; `arrays` extends them to lists.

Each refuses what Python allows and URScript does not: indices from the end, integers of more than 32 bits. The machine
adds line and word to the errors that these functions raise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from ur_emulator.script.values import INT_MAX, LIST_MAX, Pose, fitting, integer, kind, number

_INT_MIN: Final = -INT_MAX - 1
_SCALARS: Final = frozenset((int, float, bool, str))


def add(left: Any, right: Any) -> Any:
    """Left + right."""
    if left.__class__ is float and right.__class__ is float:
        return left + right
    if left.__class__ is int and right.__class__ is int and _INT_MIN <= (whole := left + right) <= INT_MAX:
        return whole
    return fitting(number(left) + number(right))


def subtract(left: Any, right: Any) -> Any:
    """Left - right."""
    if left.__class__ is float and right.__class__ is float:
        return left - right
    if left.__class__ is int and right.__class__ is int and _INT_MIN <= (whole := left - right) <= INT_MAX:
        return whole
    return fitting(number(left) - number(right))


def multiply(left: Any, right: Any) -> Any:
    """Left * right."""
    if left.__class__ is float and right.__class__ is float:
        return left * right
    if left.__class__ is int and right.__class__ is int and _INT_MIN <= (whole := left * right) <= INT_MAX:
        return whole
    return fitting(number(left) * number(right))


def divide(left: Any, right: Any) -> float:
    """Left / right, always a float."""
    return number(left) / number(right)


def modulo(left: Any, right: Any) -> Any:
    """Left % right, with the sign of right."""
    return number(left) % number(right)


def negative(value: Any) -> Any:
    """-value."""
    return fitting(-number(value))


def less(left: Any, right: Any) -> bool:
    """Left < right."""
    return number(left) < number(right)


def less_equal(left: Any, right: Any) -> bool:
    """Left <= right."""
    return number(left) <= number(right)


def greater(left: Any, right: Any) -> bool:
    """Left > right."""
    return number(left) > number(right)


def greater_equal(left: Any, right: Any) -> bool:
    """Left >= right."""
    return number(left) >= number(right)


def truth(value: Any) -> bool:
    """Convert a value to a condition: True, False, or a number, of which 0 is False."""
    if value.__class__ is bool:
        return value
    if isinstance(value, (int, float)):
        return value != 0
    raise TypeError(f"a condition is True or False, found {kind(value)}")


def make_list(*items: Any) -> list[Any]:
    """[items]; the items may be the rows of a matrix."""
    for item in items:
        if item.__class__ not in _SCALARS:
            return _matrix(list(items))
    if len(items) > LIST_MAX:
        raise ValueError(f"a list has at most {LIST_MAX} elements, found {len(items)}")
    return list(items)


def make_pose(*items: Any) -> Pose:
    """p[items]."""
    return Pose(items)


def get(base: Any, index: Any) -> Any:
    """base[index]."""
    if (base.__class__ is list or base.__class__ is Pose) and index.__class__ is int and 0 <= index < len(base):
        return base[index]
    _check(base, index)
    return base[index]


def get_cell(base: Any, row: Any, column: Any) -> Any:
    """base[row, column]."""
    return get(get(base, row), column)


def put(value: Any, base: Any, index: Any) -> Any:
    """Return a copy of base in which element `index` is the value."""
    if base.__class__ is list and index.__class__ is int and 0 <= index < len(base) and value.__class__ in _SCALARS:
        changed = base.copy()
        changed[index] = value
        return changed
    _check(base, index)
    if base.__class__ is Pose:
        changed = base.copy()
        changed[index] = value
        return Pose(changed)
    changed = list(base)
    changed[index] = value
    return changed if value.__class__ in _SCALARS else _matrix(changed)


def put_cell(value: Any, base: Any, row: Any, column: Any) -> Any:
    """Return a copy of base in which element (row, column) is the value."""
    changed_row = put(value, get(base, row), column)
    if value.__class__ not in _SCALARS:
        return put(changed_row, base, row)
    changed = list(base)
    changed[row] = changed_row  # the other rows were checked before
    return changed


def _check(base: Any, index: Any) -> None:
    if not isinstance(base, list):
        raise TypeError(f"only lists and poses have elements, found {kind(base)}")
    if not 0 <= integer(index) < len(base):
        raise IndexError(f"the index {index} is outside of 0 to {len(base) - 1}")


def _matrix(rows: list[Any]) -> list[Any]:
    size = 0
    for row in rows:
        size += 1
        if isinstance(row, list):
            size += len(row)
            if any(isinstance(item, list) for item in row):
                raise TypeError("the elements of a matrix are no lists")
        elif row.__class__ not in _SCALARS and not isinstance(row, (int, float, str)):
            raise TypeError(f"{kind(row)} cannot be an element of a list")
    if size > LIST_MAX:
        raise ValueError(f"a list has at most {LIST_MAX} elements with all of its rows, found {size}")
    return rows


OPERATIONS: Final[dict[str, Callable[..., Any] | type]] = {
    "+": add,
    "-": subtract,
    "*": multiply,
    "/": divide,
    "%": modulo,
    "<": less,
    "<=": less_equal,
    ">": greater,
    ">=": greater_equal,
    "negative": negative,
    "truth": truth,
    "list": make_list,
    "pose": make_pose,
    "get": get,
    "get_cell": get_cell,
    "put": put,
    "put_cell": put_cell,
}
"""Operations by operator, or by the name that the compiler uses."""

ARITHMETIC: Final = ("+", "-", "*", "/", "%")
"""Operators that take lists, too."""
