"""Motion of both arms to the start of a task, through a safety gate of its own."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dual_ur10.errors import DualUR10Error, StartError
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.limits import HISTORY, MotionLimits
from dual_ur10.sim2real.runtime.approach import ACCELERATION_RAD_S2, retreat_clearance
from dual_ur10.sim2real.runtime.arm_sender import MOST_LATE_S
from dual_ur10.sim2real.runtime.runner import Runner, TargetWriter, margin_ticks
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import ArmStatus
from ur_core.processes.machine_load import too_busy
from ur_core.types import Array

SETTLED_RAD: Final = 1e-4
"""Distance of the controllers' targets from the start of a task at which an episode begins at once."""

START_RAD: Final = ACCELERATION_RAD_S2 * MOST_LATE_S**2 / 2
"""Largest distance of the controllers' targets from the start of a task with which an episode begins at all, 2.5 mrad.
An approach ends no farther away for a controller that is as far behind as targets may be late. The targets of an
episode continue those that were sent, bit for bit, wherever the controllers are: a distance causes no jump."""

MEASURED_RAD: Final = 0.02
"""Largest measured distance from it."""

AHEAD_TICKS: Final = 300
"""Largest number of targets written ahead."""

_LEAD_S: Final = MOST_LATE_S  # of the first targets: a longer stall stops the arms anyway, and nothing moves before
_AHEAD_S: Final = 1.0  # targets written ahead, in real time: few, so that an interrupt takes effect soon
_SETTLE_S: Final = 3.0
_POLL_S: Final = 0.01


class StalledError(StartError):
    """Raised when this program stalled on a path. Both arms stopped on it, and may go on from there."""


class PathToStart:
    """Executor of a planned approach.

    Args:
        limits: Limits of the gate.
        clearance: Computes distances.
        tick_s: Control period.
        ticks: Targets per window of the gate.
        speed_factor: Rate of task time in real time.
        targets: Writer of the targets.
        emulated: Both controllers are emulated: they run on this machine.
    """

    def __init__(
        self,
        limits: MotionLimits,
        clearance: Clearance,
        tick_s: float,
        ticks: int,
        speed_factor: float,
        targets: TargetWriter,
        *,
        emulated: bool = False,
    ) -> None:
        self._limits, self._clearance, self._tick_s, self._ticks = limits, clearance, tick_s, ticks
        self._targets, self._emulated = targets, emulated
        self._lead = math.ceil(_LEAD_S / tick_s * speed_factor)
        least = 2 * (margin_ticks(tick_s) + ticks)
        self._ahead = min(max(math.ceil(_AHEAD_S / tick_s * speed_factor), least), AHEAD_TICKS)

    def follow(self, runner: Runner, start_rad: Array, targets_rad: Array) -> None:
        """Send targets, (k, 2, 6), from rest at `start_rad`, (2, 6), to rest, as far as a safety gate releases them.

        Raises:
            StartError: The gate refused a target. Both arms stopped on the path.
            StalledError: This program stalled. Both arms stopped on the path.
        """
        try:
            self._follow(runner, start_rad, targets_rad)
        except DualUR10Error:
            runner.cell.expect(0.0, live=False)  # both arms stop: the brake follows the written targets
            raise
        except BaseException:
            # An interrupt: written targets continue, and the supervisor stops both arms without further ones.
            runner.cell.expect(runner.now, live=True)
            raise

    def _follow(self, runner: Runner, start_rad: Array, targets_rad: Array) -> None:
        ticks = self._ticks
        gate = SafetyGate(self._limits, self._tick_s, ticks, retreat_clearance(self._clearance, start_rad))
        gate.reset(start_rad[None])
        self._targets.rest_at(start_rad)
        windows = math.ceil((len(targets_rad) + HISTORY) / ticks)
        # At rest for as long as the brake looks back: it must not lead away from the start.
        rest = np.repeat(targets_rad[-1:], windows * ticks - len(targets_rad), axis=0)
        waiting = np.concatenate([targets_rad, rest]).reshape(windows, 1, ticks, 2, 6)
        at_once = max(1, self._ahead // 2 // ticks)
        first = -1
        for begin in range(0, windows, at_once):
            passed = [gate(window) for window in waiting[begin : begin + at_once]]
            why = next((f"the safety gate refuses it: {each.verdicts[0]}" for each in passed if each.verdicts), "")
            block = np.concatenate([each.targets_rad[0] for each in passed])
            if first < 0:  # checking many windows takes a while
                first = runner.next + self._lead
            stalled = not (why or self._targets.write(runner, first, block))
            if why or stalled:
                runner.cell.expect(0.0, live=False)
                runner.wait_for(runner.end)
                text = "the path to the start was not finished, both arms stopped on it: reset again"
                if stalled:
                    raise StalledError(f"{text}; {too_busy('this program stalled')}")
                raise StartError(f"{text}; {why}")
            first += len(block)
            # A program that hangs here misses the deadline of the next targets, as in an episode.
            runner.cell.expect(first, live=begin + at_once < windows)
            runner.wait_for(first - self._ahead // 2)
        runner.wait_for(first)

    def arrived(self, runner: Runner, goal_rad: Array) -> list[ArmStatus]:
        """Wait until both arms are at (2, 6), and return the states measured there.

        Raises:
            StartError: An arm does not arrive.
            CellFaulted: The arms were stopped.
        """
        end = runner.clock.now_s() + _SETTLE_S
        while True:
            runner.check()
            statuses = runner.statuses()
            wanted = np.abs(np.array([each.target_q_rad for each in statuses]) - goal_rad).max(axis=1)
            found = np.abs(np.array([each.q_rad for each in statuses]) - goal_rad).max(axis=1)
            late = runner.clock.now_s() > end
            if (wanted <= (START_RAD if late else SETTLED_RAD)).all() and (found <= MEASURED_RAD).all():
                return statuses
            if late:
                raise StartError(self._absent(wanted, found))
            runner.clock.sleep(_POLL_S)

    def _absent(self, wanted: Array, found: Array) -> str:
        """Return the text about arms that do not arrive, from the distances of targets and measured angles, (2,)."""
        if (wanted > START_RAD).any():  # what holds an arm does not hold its target
            arm = int(wanted.argmax())
            text = (
                f"the {ARMS[arm]} controller's target is {wanted[arm]:.2g} rad from the start of the task "
                f"{_SETTLE_S:g} s after it was sent, allowed are {START_RAD:g}"
            )
            return too_busy(text) if self._emulated else f"{text}. Check its network, and what else loads it"
        arm = int(found.argmax())
        return (
            f"{ARMS[arm]} does not reach the start of the task: it is measured {found[arm]:.2g} rad from there, "
            f"allowed are {MEASURED_RAD:g}. Check what holds it, and its payload"
        )
