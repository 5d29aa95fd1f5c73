"""Shared memory of one arm's process with the program, the supervisor and the recorder."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.time_scaling import interpolate
from ur_core.links.arm_status import ROW_SIZE, ArmStatus
from ur_core.processes.shared_memory import Layout, SharedBlock
from ur_core.types import Array

RING: Final = 4096
"""Number of targets, packets and states kept: half a minute at 125 Hz, eight seconds at 500 Hz."""

_TEXT: Final = 1024
_RECENT: Final = 128  # newest targets and states in which one is searched: a quarter of a second at 500 Hz
_RETRIES: Final = 5  # of a read that a write interrupts
_END, _SENT, _PHASE, _STOP, _SKIPPED, _STATES, _PROCESS, _DEAF = range(8)
_BEAT_S, _FIRST_S = range(2)
_LAYOUT: Final[Layout] = {
    "ints": (np.int64, (16,)),
    "floats": (np.float64, (16,)),
    "targets": (np.float64, (RING, 6)),
    "sent": (np.float64, (RING, 10)),
    "states": (np.float64, (RING, ROW_SIZE)),
    "text": (np.uint8, (_TEXT,)),
}

# Plain numbers are packed several times faster than NumPy converts them.
_SENT_ROW: Final = struct.Struct("=10d")
_STATES_ROW: Final = struct.Struct(f"={ROW_SIZE}d")


class Phase(IntEnum):
    """Phase of an arm's process. It only ever increases."""

    STARTING = 0
    READY = 1
    STREAMING = 2
    STOPPING = 3
    STOPPED = 4
    FAULTED = 5


_PHASES: Final = tuple(Phase)


@dataclass(frozen=True)
class Sent:
    """Targets sent, oldest first.

    Attributes:
        period: (k,) control periods since that of the first target.
        index: (k,) target numbers; fractional under time scaling.
        sent_s: (k,) times of sending, on the system's clock.
        late_s: (k,) delays of sending.
        target_rad: (k, 6) targets.
    """

    period: Array
    index: Array
    sent_s: Array
    late_s: Array
    target_rad: Array


