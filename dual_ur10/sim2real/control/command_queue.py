"""Delay of commands by the action's latency, the same in front of simulated and real arms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.adapter import STROKES_M, Command
from ur_core.types import Array, Rows

MAX_LATENCY_TICKS = 125


def checked_latency(ticks: object) -> int:
    """Return a valid action latency in control periods.

    Raises:
        SettingsError: It is no whole number from 0 to `MAX_LATENCY_TICKS`.
    """
    if isinstance(ticks, int | np.integer) and not isinstance(ticks, bool) and 0 <= ticks <= MAX_LATENCY_TICKS:
        return int(ticks)
    raise SettingsError(f"action_latency_ticks is {ticks!r:.80}: a whole number, 0 to {MAX_LATENCY_TICKS}")


class CommandQueue:
    """Queue that takes the commands of [t_k + L, t_k + L + period) at t_k and returns those of [t_k, t_k + period).

    On real arms the first L ticks of a period are known before the period begins, so that the arms need not wait for
    the policy.

    Args:
        n: Number of cells.
        latency_ticks: Latency L.
        stroke_m: (2,) largest width of each gripper.

    Raises:
        SettingsError: See `checked_latency`.
    """

    def __init__(self, n: int, latency_ticks: int, stroke_m: Sequence[float] = STROKES_M) -> None:
        self.latency_ticks = checked_latency(latency_ticks)
        self._targets: Array = np.zeros((n, self.latency_ticks, 2, 6))
        self._open_m: Array = np.array(stroke_m, dtype=np.float64)
        self._widths: Array = np.tile(self._open_m, (n, self.latency_ticks, 1))

    def reset(self, q_rad: Array, rows: Rows, gripper_m: Array | None = None) -> None:
        """Start `rows` at rest at `q_rad`, (len(rows), 2, 6), with gripper widths (len(rows), 2), or open grippers."""
        self._targets[rows] = q_rad[:, None]
        self._widths[rows] = self._open_m if gripper_m is None else np.asarray(gripper_m)[:, None]

    def __call__(self, command: Command) -> Command:
        """Queue a command and return the one that acts now."""
        if not self.latency_ticks:
            return command
        ticks = command.targets_rad.shape[1]
        targets = np.concatenate([self._targets, command.targets_rad], axis=1)
        self._targets = targets[:, ticks:]
        widths = command.gripper_m
        if widths is not None:
            queue = np.concatenate([self._widths, widths], axis=1)
            widths, self._widths = queue[:, :ticks], queue[:, ticks:]
        return command._replace(targets_rad=targets[:, :ticks], gripper_m=widths)
