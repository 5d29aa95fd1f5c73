"""Safety monitor: decide whether both arms must stop, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dual_ur10.sim2real.control.coupling import (
    APART_M,
    APART_RAD,
    Coupling,
    RelativePoses,
    is_beyond,
    pose_errors,
)
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, WAITING_S, root_cause
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.tracking import TrackingMonitor
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import ArmStatus, program_ended, stop_reason
from ur_core.processes.machine_load import StallWatch, too_busy
from ur_core.processes.system import LOCAL, System
from ur_core.protocol.modes import RuntimeState, SafetyMode
from ur_core.types import Array

POLICY_S: Final = 0.5
"""Longest delay of an action before a latched stop of both arms."""

BEHIND_S: Final = 0.1
"""Largest common delay of both arms behind the targets sent."""

REDUCED_SCALING: Final = 0.5
"""Time scaling while a controller is in reduced mode, if that is allowed. The assumption is that UR's controllers
enforce the reduced limits by a stop, and do not slow down a stream of targets."""

APART_S: Final = 0.024
"""Duration of a coupling error before a stop: three states of a CB3."""

PERIOD_S: Final = 0.004
"""Shortest time between two checks of both arms. Within it, states of a faster controller are checked together."""

_DELAYS: Final = 10  # number of delays tried within BEHIND_S
_NEAR: Final = 0.5  # fraction of the allowed error at which the search ends


@dataclass(frozen=True)
class MonitorSettings:
    """Settings of the safety monitor.

    Attributes:
        mounts: Base poses and kinematics of both arms.
        tick_s: Control period of both.
        emulated: Both controllers are emulated: they run on this machine.
    """

    mounts: tuple[ArmMount, ArmMount]
    tick_s: float
    emulated: bool = False


class SafetyMonitor:
    """Checks the states of both controllers and all processes.

    Args:
        settings: Mounts and control period.
        arms: Memories of both arms' processes.
        cell: Memory of the cell.
        system: Processes.

    Attributes:
        stalls: Stalls of this machine.
    """

    def __init__(
        self, settings: MonitorSettings, arms: Sequence[ArmMemory], cell: CellMemory, *, system: System = LOCAL
    ) -> None:
        self._settings, self._arms, self._cell, self._system = settings, arms, cell, system
        self.stalls = StallWatch(settings.emulated)
        self._tracking = [TrackingMonitor() for _ in arms]
        self._latest: list[ArmStatus | None] = [None for _ in arms]
        self._fresh = [False for _ in arms]
        self._apart, self._most_apart = 0, round(APART_S / max(settings.tick_s, PERIOD_S))
        self._coupling = Coupling(settings.mounts)

    @property
    def moving(self) -> bool:
        """True while targets are sent."""
        return self._cell.begin_s > 0.0 and any(memory.phase >= Phase.STREAMING for memory in self._arms)

    @property
    def slowest(self) -> float:
        """Smaller speed fraction of both controllers, from speed slider and reduced mode, 0 to 1."""
        return min((_speed_fraction(each) for each in self._latest if each is not None), default=1.0)

    @property
    def ended(self) -> list[bool]:
        """Flags of both programs that have ended, as their controllers report; a paused one may continue."""
        return [each is not None and each.runtime_state == RuntimeState.STOPPED for each in self._latest]

    def note(self, arm: int, status: ArmStatus) -> None:
        """Record a controller's state without judging it."""
        self._latest[arm] = status

    def state(self, arm: int, status: ArmStatus) -> str | None:
        """Check a controller's new state; return the reason for a stop, or None."""
        self._latest[arm], self._fresh[arm] = status, True
        self.stalls.packet(arm, status.timestamp_s, status.arrival_s)
        memory = self._arms[arm]
        playing = memory.phase == Phase.STREAMING
        reason = stop_reason(status, allow_reduced=self._cell.allow_reduced, playing=playing)
        if reason is not None and program_ended(status):
            # Its watchdog may be first to miss a process that stalls or has ended.
            if self._system.is_running(memory.process):
                self.stalls.note(status.arrival_s - memory.beat_s, status.arrival_s)
                reason = self.stalls.explained(reason, status.arrival_s)
            elif memory.process and memory.phase < Phase.STOPPING:
                reason = self.stalls.process_silent("its process", runs=False)
        reason = reason or self._tracking[arm](status)
        if reason is not None:
            return f"{ARMS[arm]}: {reason}"
        return None

    def processes(self, now_s: float) -> str | None:
        """Check the processes of both arms and the policy's deadline; return the reason for a stop, or None."""
        texts, silent = [], []
        # With a margin: each arm begins in a control period of its own.
        begun = 0.0 < self._cell.begin_s < now_s - STALE_S
        for name, memory in zip(ARMS, self._arms, strict=True):
            phase = memory.phase
            if phase >= Phase.STOPPING:
                texts.append(memory.text or f"{name}: its process has stopped")
            elif phase in (Phase.READY, Phase.STREAMING) and now_s - memory.beat_s > (
                STALE_S if begun or phase == Phase.STREAMING else WAITING_S
            ):
                runs = self._system.is_running(memory.process)
                silent.append(f"{name}: {self.stalls.process_silent('its process', runs=runs)}")
            elif begun and phase < Phase.STREAMING:
                texts.append(f"{name}: {too_busy('it does not begin')}")
        if silent or texts:
            return root_cause([*silent, *texts])  # an arm that misses the other's process stops because of it
        cell = self._cell
        if cell.live and cell.begin_s:
            scaling, tick_s = cell.time_scaling, self._settings.tick_s
            late_s = ((now_s - cell.begin_s) / tick_s - scaling.period_of(cell.fresh)) * tick_s
            if late_s > POLICY_S:
                return f"the policy gave no action for {1e3 * late_s:.0f} ms more than it has: both arms rest"
        return None

    def relative_pose(self) -> str | None:
        """Check the relative pose of two arms that hold one object; return the reason for a stop, or None.

        Call it once all received states are processed: an older state of one arm does not match the newest of the
        other.
        """
        if not self._cell.coupled:
            self._apart, self._fresh = 0, [False for _ in ARMS]
            return None
        latest = [each for each, fresh in zip(self._latest, self._fresh, strict=True) if each is not None and fresh]
        if len(latest) < len(ARMS):
            return None
        self._fresh = [False for _ in ARMS]
        sent = self._sent_for_both(0) if all(memory.sent_count for memory in self._arms) else None
        rows = [[each.q_rad for each in latest], [each.target_q_rad for each in latest]]
        found, *wanted = self._relative_poses([*rows, *([] if sent is None else [sent])])
        errors = [_pose_error(found, each) for each in wanted]
        apart_m, apart_rad = max(errors[0], self._least(errors[1], found) if sent else (0.0, 0.0), key=_fraction)
        self._apart = self._apart + 1 if is_beyond(apart_m, apart_rad) else 0
        if self._apart < self._most_apart:
            return None
        return (
            f"the arms, which hold one object, are {1e3 * apart_m:.1f} mm and {np.degrees(apart_rad):.1f}° from where "
            f"they should be to each other, allowed are {1e3 * APART_M:g} mm and {np.degrees(APART_RAD):.0f}°"
        )

    def _least(self, error: tuple[float, float], found: RelativePoses) -> tuple[float, float]:
        """Return the error of the relative pose against the targets sent for one common time, m and rad.

        A controller's own target does not reveal a delay of the whole arm. The common delay of both arms is not known
        exactly: the best fit within `BEHIND_S` counts.

        Args:
            error: Error without a delay.
            found: Relative pose of the arms.
        """
        best = error
        for back in range(1, _DELAYS + 1):
            if _fraction(best) < _NEAR:
                break
            (wanted,) = self._relative_poses([self._sent_for_both(back)])
            best = min(best, _pose_error(found, wanted), key=_fraction)
        return best

    def _relative_poses(self, q_rad: Sequence[Sequence[Sequence[float] | Array]]) -> list[RelativePoses]:
        """Return the relative poses of both arms at n joint angles of both."""
        return [RelativePoses(*each) for each in zip(*self._coupling.relative_poses(np.array(q_rad)), strict=True)]

    def _sent_for_both(self, back: int) -> list[Array]:
        """Return the targets sent to both arms for one time, (2, 6): the newest, or `back` delays before."""
        newest = min(float(memory.sent(memory.sent_count - 1)[0].index[-1]) for memory in self._arms)
        index = newest - back * BEHIND_S / _DELAYS / self._settings.tick_s
        return [memory.target(index) for memory in self._arms]


def _pose_error(found: RelativePoses, wanted: RelativePoses) -> tuple[float, float]:
    """Return the distance of two relative poses, m and rad."""
    apart_m, apart_rad = pose_errors(found, wanted)
    return float(apart_m), float(apart_rad)


def _fraction(apart: tuple[float, float]) -> float:
    """Return a pose error as a fraction of the allowed one."""
    return max(apart[0] / APART_M, apart[1] / APART_RAD)


def _speed_fraction(status: ArmStatus) -> float:
    """Return the allowed fraction of an arm's speed. Emulated controllers report all of it as their speed scaling."""
    reduced = REDUCED_SCALING if status.safety_mode == SafetyMode.REDUCED else 1.0
    return min(status.slider * reduced, status.speed_scaling)
