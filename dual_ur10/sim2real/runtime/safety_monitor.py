"""Judges whether both arms may go on moving: from what both controllers and all processes show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dual_ur10.kinematics.forward import flange_pose_quat
from dual_ur10.kinematics.frames import ArmMount, Frames
from dual_ur10.kinematics.poses import Poses, relative_to
from dual_ur10.kinematics.rotations import quat_conjugate, quat_multiply, quat_to_rotvec
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.links.arm_status import ArmStatus, stop_reason
from dual_ur10.sim2real.protocol.modes import RuntimeState, SafetyMode
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S, WAITING_S, root_cause
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.tracking import Tracking
from dual_ur10.types import Array

POLICY_S: Final = 0.5
"""How late a policy may be before both arms are stopped for good."""

APART_M: Final = 0.01
APART_RAD: Final = np.deg2rad(3.0)
"""How far the flanges of two arms that hold one object may be from where they should be, seen from each other."""

BEHIND_S: Final = 0.1
"""By how much both arms may follow later than they were sent, together."""

REDUCED_SCALING: Final = 0.5
"""How fast the time of the targets passes where a controller is in reduced mode and may be. It is assumed that UR's
controllers keep the reduced limits by a stop, and slow no stream of targets down for them."""

APART_S: Final = 0.024
"""For how long: three states of a CB3."""

_LOOKS: Final = 10
_NEAR: Final = 0.5  # of what is allowed: near enough to look no further


@dataclass(frozen=True)
class MonitorSettings:
    """What is watched.

    Attributes:
        mounts: Where both arms stand, and their kinematics.
        tick_s: Control period of both.
        coupled: Whether both arms hold one object.
    """

    mounts: tuple[ArmMount, ArmMount]
    tick_s: float
    coupled: bool = False


class SafetyMonitor:
    """Says why both arms must stop, if they must.

    Args:
        settings: What is watched.
        arms: Memories of both arms' processes.
        cell: Memory of all.
    """

    def __init__(self, settings: MonitorSettings, arms: Sequence[ArmMemory], cell: CellMemory) -> None:
        self._settings, self._arms, self._cell = settings, arms, cell
        self._tracking = [Tracking() for _ in arms]
        self._latest: list[ArmStatus | None] = [None for _ in arms]
        self._fresh = [False for _ in arms]
        self._apart, self._most_apart = 0, round(APART_S / settings.tick_s)
        self._frames = Frames(settings.mounts)

    @property
    def moving(self) -> bool:
        """Whether targets are sent."""
        return self._cell.begin_s > 0.0 and any(memory.phase >= Phase.STREAMING for memory in self._arms)

    @property
    def slowest(self) -> float:
        """The smaller one of what both controllers make of their speed sliders, and of reduced mode, 0 to 1."""
        return min((_speed(each) for each in self._latest if each is not None), default=1.0)

    @property
    def ended(self) -> list[bool]:
        """Whether each controller says that its program has ended: one that is paused may go on."""
        return [each is not None and each.runtime_state == RuntimeState.STOPPED for each in self._latest]

    def note(self, arm: int, status: ArmStatus) -> None:
        """A controller's new state, which is not judged any more."""
        self._latest[arm] = status

    def state(self, arm: int, status: ArmStatus) -> str | None:
        """What a controller's new state says."""
        self._latest[arm], self._fresh[arm] = status, True
        playing = self._arms[arm].phase == Phase.STREAMING
        reason = stop_reason(status, allow_reduced=self._cell.allow_reduced, playing=playing)
        reason = reason or self._tracking[arm](status)
        if reason is not None:
            return f"{ARMS[arm]}: {reason}"
        return None

    def processes(self, now_s: float) -> str | None:
        """What the processes of both arms say, and that of the policy."""
        texts = []
        # Some time ago: they begin in a control period of their own, each.
        begun = 0.0 < self._cell.begin_s < now_s - STALE_S
        for name, memory in zip(ARMS, self._arms, strict=True):
            phase = memory.phase
            if phase >= Phase.STOPPING:
                texts.append(memory.text or f"{name}: its process has stopped")
            elif phase in (Phase.READY, Phase.STREAMING) and now_s - memory.beat_s > (
                STALE_S if begun or phase == Phase.STREAMING else WAITING_S
            ):
                texts.append(f"{name}: its process does nothing any more")
            elif begun and phase < Phase.STREAMING:
                texts.append(f"{name}: it does not begin: this machine is too busy")
        if texts:
            return root_cause(texts)
        cell = self._cell
        if cell.live and cell.begin_s:
            scaling, tick_s = cell.time_scaling, self._settings.tick_s
            late_s = ((now_s - cell.begin_s) / tick_s - scaling.period_of(cell.fresh)) * tick_s
            if late_s > POLICY_S:
                return f"the policy gave no action for {1e3 * late_s:.0f} ms more than it has: both arms rest"
        return None

    def together(self) -> str | None:
        """Whether two arms that hold one object are where they should be, seen from each other.

        To be asked once all states that came are taken in: an older one of one arm does not belong to the newest of the
        other.
        """
        latest = [each for each, fresh in zip(self._latest, self._fresh, strict=True) if each is not None and fresh]
        if not self._settings.coupled or len(latest) < len(ARMS):
            return None
        self._fresh = [False for _ in ARMS]
        mounts = self._settings.mounts
        found = _seen([each.q_rad for each in latest], mounts, self._frames)
        wanted = _seen([each.target_q_rad for each in latest], mounts, self._frames)
        apart_m, apart_rad = max(_apart(found, wanted), self._from_commanded(found), key=_share)
        self._apart = self._apart + 1 if apart_m > APART_M or apart_rad > APART_RAD else 0
        if self._apart < self._most_apart:
            return None
        return (
            f"the arms, which hold one object, are {1e3 * apart_m:.1f} mm and {np.degrees(apart_rad):.1f}° from where "
            f"they should be to each other, allowed are {1e3 * APART_M:g} mm and {np.degrees(APART_RAD):.0f}°"
        )

    def _from_commanded(self, found: tuple[Array, Array]) -> tuple[float, float]:
        """How far the arms are from what both were sent for one and the same time, m and rad.

        Where a controller wants its arm says nothing of one that is late as a whole. By how much both follow later is
        not known to the millisecond: the time within `BEHIND_S` counts that fits best.
        """
        if not all(memory.sent_count for memory in self._arms):
            return 0.0, 0.0
        newest = min(float(memory.sent(memory.sent_count - 1)[0].index[-1]) for memory in self._arms)
        best = (np.inf, np.inf)
        for back in range(_LOOKS + 1):
            index = newest - back * BEHIND_S / _LOOKS / self._settings.tick_s
            sent = [memory.target(index) for memory in self._arms]
            best = min(best, _apart(found, _seen(sent, self._settings.mounts, self._frames)), key=_share)
            if _share(best) < _NEAR:
                break
        return best


