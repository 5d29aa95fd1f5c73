"""Writer of targets into shared memory, each window followed by the brake that ends it if nothing else comes."""

from __future__ import annotations

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.limits import HISTORY, Envelope, MotionLimits
from dual_ur10.sim2real.runtime.arm_memory import RING
from dual_ur10.sim2real.runtime.runner import Runner
from dual_ur10.types import Array


class TargetWriter:
    """Writes the targets of both arms, followed by the brake that the safety gate has checked.

    Args:
        limits: Limits of the gate, from which its brake follows.
        tick_s: Control period.
        most_ticks: Largest number of targets written at once or ahead.

    Raises:
        SettingsError: Under these limits the brake is longer than the memory holds.
    """

    def __init__(self, limits: MotionLimits, tick_s: float, most_ticks: int) -> None:
        self._brake: Array = Envelope(limits, tick_s, 1).whole_brake()
        count, most = len(self._brake), RING // 2 - most_ticks
        if count > most:
            raise SettingsError(
                f"the limits of this cell need a brake of {count * tick_s:.1f} s, {most * tick_s:.1f} s is "
                "the most that is kept ready: allow more acceleration or jerk, or less speed"
            )
        self._past: Array = np.zeros((HISTORY, 2, 6))  # last targets, without those of the brake

    def rest_at(self, q_rad: Array) -> None:
        """Continue from both arms at rest at (2, 6)."""
        self._past = np.tile(q_rad, (HISTORY, 1, 1))

    def write(self, runner: Runner, first: int, targets_rad: Array) -> bool:
        """Write targets, (k, 2, 6), from number `first` on; return False if it is too late for that."""
        last = np.concatenate([self._past, targets_rad])[-HISTORY:]
        past = last.reshape(HISTORY, 12)
        brake = past[-1] + self._brake @ (past - past[-1])
        whole = np.concatenate([targets_rad, brake.reshape(-1, 2, 6)])
        if not runner.write(first, whole):
            return False
        self._past = last
        return True
