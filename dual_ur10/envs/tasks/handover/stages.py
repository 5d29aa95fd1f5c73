"""Stages of a handover: their conditions, and the reward terms of progress towards them."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.assets.tool import Tool
from dual_ur10.envs.tasks.tool_goals import approach
from dual_ur10.kernel import RowLoop, Struct
from dual_ur10.types import Array

STAGES: Final = ("reach", "grasp", "lift", "present", "mutual_grasp", "release", "place")

WIDTH_M: Final = BLOCK_SIZE_M[1]
"""Width of the block between the fingers."""

LIFTED_M: Final = 0.08
"""Height of the block's middle above the table at which it counts as lifted."""

MEETING_RANGE_M: Final = 0.05
"""Distance from the transfer within which the block counts as presented."""

STILL_M_S: Final = 0.02
"""Speed below which the block counts as still."""

PLACED: Final = 12
"""Column of `Stages.facts`."""


class Stages:
    """Stages of n handovers, and the reward terms of progress towards them.

    Args:
        n: Number of handovers.

    Attributes:
        facts: (n, 13) quantities on which the stages depend, written by the caller. Of the giver and the receiver, two
            each: 1 if the gripper's grip of the block is between its fingers; 1 if it holds the block; its width;
            nearness of the tool to its goal, 1 there; 1 if the goal of the gripper is to be closed. Then the height of
            the block's middle above the table; its distance from the transfer, with its rotation; `PLACED`, 1 if it
            lies still on its target, and no gripper holds it.
        conditions: (n, 7) 1 for stage conditions that hold, regardless of order.
        passed: (n,) number of stages passed in their order.
        terms: (n, 2, 7) reward terms of giver and receiver, 0 to 1 in their mean: 1 for a passed stage, less for
            progress.
    """

    def __init__(self, n: int, tools: tuple[Tool, Tool] = DEFAULT_TOOLS) -> None:
        self.facts: Array = np.zeros((n, 13))
        self.conditions: Array = np.zeros((n, len(STAGES)))
        self.passed = np.zeros(n, dtype=np.int64)
        self.terms: Array = np.zeros((n, 2, len(STAGES)))
        struct = Struct(
            "Stages",
            n=n,
            lifted_m=LIFTED_M,
            meeting_m=MEETING_RANGE_M,
            approach=approach(WIDTH_M, tools),
            facts=self.facts,
            conditions=self.conditions,
            stage=self.passed,
            terms=self.terms,
        )
        self.check = RowLoop("stages_check", struct, n, 1)
        """Compute `conditions`."""
        self.advance = RowLoop("stages_advance", struct, n, 1)
        """Advance `passed` by the conditions, by several stages if they hold at once, and compute `terms`."""
