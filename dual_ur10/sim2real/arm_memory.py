"""Memory that an arm's process shares with the program whose policy moves it.

Targets go one way and what happened to them the other, without locks: each number has one writer, and a counter is
written after what it counts.
"""

from __future__ import annotations

from enum import IntEnum
from multiprocessing.shared_memory import SharedMemory
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError

Array = NDArray[np.float64]

RING: Final = 1024
"""Targets that are kept: eight seconds at 125 Hz, two at 500 Hz."""

_TEXT: Final = 1024
_WRITTEN, _SENT, _PHASE, _STOP, _SKIPPED, _BEGUN = range(6)
_INTS: Final = 16
_FLOATS: Final = 16
_BEGIN_S = 0


class Phase(IntEnum):
    """What an arm's process does. It only ever goes up."""

    STARTING = 0
    READY = 1
    STREAMING = 2
    STOPPING = 3
    STOPPED = 4
    FAULTED = 5


class ArmMemory:
    """The memory of one arm.

    Args:
        name: Of memory that exists; None: it is made, and belongs to this object.

    Attributes:
        name: By which another process finds it.
    """

    def __init__(self, name: str | None = None) -> None:
        size = 8 * (_INTS + _FLOATS + RING * 8) + _TEXT
        self._owner = name is None
        self._memory: SharedMemory | None = SharedMemory(name, create=self._owner, size=size)
        self.name = self._memory.name
        buffer = self._memory.buf
        if buffer is None or len(buffer) < size:
            raise SettingsError(f"shared memory {self.name} is no arm's: it is too small")
        self._ints: NDArray[np.int64] = np.frombuffer(buffer, np.int64, _INTS)
        at = 8 * _INTS
        self._floats: Array = np.frombuffer(buffer, np.float64, _FLOATS, at)
        at += 8 * _FLOATS
        self._targets: Array = np.frombuffer(buffer, np.float64, RING * 6, at).reshape(RING, 6)
        at += 8 * RING * 6
        self._sent_s: Array = np.frombuffer(buffer, np.float64, RING, at)
        at += 8 * RING
        self._lateness_s: Array = np.frombuffer(buffer, np.float64, RING, at)
        at += 8 * RING
        self._text: NDArray[np.uint8] = np.frombuffer(buffer, np.uint8, _TEXT, at)

    # Written by the program.

    def put(self, targets_rad: Array) -> None:
        """Add targets, (ticks, 6), behind those that are there.

        Raises:
            SettingsError: There is no room: they would take the place of some that have not been sent.
        """
        written, count = int(self._ints[_WRITTEN]), len(targets_rad)
        if written + count - int(self._ints[_SENT]) > RING:
            raise SettingsError(f"{count} targets do not fit: {RING} are kept, and those before have not been sent yet")
        self._targets[np.arange(written, written + count) % RING] = targets_rad
        self._ints[_WRITTEN] = written + count

    def begin(self, at_s: float) -> None:
        """Let target 0 be sent in the first control period after this time of the monotonic clock."""
        self._floats[_BEGIN_S] = at_s
        self._ints[_BEGUN] = 1

    def stop(self) -> None:
        """Ask for a stop: the arm comes to rest, and its program ends."""
        self._ints[_STOP] = 1

    # Written by the arm's process.

    def note_sent(self, tick: int, at_s: float, lateness_s: float) -> None:
        """A target was sent."""
        self._sent_s[tick % RING], self._lateness_s[tick % RING] = at_s, lateness_s
        self._ints[_SENT] = tick + 1

    def note_skipped(self, count: int) -> None:
        """So many targets were not sent, because their time had passed."""
        self._ints[_SKIPPED] += count

    def enter(self, phase: Phase, text: str = "") -> None:
        """Go on to another phase, and say why; never back to one before."""
        if phase > self._ints[_PHASE]:
            if text:
                line = text.encode()[: _TEXT - 1]
                self._text[: len(line)] = np.frombuffer(line, np.uint8)
                self._text[len(line)] = 0
            self._ints[_PHASE] = phase

    # Read by both.

    @property
    def phase(self) -> Phase:
        """What the arm's process does."""
        return Phase(int(self._ints[_PHASE]))

    @property
    def text(self) -> str:
        """Why the last phase was entered."""
        line = self._text.tobytes()
        return line[: line.index(0)].decode("utf-8", "replace") if 0 in line else ""

    @property
    def begin_s(self) -> float | None:
        """When target 0 is to be sent; None: not yet."""
        return float(self._floats[_BEGIN_S]) if self._ints[_BEGUN] else None

    @property
    def stop_asked(self) -> bool:
        """Whether a stop was asked for."""
        return bool(self._ints[_STOP])

    @property
    def written(self) -> int:
        """Targets that were put here."""
        return int(self._ints[_WRITTEN])

    @property
    def sent(self) -> int:
        """Number of the next target to be sent."""
        return int(self._ints[_SENT])

    @property
    def skipped(self) -> int:
        """Targets that were not sent, because their time had passed."""
        return int(self._ints[_SKIPPED])

    def target(self, tick: int) -> Array:
        """A target, (6,)."""
        target: Array = self._targets[tick % RING].copy()
        return target

    def timing(self) -> tuple[Array, Array]:
        """When the last targets were sent, and by how much too late, oldest first; at most `RING`."""
        sent = self.sent
        ticks = np.arange(max(0, sent - RING), sent) % RING
        return self._sent_s[ticks].copy(), self._lateness_s[ticks].copy()

    def close(self) -> None:
        """Let go of the memory; who made it removes it. May be called twice."""
        memory, self._memory = self._memory, None
        if memory is None:
            return
        self._ints, self._floats = np.zeros(_INTS, np.int64), np.zeros(_FLOATS)
        self._targets, self._sent_s, self._lateness_s = np.zeros((RING, 6)), np.zeros(RING), np.zeros(RING)
        self._text = np.zeros(_TEXT, np.uint8)
        memory.close()
        if self._owner:
            memory.unlink()
