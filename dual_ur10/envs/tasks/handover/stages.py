"""Stages of a handover: their conditions, and the reward terms of progress towards them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.gripper import OPENING_M
from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.envs.tasks.task import gaussian
from dual_ur10.types import Array, Mask

Counts = NDArray[np.int64]

STAGES: Final = ("reach", "grasp", "lift", "present", "mutual_grasp", "release", "place")

WIDTH_M: Final = BLOCK_SIZE_M[1]
"""Width of the block between the fingers."""

LIFTED_M: Final = 0.08
"""Height of the block's middle above the table at which it counts as lifted."""

MEETING_RANGE_M: Final = 0.12
"""Distance from the meeting place within which the block counts as presented."""

STILL_M_S: Final = 0.02
"""Speed below which the block counts as still."""

# Distance at which a term is 0.1: tool to grip, block to the meeting, receiver to its grip, block to the target, angle
# of the block.
_REACH_M, _PRESENT_M, _APPROACH_M, _PLACE_M, _TURN_RAD = 0.15, 0.5, 0.5, 0.3, 0.5


class GripperFacts(NamedTuple):
    """State of the gripper in one role.

    Attributes:
        between: (n,) True if its grip of the block is between its fingers.
        holds: (n,) True if it holds the block.
        opening_m: (n,) width of the gripper.
        away_m: (n,) distance of the tool from its grip.
    """

    between: Mask
    holds: Mask
    opening_m: Array
    away_m: Array


class Facts(NamedTuple):
    """Quantities on which the stages depend.

    Attributes:
        giving, receiving: Grippers in their roles.
        height_m: (n,) height of the block's middle above the table.
        meeting_m: (n,) distance of the block from the meeting place.
        target_m, target_rad: (n,) distance of the block from its target, and angle between their long axes.
        placed: (n,) True if the block lies still on its target, and no gripper holds it.
    """

    giving: GripperFacts
    receiving: GripperFacts
    height_m: Array
    meeting_m: Array
    target_m: Array
    target_rad: Array
    placed: Mask


def passed(facts: Facts) -> Mask:
    """Return an (n, 7) mask of stage conditions that hold now, regardless of order."""
    giving, receiving, lifted = facts.giving, facts.receiving, facts.height_m > LIFTED_M
    return np.stack(
        [
            giving.between,
            giving.holds,
            giving.holds & lifted,
            giving.holds & lifted & (facts.meeting_m < MEETING_RANGE_M),
            giving.holds & receiving.holds & lifted,
            ~giving.holds & receiving.holds & lifted,
            facts.placed,
        ],
        axis=1,
    )


def advance(stage: Counts, conditions: Mask) -> None:
    """Advance the number of stages passed in their order, (n,), in place; by several if they hold at once."""
    for k in range(len(STAGES)):
        stage += (stage == k) & conditions[:, k]


def terms(facts: Facts, stage: Counts, giver: NDArray[np.intp]) -> Array:
    """Return the reward terms of each arm, (n, 2, 7), 0 to 1 in their mean: 1 for a passed stage, less for progress.

    Args:
        facts: Current quantities.
        stage: (n,) number of stages passed.
        giver: (n,) index of the giving arm.
    """
    giving, receiving = facts.giving, facts.receiving
    both = giving.holds & receiving.holds
    closing = np.where(receiving.between, _closed(receiving.opening_m), 0.0)
    near, carried = gaussian(receiving.away_m, _REACH_M), receiving.holds | facts.placed
    on_target = 0.7 * gaussian(facts.target_m, _PLACE_M) + 0.3 * gaussian(facts.target_rad, _TURN_RAD)
    mutual = np.where(giving.holds, np.where(both, 1.0, 0.5 * near + 0.5 * closing), 0.0)
    zero = np.zeros(len(stage))
    # Terms of the giver and of the receiver per stage; their mean is the reward term.
    of_giver = [
        2 * gaussian(giving.away_m, _REACH_M),
        2 * np.where(giving.between, _closed(giving.opening_m), 0.0),
        2 * np.where(giving.holds, np.clip(facts.height_m / LIFTED_M, 0.0, 1.0), 0.0),
        np.where(giving.holds, gaussian(facts.meeting_m, _PRESENT_M), 0.0),
        mutual,
        2 * np.where(receiving.holds, 1.0 - _closed(giving.opening_m), 0.0),
        zero,
    ]
    of_receiver = [zero, zero, zero, gaussian(receiving.away_m, _APPROACH_M), mutual, zero]
    of_receiver.append(2 * np.where(carried, on_target, 0.0))
    done = np.array([[2, 0], [2, 0], [2, 0], [1, 1], [1, 1], [2, 0], [0, 2]], dtype=np.float64)
    order = np.arange(len(STAGES))
    # "present" begins as soon as the block is held.
    begun = (stage[:, None] >= order) | ((order == STAGES.index("present")) & (stage[:, None] >= 2))
    dense = np.stack([np.stack(of_giver, axis=1), np.stack(of_receiver, axis=1)], axis=2)
    values = np.where((stage[:, None] > order)[..., None], done, np.where(begun[..., None], dense, 0.0))
    result = np.empty((len(stage), 2, len(STAGES)))
    rows = np.arange(len(stage))
    result[rows, giver], result[rows, 1 - giver] = values[..., 0], values[..., 1]
    return result


def _closed(opening_m: Array) -> Array:
    """Return 1 for a gripper at the block's width, 0 fully open or closed beyond it."""
    result: Array = np.clip(1.0 - np.abs(opening_m - WIDTH_M) / (OPENING_M - WIDTH_M), 0.0, 1.0)
    return result
