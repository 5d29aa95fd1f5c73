"""Action pipeline: adapter, what leads its motion, then safety gate. The same object in front of every kind of cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_ur10.errors import ActionError
from dual_ur10.sim2real.control.adapter import Command, ServojAdapter
from dual_ur10.sim2real.control.gate import SafetyGate, Verdict
from dual_ur10.sim2real.control.leading import Leading
from dual_ur10.sim2real.control.proximity import ProximityScaling
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array, Mask, Rows


class ServojPipeline:
    """Validates an action, converts it into targets, and passes these through the gate.

    The command of action k is for [t_k + L, t_k + L + period), with L the action's latency: the cell delays it.

    Args:
        adapter: Converts actions into targets.
        gate: Releases or replaces targets.
        held: Index of an arm that stays where it is, whatever the actions are; None: neither.
        leads: Motion that the gate would refuse is led along what is in its way; see
            `dual_ur10.sim2real.control.leading`.
        proximity: Slows one cell down near things; None: nothing does.

    Attributes:
        led: (n,) True where the last action's motion was led.
    """

    def __init__(
        self,
        adapter: ServojAdapter,
        gate: SafetyGate,
        *,
        held: int | None,
        leads: bool = True,
        proximity: ProximityScaling | None = None,
    ) -> None:
        self.adapter, self.gate, self._held, self._proximity = adapter, gate, held, proximity
        self._leading = Leading(adapter, gate, held) if leads else None
        self.led: Mask = np.zeros(adapter.n, dtype=bool)
        self._scaling = 1.0
        self._shape = (adapter.n, 2, adapter.action_size)
        self._shapes = _shapes(self._shape)
        self._widths: Array = np.zeros((adapter.n, 2))  # released last: where the gripper of a stopped arm is held

    def reset(self, q_rad: Array, rows: Rows | None = None, gripper_m: Array | None = None) -> None:
        """Start from rest.

        Args:
            q_rad: (n, 2, 6), or (len(rows), 2, 6).
            rows: The cells to start; None: all.
            gripper_m: (n, 2) or (len(rows), 2) gripper widths; None: open.
        """
        self.adapter.reset(q_rad, rows)
        self.gate.reset(q_rad, rows)
        if self._proximity is not None:
            self._proximity.reset(np.asarray(q_rad, dtype=np.float64).reshape(12))
        index = slice(None) if rows is None else rows
        self._widths[index] = self.adapter.stroke_m if gripper_m is None else gripper_m

    def __call__(self, action: object, coupled: Mask | None = None) -> tuple[Command, dict[int, Verdict]]:
        """Return the command of an action as far as the gate releases it.

        Args:
            action: Numbers that fit (n, 2, action_size); copied.
            coupled: (n,) rows whose arms hold one object between them; None: none does.

        Returns:
            The command, and the verdict of each row that the gate refused.

        Raises:
            ActionError: Not numbers, the wrong shape, NaN or infinity. Nothing is sent and nothing changes.
        """
        checked = self.check(action)
        command = self.adapter(checked)
        targets, gripper = command.targets_rad, command.gripper_m
        if self._leading is not None:
            self.led = self._leading(coupled)
            if np.count_nonzero(self.led):
                targets = self.adapter.targets_rad
        if self._held is not None:
            targets[:, :, self._held] = self.gate.last_targets_rad[:, None, self._held]
        result = self.gate(targets)
        if gripper is not None:
            stopped = list(result.verdicts)
            if stopped:
                gripper[stopped] = self._widths[stopped, None]
            self._widths = gripper[:, -1]
        if self._proximity is not None and not result.verdicts:
            self._scaling = self._proximity(result.targets_rad[0, -1].reshape(12), self.gate.spare_m[0])
        return Command(result.targets_rad, gripper, scaling=self._scaling), result.verdicts

    def resume(self, rows: Sequence[int]) -> None:
        """Let refused rows continue from where their brake has led; actions count again once it has ended.

        For simulated cells: on two controllers a refusal ends in a stop.
        """
        refused = np.array(rows)
        last = self.gate.last_targets_rad[refused]
        self.adapter.reset(last, refused)
        rest = self.gate.rests[refused]
        if rest.any():
            self.gate.reset(last[rest], refused[rest])

    @property
    def commanded_widths_m(self) -> Array:
        """Gripper widths released last, (n, 2)."""
        return self._widths.copy()

    @property
    def clipped_actions(self) -> int:
        """Number of actions so far that were clipped to the action space."""
        return self.adapter.clipped_actions

    def check(self, action: object) -> Array:
        """Return the action as float64 of shape (n, 2, action_size).

        Raises:
            ActionError: See `__call__`.
        """
        try:
            array = np.asarray(action)
        except (TypeError, ValueError) as error:
            raise ActionError(f"an action must be numbers, found {type(action).__name__}: {error}") from None
        if array.dtype.kind not in "fiu":
            raise ActionError(f"an action must be numbers, found {array.dtype} from {type(action).__name__}")
        if array.shape not in self._shapes:
            allowed = " or ".join(map(str, self._shapes))
            raise ActionError(f"an action must have shape {allowed}, found {array.shape}")
        checked: Array = array.astype(np.float64).reshape(self._shape)
        if np.count_nonzero(np.isfinite(checked)) < checked.size:
            row, arm, number = np.argwhere(~np.isfinite(checked))[0]
            raise ActionError(
                f"number {number} of the {ARMS[arm]} arm's action is {checked[row, arm, number]} (cell {row}): actions "
                "must be finite. Nothing was sent"
            )
        return checked


def _shapes(shape: tuple[int, int, int]) -> list[tuple[int, ...]]:
    n, arms, size = shape
    return [(n, arms, size), (n, arms * size)] + ([(arms, size), (arms * size,)] if n == 1 else [])
