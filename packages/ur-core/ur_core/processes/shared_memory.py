"""Named arrays in memory that processes share."""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ur_core.errors import SettingsError
from ur_core.kernel import Counters

Layout = Mapping[str, tuple[type[np.generic], tuple[int, ...]]]


class SharedBlock:
    """Arrays without locks: each number has one writer, and a counter is written after what it counts.

    Counters go through `counters`, which holds this order on every processor.

    Args:
        layout: Type and shape of each array, by name.
        name: Name of memory that exists; None: new memory, which belongs to this object.

    Attributes:
        name: Name under which a process of the same user finds it, as long as its maker lives.

    Raises:
        SettingsError: The memory of that name does not have the size of these arrays.
    """

    def __init__(self, layout: Layout, name: str | None = None) -> None:
        self._layout = layout
        size = sum(_size(*each) for each in layout.values())
        # It has no file name that could be left behind: it vanishes with the last process that has it open.
        self._file: int | None = (
            os.memfd_create("dual_ur10") if name is None else os.open(name, os.O_RDWR | os.O_CLOEXEC)
        )
        self.name = f"/proc/{os.getpid()}/fd/{self._file}" if name is None else name
        if name is None:
            os.ftruncate(self._file, size)
        elif os.fstat(self._file).st_size != size:
            os.close(self._file)
            raise SettingsError(f"memory {name} is another's: it is not of {size} bytes")
        buffer = mmap.mmap(self._file, size)
        if name is not None:  # the mapping is enough
            os.close(self._file)
            self._file = None
        self._arrays: dict[str, NDArray[Any]] = {}
        at = 0
        for key, (kind, shape) in layout.items():
            self._arrays[key] = np.frombuffer(buffer, kind, int(np.prod(shape)), at).reshape(shape)
            at += _size(kind, shape)

    def __getitem__(self, key: str) -> Any:
        return self._arrays[key]

    def counters(self, key: str) -> Counters:
        """Return an array of int64 as counters; anew after `close`."""
        return Counters(self._arrays[key])

    def set_text(self, key: str, text: str) -> None:
        """Write a text into an array of bytes, cut off where it does not fit."""
        array = self._arrays[key]
        # No text may raise: the reason of a stop must not delay the stop.
        line = text.encode("utf-8", "replace")[: len(array) - 1]
        array[: len(line)] = np.frombuffer(line, np.uint8)
        array[len(line)] = 0

    def text(self, key: str) -> str:
        """Return the text in an array of bytes."""
        line: bytes = self._arrays[key].tobytes()
        return line[: line.index(0)].decode("utf-8", "replace") if 0 in line else ""

    def close(self) -> None:
        """Release the memory, and keep zeros in its place. May be called twice."""
        # The mapping goes with the last array that shows it.
        self._arrays = {key: np.zeros(shape, kind) for key, (kind, shape) in self._layout.items()}
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _size(kind: type[np.generic], shape: tuple[int, ...]) -> int:
    """Bytes of an array, rounded up to words of 8."""
    return -(-np.dtype(kind).itemsize * int(np.prod(shape)) // 8) * 8
