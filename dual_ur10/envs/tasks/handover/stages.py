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

# Distance at which a term is 0.1: giver's and receiver's tool to its grip, receiver's in its approach, block to the
# meeting, block to the target, angle of the block.
_MARGINS: Final = np.array([0.15, 0.15, 0.5, 0.5, 0.3, 0.5])

_ORDER: Final = np.arange(len(STAGES))
# Stages passed from which on a term is earned. "present" begins as soon as the block is held.
_BEGIN: Final = np.array([0, 1, 2, 2, 4, 5, 6])
# Terms of giver and receiver for a passed stage.
_DONE: Final = np.array([[2.0, 2.0, 2.0, 1.0, 1.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 2.0]])


class Facts(NamedTuple):
    """Quantities on which the stages depend. Those of two grippers are of the giver, then of the receiver.

    Attributes:
        between: (n, 2) True if the gripper's grip of the block is between its fingers.
        holds: (n, 2) True if the gripper holds the block.
        opening_m: (n, 2) width of the gripper.
        away_m: (n, 2) distance of the tool from its grip.
        height_m: (n,) height of the block's middle above the table.
        meeting_m: (n,) distance of the block from the meeting place.
        target_m, target_rad: (n,) distance of the block from its target, and angle between their long axes.
        placed: (n,) True if the block lies still on its target, and no gripper holds it.
    """

    between: Mask
    holds: Mask
    opening_m: Array
    away_m: Array
    height_m: Array
    meeting_m: Array
    target_m: Array
    target_rad: Array
    placed: Mask


def passed(facts: Facts) -> Mask:
    """Return an (n, 7) mask of stage conditions that hold now, regardless of order."""
    gives, receives, lifted = facts.holds[:, 0], facts.holds[:, 1], facts.height_m > LIFTED_M
    result = np.empty((len(lifted), len(STAGES)), dtype=bool)
    reached, grasped, raised, presented, mutual, released, placed = result.T
    reached[:], grasped[:], placed[:] = facts.between[:, 0], gives, facts.placed
    np.logical_and(gives, lifted, out=raised)
    np.logical_and(raised, facts.meeting_m < MEETING_RANGE_M, out=presented)
    np.logical_and(raised, receives, out=mutual)
    np.greater(receives & lifted, gives, out=released)
    return result


def advance(stage: Counts, conditions: Mask) -> None:
    """Advance the number of stages passed in their order, (n,), in place; by several if they hold at once."""
    reached = np.logical_and.accumulate(conditions | (stage[:, None] > _ORDER), axis=1)
    np.add.reduce(reached, axis=1, out=stage)


def terms(facts: Facts, stage: Counts) -> Array:
    """Return the reward terms of giver and receiver, (n, 2, 7), 0 to 1 in their mean.

    A term is 1 for a passed stage, less for progress.

    Args:
        facts: Current quantities.
        stage: (n,) number of stages passed.
    """
    gives, receives = facts.holds[:, 0], facts.holds[:, 1]
    distances = np.empty((len(stage), 6))
    distances[:, :2], distances[:, 2], distances[:, 3] = facts.away_m, facts.away_m[:, 1], facts.meeting_m
    distances[:, 4], distances[:, 5] = facts.target_m, facts.target_rad
    near = gaussian(distances, _MARGINS)
    closed = _closed(facts.opening_m)
    closing = closed * facts.between
    result = np.zeros((len(stage), 2, len(STAGES)))
    giver, receiver = result[:, 0], result[:, 1]
    np.multiply(near[:, 0], 2.0, out=giver[:, 0])
    np.multiply(closing[:, 0], 2.0, out=giver[:, 1])
    height = np.minimum(np.maximum(facts.height_m / LIFTED_M, 0.0), 1.0)
    np.multiply(height, 2.0 * gives, out=giver[:, 2])
    np.multiply(near[:, 3], gives, out=giver[:, 3])
    mutual = np.maximum(0.5 * (near[:, 1] + closing[:, 1]), receives)
    np.multiply(mutual, gives, out=giver[:, 4])
    np.multiply(1.0 - closed[:, 0], 2.0 * receives, out=giver[:, 5])
    receiver[:, 3], receiver[:, 4] = near[:, 2], giver[:, 4]
    on_target = 1.4 * near[:, 4] + 0.6 * near[:, 5]
    np.multiply(on_target, receives | facts.placed, out=receiver[:, 6])
    result *= (stage[:, None] >= _BEGIN)[:, None]
    np.copyto(result, _DONE, where=(stage[:, None] > _ORDER)[:, None])
    return result


def _closed(opening_m: Array) -> Array:
    """Return 1 for a gripper at the block's width, 0 fully open or closed beyond it."""
    result: Array = np.maximum(1.0 - np.abs(opening_m - WIDTH_M) / (OPENING_M - WIDTH_M), 0.0)
    return result
