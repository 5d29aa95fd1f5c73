"""The scripted policy as a teacher, who is asked what to do where a pupil has led the arms."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10 import policies
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.policy import Policy, Teaching
from dual_ur10.types import Array, Mask, Single


class Expert:
    """A scripted policy for each row, so that one that does not know how to go on leaves the others alone.

    Args:
        env_id: Of the environment.
        rows: How many.
        low, high: (size,) bounds of an action.
        **keywords: Of the environment.
    """

    def __init__(self, env_id: str, rows: int, low: Single, high: Single, **keywords: Any) -> None:
        self._policies: list[Policy] = [policies.load("scripted", env_id, **keywords) for _ in range(rows)]
        for each in self._policies:
            if isinstance(each, Teaching):
                each.teach()
        self._low, self._high = low, high
        self._lost = np.zeros(rows, dtype=bool)

    def begin(self, row: int) -> None:
        """A row begins an episode."""
        self._policies[row].reset()
        self._lost[row] = False

    def __call__(self, observation: Array, live: Mask) -> tuple[Single, Mask]:
        """What it would do, (n, size), for observations, (n, ...), and in which of the live rows it knows, (n,).

        A row in which it once did not know, because the object has fallen out of reach, say, is lost until its next
        episode: what a script does after that means nothing.
        """
        action = np.zeros((len(observation), len(self._low)), dtype=np.float32)
        for row in np.flatnonzero(live & ~self._lost).tolist():
            try:
                action[row] = self._policies[row](observation[row])
            except DualUR10Error:
                self._lost[row] = True
        self._lost |= ~np.isfinite(action).all(axis=1)
        action[self._lost] = 0.0
        return np.clip(action, self._low, self._high), live & ~self._lost
