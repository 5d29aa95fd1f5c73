"""Memory that an arm's process shares with those who give it targets, watch it and record it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.time_scaling import interpolate
from dual_ur10.sim2real.links.arm_status import ROW_SIZE, ArmStatus
from dual_ur10.sim2real.processes.shared_memory import Layout, SharedBlock
from dual_ur10.types import Array

RING: Final = 4096
"""Targets, sendings and states that are kept: half a minute at 125 Hz, eight seconds at 500 Hz."""

_TEXT: Final = 1024
_AGAIN: Final = 5  # what is read while it is written is read again
_END, _SENT, _PHASE, _STOP, _SKIPPED, _STATES, _PROCESS = range(7)
_BEAT_S, _FIRST_S = range(2)
_LAYOUT: Final[Layout] = {
    "ints": (np.int64, (16,)),
    "floats": (np.float64, (16,)),
    "targets": (np.float64, (RING, 6)),
    "sent": (np.float64, (RING, 10)),
    "states": (np.float64, (RING, ROW_SIZE)),
    "text": (np.uint8, (_TEXT,)),
}


class Phase(IntEnum):
    """What an arm's process does. It only ever goes up."""

    STARTING = 0
    READY = 1
    STREAMING = 2
    STOPPING = 3
    STOPPED = 4
    FAULTED = 5


@dataclass(frozen=True)
class Sent:
    """Targets that were sent, oldest first.

    Attributes:
        period: (k,) control periods since the first target's.
        index: (k,) which target it was; between two, where time is slowed down.
        sent_s: (k,) when, on the clock of `time.monotonic`.
        late_s: (k,) by how much too late.
        target_rad: (k, 6).
    """

    period: Array
    index: Array
    sent_s: Array
    late_s: Array
    target_rad: Array


