"""Action pipeline: adapter, what leads its motion, then safety gate. The same object in front of every kind of cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.errors import ActionError
from dual_ur10.sim2real.control.adapter import Command, ServojAdapter
from dual_ur10.sim2real.control.gate import SafetyGate, Verdict
from dual_ur10.sim2real.control.proximity import ProximityScaling
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array, Mask, Rows

MARGIN_M: Final = 0.0005
"""Distance above the smallest legal one that led motion keeps where it ends: a wall is curved, and its slope is not."""


class Leading:
    """Leads the targets that an adapter has planned along what is in their way, before the gate sees them.

    The brake is always possible, so the targets of a period are the brake plus a difference. What the gate looks at is
    where the brake after these targets ends. Each pair that would come too close there is a wall: the slopes of its
    distance say which part of the difference leads into it. That part is removed, and the rest is scaled to the limits
    of motion. The gate is asked about the result. If it would still refuse, the walls are measured again there, a few
    times; then the difference is halved, a few times; and last the arms brake. What would be refused even then reaches
    the gate as it was planned.

    An arm gives way in proportion to its own motion, so that one that rests is never moved. Arms that hold one object
    between them keep the direction of their motion, and with it their relative pose: they only slow down.

    Motion that the gate would release is not changed. What the gate has found out is not computed again when it gets
    the same targets.

    Args:
        adapter: Has planned the targets.
        gate: Would refuse some of them.
        held: Index of an arm whose targets will be replaced by its last one; None: neither.
    """

    def __init__(self, adapter: ServojAdapter, gate: SafetyGate, held: int | None = None) -> None:
        n = adapter.n
        self._gate = gate
        self._coupled, self._led = np.zeros((2, n), dtype=np.int64)
        kernel = Struct(
            "Lead",
            n=n,
            adapter=adapter.kernel,
            gate=gate.kernel,
            margin_m=MARGIN_M,
            held=-1 if held is None else held,
            coupled=self._coupled,
            led=self._led,
        )
        self._step = RowLoop("lead_step", kernel, n, adapter.threads)

    def __call__(self, coupled: Mask | None = None) -> Mask:
        """Lead the targets of the adapter, in place.

        Args:
            coupled: (n,) rows whose arms hold one object between them; None: none does.

        Returns:
            (n,) rows whose motion was led.
        """
        self._coupled[:] = 0 if coupled is None else coupled
        self._step()
        led: Mask = self._led != 0
        return led


class ServojPipeline:
    """Validates an action, converts it into targets, and passes these through the gate.

    The command of action k is for [t_k + L, t_k + L + period), with L the action's latency: the cell delays it.

    Args:
        adapter: Converts actions into targets.
        gate: Releases or replaces targets.
        held: Index of an arm that stays where it is, whatever the actions are; None: neither.
        leads: Motion that the gate would refuse is led along what is in its way; see `Leading`.
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
        self.adapter.reset(last, refused, begins=False)
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
