"""Both arms are led to where a task begins, slowly, through a safety gate of its own."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

from dual_ur10.errors import DualUR10Error, StartError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.links.arm_status import ArmStatus
from dual_ur10.sim2real.runtime.approach import RetreatClearance
from dual_ur10.sim2real.runtime.runner import Runner, margin_ticks
from dual_ur10.sim2real.runtime.target_writer import TargetWriter
from dual_ur10.types import Array

START_RAD: Final = 1e-4
"""How near to the start of a task the controllers must want their arms to be, before an episode begins."""

MEASURED_RAD: Final = 0.02
"""How near to it they must be measured to be."""

AHEAD_TICKS: Final = 300
"""How many targets are written ahead, at most."""

_AHEAD_S: Final = 1.0  # that are written ahead, in real time: few, so that an interrupt means something
_SETTLE_S: Final = 3.0
_LOOK_S: Final = 0.01


class PathToStart:
    """Leads both arms along targets that were planned.

    Args:
        limits: Of the gate.
        clearance: Measures distances.
        tick_s: Control period.
        ticks: Targets per window of the gate.
        speed_factor: How fast the time of targets passes.
        targets: Writes them.
    """

    def __init__(
        self,
        limits: MotionLimits,
        clearance: Clearance,
        tick_s: float,
        ticks: int,
        speed_factor: float,
        targets: TargetWriter,
    ) -> None:
        self._limits, self._clearance, self._tick_s, self._ticks = limits, clearance, tick_s, ticks
        self._targets = targets
        least = 2 * (margin_ticks(tick_s) + ticks)
        self._ahead = min(max(math.ceil(_AHEAD_S / tick_s * speed_factor), least), AHEAD_TICKS)

    def go(self, runner: Runner, start_rad: Array, targets_rad: Array) -> None:
        """Send what a safety gate lets out of targets, (k, 2, 6), from rest at `start_rad`, (2, 6), to rest.

        Raises:
            StartError: The gate refuses some, or this program stood still. Both arms rest on the way.
        """
        try:
            self._lead(runner, start_rad, targets_rad)
        except DualUR10Error:
            runner.cell.expect(0.0, live=False)  # both arms come to rest: the brake lies behind what was written
            raise
        except BaseException:
            # An interrupt: what was written goes on meanwhile, and who hears no more from this program stops both.
            runner.cell.expect(runner.now, live=True)
            raise

    def _lead(self, runner: Runner, start_rad: Array, targets_rad: Array) -> None:
        ticks = self._ticks
        gate = SafetyGate(self._limits, self._tick_s, ticks, RetreatClearance(self._clearance, start_rad))
        gate.reset(start_rad[None])
        self._targets.rest_at(start_rad)
        windows = math.ceil(len(targets_rad) / ticks)
        rest = np.repeat(targets_rad[-1:], windows * ticks - len(targets_rad), axis=0)
        waiting = np.concatenate([targets_rad, rest]).reshape(windows, 1, ticks, 2, 6)
        at_once = max(1, self._ahead // 2 // ticks)
        first = -1
        for begin in range(0, windows, at_once):
            passed = [gate(window) for window in waiting[begin : begin + at_once]]
            why = next((f"the safety gate refuses it: {each.verdicts[0]}" for each in passed if each.verdicts), "")
            block = np.concatenate([each.targets_rad[0] for each in passed])
            if first < 0:  # many windows take a while
                first = runner.next + 3
            if not (why or self._targets.write(runner, first, block)):
                why = "this program stood still"
            if why:
                runner.cell.expect(0.0, live=False)
                runner.wait_for(runner.end)
                raise StartError(f"the way to the start was not finished, both arms rest on it, reset again; {why}")
            first += len(block)
            # Who hangs here is late behind what was written, as in an episode.
            runner.cell.expect(first, live=begin + at_once < windows)
            runner.wait_for(first - self._ahead // 2)
        runner.wait_for(first)

    def arrived(self, runner: Runner, goal_rad: Array) -> list[ArmStatus]:
        """Wait until both arms are at (2, 6), and return what is measured there.

        Raises:
            StartError: One does not get there.
            CellFaulted: The arms were stopped.
        """
        end = time.monotonic() + _SETTLE_S
        while True:
            runner.check()
            statuses = runner.statuses()
            wanted = np.abs(np.array([each.target_q_rad for each in statuses]) - goal_rad).max(axis=1)
            found = np.abs(np.array([each.q_rad for each in statuses]) - goal_rad).max(axis=1)
            if (wanted <= START_RAD).all() and (found <= MEASURED_RAD).all():
                return statuses
            if time.monotonic() > end:
                arm = int(np.maximum(wanted / START_RAD, found / MEASURED_RAD).argmax())
                raise StartError(
                    f"{ARMS[arm]} does not come to where the task begins: its controller is {wanted[arm]:.2g} rad "
                    f"from there, allowed are {START_RAD:g}, and it is measured {found[arm]:.2g} rad from there, "
                    f"allowed are {MEASURED_RAD:g}. Look at what holds it, and at its payload"
                )
            time.sleep(_LOOK_S)
