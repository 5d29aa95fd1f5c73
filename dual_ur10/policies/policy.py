"""Interfaces of policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from dual_ur10.types import Array, Rows


@runtime_checkable
class Policy(Protocol):
    """Function from observations to actions.

    It receives only arrays of the observation space, so it does not depend on the kind of cell. It may keep what it has
    observed since `reset`. The scripted policies detect by themselves when a row of a batch begins a new episode.
    """

    def reset(self) -> None:
        """Discard all state, because an episode begins."""

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
        """Act from each observation alone from now on, regardless of earlier states, and without adaptation.

        A less exact learner that knows only the observation must be able to follow these actions.
        """
