"""Interface of policies that return chunks of future actions."""

from __future__ import annotations

import numbers
from typing import Any, Final, Literal, Protocol, get_args, runtime_checkable

import numpy as np

from dual_ur10.errors import ChunkError
from ur_core.types import Array

MOST_ACTIONS = 1000
"""Largest number of actions in a chunk."""

_LARGEST: Final = 1e6  # beyond any joint; cubics through such numbers still fit into an action's single precision

ChunkMode = Literal["joint_delta", "joint_position"]
CHUNK_MODES = get_args(ChunkMode)
"""Meanings of the actions of a chunk."""


@runtime_checkable
class ChunkPolicy(Protocol):
    """Policy that returns a chunk of future actions for one observation, perhaps late.

    Attributes:
        dt_s: Time between two actions of a chunk, whatever the rate of the environment.
        action_mode: "joint_delta": an action has six steps of each arm's joints, as fractions of the speed limit times
            `dt_s`, -1 to 1, which add up from the commanded joint positions of the observation. "joint_position": six
            absolute joint positions of each arm, rad.
    """

    dt_s: float
    action_mode: str

    def reset(self) -> None:
        """Discard all state, because an episode begins."""

    def chunk(self, observation: Any, time_s: float) -> Array:
        """Return a chunk of actions, (H, D).

        Row i is what both arms are to have reached at `time_s + (i + 1) dt_s`, before the latency of actions. D is 12,
        or 14 with grippers: the left arm's six joints and the opening of its gripper, -1 closed to 1 open, then the
        right arm's.

        Args:
            observation: Observation of one cell.
            time_s: Time of the observation since the episode began.
        """


def check_mode(action_mode: object, name: str) -> None:
    """Check the meaning of the actions of a chunk policy.

    Raises:
        ChunkError: There is none such.
    """
    if action_mode not in CHUNK_MODES:
        raise ChunkError(
            f"action_mode of {name} is {action_mode!r:.80}: chunks are of {' or '.join(map(repr, CHUNK_MODES))}"
        )


def checked_chunk(chunk: object, dt_s: object, size: int, name: str) -> Array:
    """Return a chunk as (H, 2, size) numbers.

    Args:
        chunk: Returned by a chunk policy.
        dt_s: Its time between two actions.
        size: Numbers of an arm.
        name: Name of the chunk policy, for messages.

    Raises:
        ChunkError: It is none.
    """
    if isinstance(dt_s, bool) or not isinstance(dt_s, numbers.Real) or not 1e-3 <= float(dt_s) <= 10.0:
        raise ChunkError(f"dt_s of {name} is {dt_s!r:.80}: it must be a time of 0.001 to 10 s between two actions")
    try:
        found = np.asarray(chunk)
    except (TypeError, ValueError) as error:
        raise ChunkError(f"{name} returned {type(chunk).__name__}, which is no array: {error}") from None
    allowed = f"a chunk is 1 to {MOST_ACTIONS} actions of {2 * size} numbers, (H, {2 * size})"
    if found.dtype.kind not in "fiu" or found.ndim != 2 or found.shape[1] != 2 * size:
        raise ChunkError(f"{name} returned {found.dtype} of shape {found.shape}: {allowed}")
    if not 1 <= len(found) <= MOST_ACTIONS:
        raise ChunkError(f"{name} returned {len(found)} actions: {allowed}")
    rows = found.astype(np.float64).reshape(-1, 2, size)
    if not np.abs(rows).max() <= _LARGEST:  # of NaN, too
        step, arm, number = np.argwhere(~(np.abs(rows) <= _LARGEST))[0].tolist()
        raise ChunkError(
            f"number {number} of arm {arm} in action {step} of a chunk of {name} is {rows[step, arm, number]}: all "
            f"must be finite, of {_LARGEST:g} at most"
        )
    return rows
