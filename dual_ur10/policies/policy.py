"""Interfaces of policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from dual_ur10.types import Array, Rows


@runtime_checkable
class Policy(Protocol):
    """Function from observations to actions.

    It receives arrays of the observation space and nothing else: it cannot know which kind of cell it moves. It may
    keep what it has observed since `reset`. The scripted policies detect by themselves when a row of a batch begins
    another episode.
    """

    def reset(self) -> None:
        """Forget everything: an episode begins."""

    def __call__(self, observation: Array) -> Array:
        """Return the action for an observation, or one for each row of a batch of observations."""


@runtime_checkable
class EpisodeAware(Protocol):
    """A policy that is notified when single rows of a batch begin episodes, so that no row waits for the others."""

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows: the next observations in them are the first ones.

        Args:
            rows: (k,) indices of the rows.
            seeds: (k,) seeds of their episodes.
        """


@runtime_checkable
class Teaching(Protocol):
    """A policy that acts differently as the expert of imitation learning."""

    def teach(self) -> None:
        """Answer each observation on its own from now on, regardless of how the arms came there, and adapt to nothing.

        The answers are such that a learner can follow them that is less exact and knows the observation alone.
        """