class ArmMemory:
    """The memory of one arm.

    Targets have numbers from 0 on. What lies ahead of the one that is sent may be written again: a motion is written
    together with the brake that ends it, and the next one is written over that brake. Behind the last target the arm
    rests at it.

    Args:
        name: Of memory that exists; None: it is made, and belongs to this object.

    Attributes:
        name: By which another process finds it.
    """

    def __init__(self, name: str | None = None) -> None:
        self._block = SharedBlock(_LAYOUT, name)
        self.name = self._block.name
        self._view()

    def _view(self) -> None:
        self._ints: NDArray[np.int64] = self._block["ints"]
        self._floats: Array = self._block["floats"]
        self._targets: Array = self._block["targets"]
        self._sent: Array = self._block["sent"]
        self._states: Array = self._block["states"]

    # Written by the program.

    def put(self, first: int, targets_rad: Array) -> None:
        """Write targets `first`, `first` + 1, ..., (k, 6), and make the last of them the end.

        If `first` lies behind the end, the last target is repeated until then: that is where the arm has rested.

        Raises:
            SettingsError: There is nothing to repeat, or there is no room for so many.
        """
        end, count = int(self._ints[_END]), len(targets_rad)
        if first < 0 or not count or (first and not end):
            raise SettingsError(f"{count} targets from number {first} on do not go on from the {end} that are there")
        if count > RING // 2:
            raise SettingsError(f"{count} targets do not fit: {RING // 2} is the most at once")
        if first > end:
            between = np.arange(max(end, first - RING // 2), first)
            self._targets[between % RING] = self._targets[(end - 1) % RING].copy()
            self._ints[_END] = first  # the arm rests there, and not where the ring is written next
        self._targets[np.arange(first, first + count) % RING] = targets_rad
        self._ints[_END] = first + count

    def stop(self) -> None:
        """Ask for a stop: the arm comes to rest, and its program ends."""
        self._ints[_STOP] = 1

    # Written by the arm's process.

    def note_process(self, pid: int) -> None:
        """The process has begun."""
        self._ints[_PROCESS] = pid

    def note_sent(self, period: int, index: float, at_s: float, late_s: float, target_rad: Array) -> None:
        """A target was sent."""
        count = int(self._ints[_SENT])
        row = self._sent[count % RING]
        row[:4] = period, index, at_s, late_s
        row[4:] = target_rad
        self._ints[_SENT] = count + 1

    def note_skipped(self, count: int) -> None:
        """So many control periods got no target, because their time had passed."""
        self._ints[_SKIPPED] += count

    def note_state(self, status: ArmStatus) -> None:
        """The controller has told its state."""
        count = int(self._ints[_STATES])
        self._states[count % RING] = status.row()
        self._ints[_STATES] = count + 1

    def beat(self, now_s: float) -> None:
        """The process lives."""
        self._floats[_BEAT_S] = now_s

    def note_first(self, at_s: float) -> None:
        """When the first target is to be sent."""
        self._floats[_FIRST_S] = at_s

    def enter(self, phase: Phase, text: str = "") -> None:
        """Go on to another phase, and say why; never back to one before."""
        if phase > self._ints[_PHASE]:
            if text:
                self._block.set_text("text", text)
            self._ints[_PHASE] = phase

    # Read by all.

    @property
    def phase(self) -> Phase:
        """What the arm's process does."""
        return Phase(int(self._ints[_PHASE]))

    @property
    def text(self) -> str:
        """Why the last phase was entered."""
        return self._block.text("text")

    @property
    def beat_s(self) -> float:
        """When the process last showed that it lives; 0: not yet."""
        return float(self._floats[_BEAT_S])

    @property
    def first_s(self) -> float:
        """When the first target is to be sent; 0: that is not known yet."""
        return float(self._floats[_FIRST_S])

    @property
    def process(self) -> int:
        """Its number; 0: it has not begun yet."""
        return int(self._ints[_PROCESS])

    @property
    def stop_asked(self) -> bool:
        """Whether a stop was asked for."""
        return bool(self._ints[_STOP])

    @property
    def end(self) -> int:
        """Number behind the last target."""
        return int(self._ints[_END])

    @property
    def sent_count(self) -> int:
        """How many targets were sent."""
        return int(self._ints[_SENT])

    @property
    def state_count(self) -> int:
        """How many states were told."""
        return int(self._ints[_STATES])

    @property
    def skipped(self) -> int:
        """Control periods without a target, because their time had passed."""
        return int(self._ints[_SKIPPED])

    def target(self, index: float) -> Array:
        """The target at a number, (6,); between two, on a smooth way through them; beyond either end, the one there.

        Raises:
            SettingsError: There are none.
        """
        for _ in range(_AGAIN):
            end = self.end
            target = self._target(index, end - 1)
            if end == self.end:
                break
            # Targets far behind a pause may have been written over it meanwhile.
        return target

    def _target(self, index: float, last: int) -> Array:
        if last < 0:
            raise SettingsError("there are no targets")
        index = max(index, 0.0)
        below = int(index)
        share = index - below
        if share == 0.0 or below >= last:
            target: Array = self._targets[min(below, last) % RING].copy()
            return target
        numbers = np.clip(np.arange(below - 1, below + 3), 0, last)
        before, start, stop, after = self._targets[numbers % RING]
        return interpolate(before, start, stop, after, share)

    def sent(self, since: int = 0) -> tuple[Sent, int]:
        """What was sent from number `since` on, as far as it is kept, and the number that comes next."""
        count = self.sent_count
        rows = self._sent[np.arange(max(since, count - RING + 1, 0), count) % RING]
        return Sent(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:]), count

    def states(self, since: int = 0) -> tuple[Array, int]:
        """States from number `since` on, rows of `ArmStatus.row`, as far as they are kept; and the next number."""
        count = int(self._ints[_STATES])
        return self._states[np.arange(max(since, count - RING + 1, 0), count) % RING], count

    @property
    def status(self) -> ArmStatus | None:
        """The newest state; None: none has come yet."""
        count = int(self._ints[_STATES])
        return ArmStatus.from_row(self._states[(count - 1) % RING]) if count else None

    def close(self) -> None:
        """Let go of the memory. May be called twice."""
        self._block.close()
        self._view()
