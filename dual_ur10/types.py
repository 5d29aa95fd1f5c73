"""Array types shared by all rooms, read-only constants, the check of numbers in settings, and a base for `close()`.

Shapes stand in docstrings: NumPy's types do not hold them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError

Array: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
Rows: TypeAlias = NDArray[np.intp]
"""Indices into the batch axis."""


def constant(values: object) -> Array:
    """Return a read-only array of floats."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def numbers(name: str, values: Any, length: int) -> tuple[Any, ...]:
    """Plain finite floats, so that equal settings hash alike.

    Raises:
        SettingsError: They are not `length` finite numbers.
    """
    try:
        found = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        found = ()
    if len(found) != length or not all(map(math.isfinite, found)):
        raise SettingsError(f"{name} must be {length} finite number{'s' * (length > 1)}, found {values!r}")
    return found


class Closing(ABC):
    """Context manager that closes itself at the end of its `with` block."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources. May be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