def _apart(found: tuple[Array, Array], wanted: tuple[Array, Array]) -> tuple[float, float]:
    """How far two relative poses are from each other, m and rad."""
    turn = quat_multiply(quat_conjugate(wanted[1]), found[1])
    return float(np.linalg.norm(found[0] - wanted[0])), float(np.linalg.norm(quat_to_rotvec(turn)))


def _share(apart: tuple[float, float]) -> float:
    """The same as a share of what is allowed."""
    return max(apart[0] / APART_M, apart[1] / float(APART_RAD))


def _speed(status: ArmStatus) -> float:
    """How fast an arm may go, as a fraction. Emulated controllers tell all of it as their speed scaling."""
    reduced = REDUCED_SCALING if status.safety_mode == SafetyMode.REDUCED else 1.0
    return min(status.slider * reduced, status.speed_scaling)


def _seen(q_rad: Sequence[Sequence[float] | Array], mounts: Sequence[ArmMount], frames: Frames) -> tuple[Array, Array]:
    """The right flange in the frame of the left one: position and orientation."""
    poses = [flange_pose_quat(q, mount.dh) for q, mount in zip(q_rad, mounts, strict=True)]
    position = frames.position_to_cell(np.array([each[0] for each in poses]))
    quat = frames.quat_to_cell(np.array([each[1] for each in poses]))
    left, right = (Poses(position[arm], quat[arm]) for arm in (0, 1))
    return relative_to(left, right)