class ArmMemory:
    """Memory of one arm.

    Targets are numbered from 0. Those ahead of the one being sent may be overwritten: a motion is written together with
    the brake that ends it, and the next motion overwrites that brake. After the last target the arm rests at it.

    Args:
        name: Name of existing memory; None: create it.

    Attributes:
        name: Name by which another process opens it.
    """

    def __init__(self, name: str | None = None) -> None:
        self._block = SharedBlock(_LAYOUT, name)
        self.name = self._block.name
        self._view()

    def _view(self) -> None:
        self._ints = self._block.counters("ints")
        # A view of memory: reading one number of an array takes three times as long.
        self._floats: memoryview[float] = memoryview(self._block["floats"])
        self._targets: Array = self._block["targets"]
        self._sent: Array = self._block["sent"]
        self._states: Array = self._block["states"]

    # Written by the program.

    def put(self, first: int, targets_rad: Array) -> None:
        """Write targets `first`, `first` + 1, ..., (k, 6); the last of them becomes the end.

        If `first` lies beyond the end, the last target is repeated until then: the arm has rested there.

        Raises:
            SettingsError: There is nothing to repeat, or no room for so many.
        """
        end, count = self._ints[_END], len(targets_rad)
        if first < 0 or not count or (first and not end):
            raise SettingsError(f"{count} targets from number {first} on do not continue the {end} that are there")
        if count > RING // 2:
            raise SettingsError(f"{count} targets do not fit: {RING // 2} is the most at once")
        if first > end:
            gap = np.arange(max(end, first - RING // 2), first)
            self._targets[gap % RING] = self._targets[(end - 1) % RING].copy()
            self._ints[_END] = first  # the arm rests there, and not where the ring is written next
        self._targets[np.arange(first, first + count) % RING] = targets_rad
        self._ints[_END] = first + count

    def stop(self) -> None:
        """Request a stop: the arm stops and its program ends."""
        self._ints[_STOP] = 1

    # Written by the arm's process.

    def note_process(self, pid: int) -> None:
        """Record the id of the process."""
        self._ints[_PROCESS] = pid

    def note_sent(self, period: int, index: float, at_s: float, late_s: float, target_rad: Array) -> None:
        """Record a target sent."""
        count = self._ints[_SENT]
        _SENT_ROW.pack_into(
            self._sent.data.cast("B"), count % RING * _SENT_ROW.size, period, index, at_s, late_s, *target_rad.tolist()
        )
        self._ints[_SENT] = count + 1

    def note_skipped(self, count: int) -> None:
        """Count control periods that got no target because their time had passed."""
        self._ints[_SKIPPED] += count

    def note_state(self, status: ArmStatus) -> None:
        """Record a state of the controller."""
        count = self._ints[_STATES]
        _STATES_ROW.pack_into(self._states.data.cast("B"), count % RING * _STATES_ROW.size, *status.row())
        self._ints[_STATES] = count + 1

    def note_deaf(self) -> None:
        """Record that the controller takes no targets any more, also none of a ramp."""
        self._ints[_DEAF] = 1

    def beat(self, now_s: float) -> None:
        """Record a sign of life of the process."""
        self._floats[_BEAT_S] = now_s

    def note_first(self, at_s: float) -> None:
        """Record the time at which the first target is due."""
        self._floats[_FIRST_S] = at_s

    def enter(self, phase: Phase, text: str = "") -> None:
        """Enter a later phase with its reason; an earlier one is ignored."""
        if phase > self._ints[_PHASE]:
            if text:
                self._block.set_text("text", text)
            self._ints[_PHASE] = phase

    # Read by all.

    @property
    def phase(self) -> Phase:
        """Phase of the arm's process."""
        return _PHASES[self._ints[_PHASE]]

    @property
    def text(self) -> str:
        """Reason of the current phase."""
        return self._block.text("text")

    @property
    def beat_s(self) -> float:
        """Time of the process's last sign of life; 0: none yet."""
        return self._floats[_BEAT_S]

    @property
    def first_s(self) -> float:
        """Time at which the first target is due; 0: unknown yet."""
        return self._floats[_FIRST_S]

    @property
    def process(self) -> int:
        """Process id; 0: it has not started yet."""
        return self._ints[_PROCESS]

    @property
    def deaf(self) -> bool:
        """True once the controller was seen to take no targets any more."""
        return bool(self._ints[_DEAF])

    @property
    def stop_requested(self) -> bool:
        """True once a stop was requested."""
        return bool(self._ints[_STOP])

    @property
    def end(self) -> int:
        """Number after that of the last target."""
        return self._ints[_END]

    @property
    def sent_count(self) -> int:
        """Number of targets sent."""
        return self._ints[_SENT]

    @property
    def state_count(self) -> int:
        """Number of states received."""
        return self._ints[_STATES]

    @property
    def skipped(self) -> int:
        """Control periods without a target because their time had passed."""
        return self._ints[_SKIPPED]

    def target(self, index: float) -> Array:
        """Return the target at a number, (6,): interpolated between two, and the first or last one beyond them.

        Raises:
            SettingsError: There are no targets.
        """
        for _ in range(_RETRIES):
            end = self.end
            target = self._target(index, end - 1)
            if end == self.end:
                break
            # Targets may have been written over a pause meanwhile.
        return target

    def _target(self, index: float, last: int) -> Array:
        if last < 0:
            raise SettingsError("there are no targets")
        index = max(index, 0.0)
        below = int(index)
        fraction = index - below
        if fraction == 0.0 or below >= last:
            target: Array = self._targets[min(below, last) % RING].copy()
            return target
        numbers = np.clip(np.arange(below - 1, below + 3), 0, last)
        before, start, stop, after = self._targets[numbers % RING]
        return interpolate(before, start, stop, after, fraction)

    def sent(self, since: int = 0) -> tuple[Sent, int]:
        """Return the targets sent from number `since` on, as far as they are kept, and the next number."""
        count = self.sent_count
        rows = _kept(self._sent, since, count)
        return Sent(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:]), count

    def states(self, since: int = 0) -> tuple[Array, int]:
        """Return the states from number `since` on, as rows of `ArmStatus.row`, and the next number."""
        count = self._ints[_STATES]
        return _kept(self._states, since, count), count

    def sent_s(self, index: float) -> float | None:
        """Return the time at which the first of the last targets from number `index` on was sent; None: none was."""
        count, found = self.sent_count, None
        for number in range(count - 1, max(count - _RECENT, 0) - 1, -1):
            row = self._sent[number % RING]
            if row[1] < index:
                break
            found = float(row[2])
        return found

    def status_after(self, time_s: float, number: int) -> ArmStatus | None:
        """Return the state that arrived as the `number`-th after a time; None: not so many have arrived."""
        count = self.state_count
        first = count
        while first > max(count - _RECENT, 0) and self._states[(first - 1) % RING, 0] > time_s:
            first -= 1
        wanted = first + number - 1
        return ArmStatus.from_row(self._states[wanted % RING]) if wanted < count else None

    @property
    def status(self) -> ArmStatus | None:
        """Newest state; None: none has come yet."""
        count = self._ints[_STATES]
        return ArmStatus.from_row(self._states[(count - 1) % RING]) if count else None

    @property
    def arrival_s(self) -> float:
        """Arrival of the newest state; -inf: none has come yet."""
        count = self._ints[_STATES]
        return float(self._states[(count - 1) % RING, 0]) if count else -math.inf

    def close(self) -> None:
        """Release the memory. May be called twice."""
        self._block.close()
        self._view()


def _kept(ring: Array, since: int, count: int) -> Array:
    """Return a copy of the rows of a ring from number `since` to `count`, as far as they are kept."""
    since = max(since, count - RING + 1, 0)
    if since >= count:
        return ring[:0].copy()
    first, last = since % RING, (count - 1) % RING + 1
    return ring[first:last].copy() if first < last else np.concatenate([ring[first:], ring[:last]])
