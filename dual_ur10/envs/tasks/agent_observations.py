"""Observations of agents, which the kernel assembles from joint observations."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.kernel import RowLoop, Struct
from dual_ur10.types import Array


class AgentObservations:
    """Each agent's own observation, from joint observations of any number of rows.

    Args:
        struct: Name of the kernel's structure; it also has `n`, `size`, `own_size`, `both` and `own`.
        function: Name of the kernel's function.
        size: Number of values of an arm in a joint observation.
        own_size: Number of values of an agent's observation.
        **values: Other fields of the structure.
    """

    def __init__(self, struct: str, function: str, size: int, own_size: int, **values: Any) -> None:
        self._struct, self._function, self._sizes, self._values = struct, function, (size, own_size), values
        self._made: dict[int, tuple[Array, Array, RowLoop]] = {}  # buffers and function, by the number of rows

    def __call__(self, observation: Array) -> Array:
        """Return new observations, (n, 2, own_size), from joint ones, (n, 2 * size)."""
        both, own, split = self._made.get(len(observation)) or self._begin(len(observation))
        both[...] = observation
        split()
        return own.copy()

    def _begin(self, n: int) -> tuple[Array, Array, RowLoop]:
        size, own_size = self._sizes
        both, own = np.zeros((n, 2 * size)), np.zeros((n, 2, own_size))
        struct = Struct(self._struct, n=n, size=size, own_size=own_size, both=both, own=own, **self._values)
        self._made[n] = both, own, RowLoop(self._function, struct, n, 1)
        return self._made[n]
