"""The way of an action: adapter, queue, gate. The same object in front of every kind of cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.sim2real.adapter import GRIPPER_OPENING_M, Command, ServojAdapter
from dual_ur10.sim2real.gate import SafetyGate, Verdict
from dual_ur10.ur10 import ARMS

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

MAX_LATENCY_TICKS = 125


class ServojPipeline:
    """Checks an action, turns it into targets, holds them back by the action's latency, and lets the gate decide.

    Action k shapes the targets of [t_k + L, t_k + L + period), with L the latency.

    Args:
        adapter: Turns actions into targets.
        gate: Decides what leaves.
        latency_ticks: L in controller ticks: the time that observing, thinking and sending take on a real cell.
    """

    def __init__(self, adapter: ServojAdapter, gate: SafetyGate, latency_ticks: int = 0) -> None:
        if not (isinstance(latency_ticks, int | np.integer) and 0 <= latency_ticks <= MAX_LATENCY_TICKS):
            raise SettingsError(f"action_latency_ticks is {latency_ticks!r}: a whole number, 0 to {MAX_LATENCY_TICKS}")
        if latency_ticks != adapter.latency_ticks:
            raise SettingsError(
                f"the adapter was made for a latency of {adapter.latency_ticks} ticks, the queue for {latency_ticks}: "
                "they must be equal, for the gate's periods depend on it"
            )
        self.adapter, self.gate, self.latency_ticks = adapter, gate, int(latency_ticks)
        self._shape = (adapter.n, 2, adapter.action_size)
        self._waiting: Array = np.zeros((adapter.n, self.latency_ticks, 2, 6))
        # The last row is what was sent last: what a gripper is held at when its arm is stopped.
        self._openings: Array = np.zeros((adapter.n, self.latency_ticks + 1, 2))

    def reset(self, q_rad: Array, rows: Rows | None = None, gripper_m: Array | None = None) -> None:
        """Start from rest.

        Args:
            q_rad: (n, 2, 6), or (len(rows), 2, 6).
            rows: The cells to start; None: all.
            gripper_m: (n, 2) or (len(rows), 2) opening of the grippers; None: open.
        """
        self.adapter.reset(q_rad, rows)
        self.gate.reset(q_rad, rows)
        index = slice(None) if rows is None else rows
        self._waiting[index] = np.asarray(q_rad)[:, None]
        self._openings[index] = GRIPPER_OPENING_M if gripper_m is None else np.asarray(gripper_m)[:, None]

    def __call__(self, action: object) -> tuple[Command, dict[int, Verdict]]:
        """What is sent in the next control period.

        Args:
            action: Numbers that fit (n, 2, action_size); copied.

        Returns:
            The command, and a verdict for each row that the gate refused.

        Raises:
            ActionError: Not numbers, the wrong shape, NaN or infinity. Nothing is sent and nothing changes.
        """
        targets, gripper, _ = self.adapter(self.check(action))
        if self.latency_ticks:
            queue = np.concatenate([self._waiting, targets], axis=1)
            targets, self._waiting = queue[:, : self.adapter.ticks], queue[:, self.adapter.ticks :]
        result = self.gate(targets)
        if gripper is not None:
            gripper = self._delayed(gripper, list(result.verdicts))
        return Command(result.targets_rad, gripper), result.verdicts

    def _delayed(self, openings: Array, stopped: list[int]) -> Array:
        """Openings, (n, ticks, 2), held back by the latency; in the `stopped` cells, what was sent last."""
        queue = np.concatenate([self._openings, openings], axis=1)
        if stopped:
            queue[stopped] = self._openings[stopped, :1]
        self._openings = queue[:, self.adapter.ticks :]
        return queue[:, 1 : self.adapter.ticks + 1]

    def check(self, action: object) -> Array:
        """The action as float64 of shape (n, 2, action_size).

        Raises:
            ActionError: See `__call__`.
        """
        try:
            array = np.asarray(action)
        except (TypeError, ValueError) as error:
            raise ActionError(f"an action must be numbers, found {type(action).__name__}: {error}") from None
        if array.dtype.kind not in "fiu":
            raise ActionError(f"an action must be numbers, found {array.dtype} from {type(action).__name__}")
        size = self._shape[0] * self._shape[1] * self._shape[2]
        if array.size != size or array.shape not in _shapes(self._shape):
            allowed = " or ".join(map(str, _shapes(self._shape)))
            raise ActionError(f"an action must have shape {allowed}, found {array.shape}")
        checked: Array = array.astype(np.float64).reshape(self._shape)
        if not np.logical_and.reduce(np.isfinite(checked), axis=None):
            row, arm, number = np.argwhere(~np.isfinite(checked))[0]
            raise ActionError(
                f"number {number} of the {ARMS[arm]} arm's action is {checked[row, arm, number]} (cell {row}): actions "
                "must be finite. Nothing was sent"
            )
        return checked


def _shapes(shape: tuple[int, int, int]) -> list[tuple[int, ...]]:
    n, arms, size = shape
    return [(n, arms, size), (n, arms * size)] + ([(arms, size), (arms * size,)] if n == 1 else [])
