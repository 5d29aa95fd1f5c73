"""Policies that ignore the observation: random and zero actions, the floor of any comparison."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from ur_core.types import Rows


class RandomPolicy:
    """Uniform random actions that depend on an episode's seed alone.

    Args:
        space: Action space of one row.
        rows: Rows of a batch, each of which `begin` seeds; None: single actions.
        seed: Seed of the first single episode; every `reset` counts on.
    """

    def __init__(self, space: Any, rows: int | None = None, seed: int = 0) -> None:
        self._spaces = [copy.deepcopy(space) for _ in range(1 if rows is None else rows)]
        self._single, self._seed = rows is None, seed
        self.reset()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._spaces[0].shape})"

    def reset(self) -> None:
        """Begin the next single episode; of a batch, `begin` seeds each row."""
        if self._single:
            self._spaces[0].seed(self._seed)
            self._seed += 1

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes with these seeds in some rows of the batch."""
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            # Not the seed itself, from which the environment samples the episode.
            self._spaces[row].seed(int(np.random.SeedSequence((seed, 1)).generate_state(1)[0]))

    def __call__(self, observation: Any) -> Any:
        """Return a random action, or one for each row."""
        return self._spaces[0].sample() if self._single else np.stack([space.sample() for space in self._spaces])


class ZeroPolicy:
    """Zero actions of the shape of an action space."""

    def __init__(self, space: Any) -> None:
        self._action = np.zeros(space.shape, space.dtype)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._action.shape})"

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Any) -> Any:
        """Return zeros."""
        return self._action


BASELINES: Final = {"random": RandomPolicy, "zero": ZeroPolicy}
"""Baselines by name, in the command line and in `evaluate`."""
