"""What a policy is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from dual_ur10.types import Array


@runtime_checkable
class Policy(Protocol):
    """Turns observations into actions. It sees arrays of the observation space and nothing else.

    It cannot know which kind of cell it moves. A policy may keep what it has seen since `reset`; the scripted one
    notices by itself when a row of a batch begins another episode.
    """

    def reset(self) -> None:
        """Forget everything: an episode begins."""

    def __call__(self, observation: Array) -> Array:
        """The action for an observation, or one for each row of a batch of observations."""


@runtime_checkable
class Teaching(Protocol):
    """A policy that acts otherwise when others are to learn from it."""

    def teach(self) -> None:
        """Say from now on what an observation asks for, whoever has led the arms there, and learn nothing meanwhile.

        In a way that one who is less exact, and knows only what an observation tells, can follow.
        """
