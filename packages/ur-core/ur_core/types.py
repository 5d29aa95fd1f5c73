"""Array types shared by all rooms, read-only constants, texts of settings, and a base for objects with `close()`.

Shapes stand in docstrings: NumPy's types do not hold them.
"""

from __future__ import annotations

import contextlib
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Numbers."""

Single: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
"""Truth values, mostly one for each row."""

Rows: TypeAlias = NDArray[np.intp]
"""Indices into the batch axis."""

Vector3: TypeAlias = tuple[float, float, float]
"""Three plain numbers, as in settings: a position in m, or a rotation vector in rad."""


def constant(values: object) -> Array:
    """Return a read-only array of floats."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def changed(settings: Any) -> str:
    """Return the settings that differ from the default ones, as they would be passed."""
    default = type(settings)()
    names = [each.name for each in dataclasses.fields(settings)]
    texts = [(name, repr(getattr(settings, name)), repr(getattr(default, name))) for name in names]
    return ", ".join(f"{name}={given}" for name, given, usual in texts if given != usual)


class Closing(ABC):
    """Context manager that closes itself at the end of its `with` block."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources. May be called twice."""

    @contextlib.contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """Close this object if the block raises, even by an interrupt."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
