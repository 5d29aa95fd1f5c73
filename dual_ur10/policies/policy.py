"""Interfaces of policies."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from gymnasium.vector.utils import iterate

from dual_ur10.errors import PolicyError
from ur_core.types import Array, Mask, Rows


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


class FunctionPolicy:
    """A plain function from an observation to an action as a policy. It has no state: nothing needs a reset.

    Args:
        function: As `Policy.__call__`.
    """

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self.__name__ = str(getattr(function, "__name__", type(function).__name__))  # in results and records

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.__name__})"

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Any) -> Any:
        """Return the function's action."""
        return self._function(observation)

    def of_rows(self, space: Any) -> FunctionPolicy:
        """Return the policy that calls the function with each row of a batch of observations.

        Args:
            space: Space of the batch.
        """
        rows = FunctionPolicy(lambda batch: np.stack([self(row) for row in iterate(space, batch)]))
        rows.__name__ = self.__name__
        return rows


def as_policy(policy: object) -> Policy:
    """Return a policy unchanged, and a plain function as a `FunctionPolicy`.

    Raises:
        PolicyError: It is neither.
    """
    if inspect.isroutine(policy) or isinstance(policy, functools.partial):
        return FunctionPolicy(policy)
    if hasattr(policy, "unwrapped"):
        raise PolicyError(f"the policy is an environment, {type(policy).__name__}: are two arguments exchanged?")
    lacking = [each for each in ("reset", "__call__") if not callable(getattr(policy, each, None))]
    if lacking or isinstance(policy, type):
        what = "a class, not an object of it" if isinstance(policy, type) else f"no {' and no '.join(lacking)}"
        if callable(getattr(policy, "chunk", None)) and not isinstance(policy, type):
            what = "a chunk policy, of which `make` makes a policy for an environment"
        raise PolicyError(
            f"{policy_name(policy)} is no policy: found {what}; a policy has reset() and takes an observation, or is a "
            "plain function of one"
        )
    return cast(Policy, policy)


def policy_name(policy: object) -> str:
    """Return the name of a policy for results and messages: that of a named one, a function or a class."""
    if isinstance(policy, str):
        return policy
    return str(getattr(policy, "__name__", type(policy).__name__))


def close_policy(policy: object) -> None:
    """Close a policy that can be closed: one that holds a device, a thread or a connection."""
    close = getattr(policy, "close", None)
    if callable(close):
        close()


def is_alone(policy: object) -> bool:
    """Return True if a policy, asked with each row of a batch, may keep what belongs to one episode."""
    return bool(getattr(policy, "alone", False))


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
class TimeAware(Protocol):
    """A policy that is given the time of each observation before the observation itself."""

    def observed_at(self, time_s: Array) -> None:
        """Take the time of the next observation.

        Args:
            time_s: (n,) time of each row since its episode began, in task time: a whole number of ticks.
        """


@runtime_checkable
class Commanded(Protocol):
    """A policy of which a person commands arms."""

    @property
    def commander(self) -> Mask:
        """(2,) True for an arm that a person commanded in the last action."""


@runtime_checkable
class Teaching(Protocol):
    """A policy that acts differently as the expert of imitation learning."""

    def teach(self) -> None:
        """Act from each observation alone from now on, regardless of earlier states, and without adaptation.

        A less exact learner that knows only the observation must be able to follow these actions.
        """
