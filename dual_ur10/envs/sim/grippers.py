"""The grippers' own controllers: a command arrives late, then the opening goes there at its speed."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.assets.gripper import OPENING_M, SPEED_M_S
from dual_ur10.errors import ActionError
from dual_ur10.types import Array, Rows

LATENCY_S: Final = 0.1
"""From a command to the first motion: the figure of UMI's deployment configuration for its grippers."""


class GripperServos:
    """Openings of both grippers of n cells, from the commanded ones.

    A finger that meets something stops there and presses. Its reference then waits a little beyond, so that it lets go
    as soon as it is told to, as a real gripper does, which measures where it is.

    Args:
        n: Number of cells.
        tick_s: Time between two commands.
        substeps: Physics steps per tick.
        slack_m: How far the reference runs ahead of the fingers: more than what full force takes.
    """

    def __init__(self, n: int, tick_s: float, substeps: int, slack_m: float) -> None:
        self.substeps, self.slack_m = substeps, slack_m
        self._step_m = SPEED_M_S * tick_s
        self._delay = round(LATENCY_S / tick_s)
        self._waiting: Array = np.full((n, self._delay, 2), OPENING_M)
        self._reference: Array = np.full((n, 2), OPENING_M)

    def reset(self, opening_m: Array, rows: Rows) -> None:
        """Start `rows` at rest at the openings, (len(rows), 2)."""
        self._waiting[rows] = opening_m[:, None]
        self._reference[rows] = opening_m

    def __call__(self, commanded_m: Array, opening_m: Array) -> Array:
        """References of every physics step, (n, ticks * substeps, 2).

        Args:
            commanded_m: (n, ticks, 2).
            opening_m: (n, 2) where the fingers are.

        Raises:
            ActionError: An opening that the gripper does not have, or not a number.
        """
        if not ((commanded_m >= 0.0) & (commanded_m <= OPENING_M)).all():
            row, tick, arm = np.argwhere(~((commanded_m >= 0.0) & (commanded_m <= OPENING_M)))[0]
            raise ActionError(
                f"gripper {('left', 'right')[arm]} is asked for an opening of {commanded_m[row, tick, arm]:.4g} m "
                f"(cell {row}): it has 0 to {OPENING_M} m"
            )
        ticks = commanded_m.shape[1]
        queue = np.concatenate([self._waiting, commanded_m], axis=1)
        self._waiting = queue[:, ticks:]
        now = np.clip(self._reference, opening_m - self.slack_m, opening_m + self.slack_m)
        points = [now]
        for tick in range(ticks):
            now = now + np.clip(queue[:, tick] - now, -self._step_m, self._step_m)
            points.append(now)
        self._reference = now
        nodes = np.stack(points, axis=1)
        share = np.arange(1, self.substeps + 1) / self.substeps
        between = nodes[:, :-1, None] + share[:, None] * np.diff(nodes, axis=1)[:, :, None]
        return between.reshape(len(nodes), -1, 2)
