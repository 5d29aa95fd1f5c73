"""Memory shared by all processes of a cell: time scaling, deadline of the policy, and fault."""

from __future__ import annotations

from dataclasses import astuple
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import LinkError
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from ur_core.processes.shared_memory import Layout, SharedBlock

_TEXT: Final = 2048
_SCALINGS: Final = 4  # kept, so that readers find a complete one while the next is written
_TRIES: Final = 1000
_REASONS: Final = tuple(f"reason {number}" for number in range(16))  # more than writers at the same time
_SEQUENCE, _FAULT, _LIVE, _CLOSING, _READY, _REDUCED, _SUPERVISOR, _BEGUN, _TAKEN, _COUPLED = range(10)
_SUPERVISOR_S, _FRESH, _BEGIN_S, _PROXIMITY = range(4)
_LAYOUT: Final[Layout] = {
    "ints": (np.int64, (16,)),
    "floats": (np.float64, (8,)),
    "scalings": (np.float64, (_SCALINGS, 7)),
    **dict.fromkeys(_REASONS, (np.uint8, (_TEXT,))),
}


class CellMemory:
    """Memory of a cell.

    Args:
        name: Name of existing memory; None: create it.

    Attributes:
        name: Name by which another process opens it.
    """

    def __init__(self, name: str | None = None) -> None:
        self._block = SharedBlock(_LAYOUT, name)
        self.name = self._block.name
        self._view()
        self._read = -1, TimeScaling()  # number of the time scaling that was read last, and itself
        if name is None:
            self.set_time_scaling(TimeScaling())
            self.limit_scaling(1.0)

    def _view(self) -> None:
        self._ints = self._block.counters("ints")
        # A view of memory: reading one number of an array takes three times as long.
        self._floats: memoryview[float] = memoryview(self._block["floats"])
        self._scalings: NDArray[np.float64] = self._block["scalings"]

    # Written by the program.

    def permit_reduced_mode(self) -> None:
        """Let arms continue in reduced mode."""
        self._ints[_REDUCED] = 1

    def begin(self, at_s: float) -> None:
        """Set the start of control period 0 on the monotonic clock."""
        self._floats[_BEGIN_S] = at_s
        self._ints[_BEGUN] = 1

    def expect(self, fresh: float, *, live: bool) -> None:
        """Set the number after the policy's last target; `live`: the policy owes the following ones."""
        if live:  # else a reader that has just seen `live` would take a wrong number for it
            self._floats[_FRESH] = fresh
        self._ints[_LIVE] = live

    def couple(self, coupled: bool) -> None:
        """Set whether both arms hold one object between them."""
        self._ints[_COUPLED] = coupled

    def limit_scaling(self, most: float) -> None:
        """Set the largest time scaling at the distances ahead."""
        self._floats[_PROXIMITY] = most

    def end(self) -> None:
        """Announce the end of the program: arms that stop from now on are no fault."""
        self._ints[_CLOSING] = 1

    # Written by the supervisor.

    def enter_ready(self, pid: int = 0) -> None:
        """Report that the supervisor receives the states of both arms, and its process id."""
        self._ints[_SUPERVISOR] = pid
        self._ints[_READY] = 1

    def set_time_scaling(self, scaling: TimeScaling) -> None:
        """Publish a time scaling that begins in a future control period."""
        following = self._ints[_SEQUENCE] + 1
        self._scalings[following % _SCALINGS] = astuple(scaling)
        self._ints[_SEQUENCE] = following

    def note_supervisor(self, now_s: float) -> None:
        """Record a sign of life of the supervisor."""
        self._floats[_SUPERVISOR_S] = now_s

    # Written by whichever process is first.

    def enter_fault(self, reason: str) -> None:
        """Request a latched stop of both arms. The first reason is kept, whole.

        Each writer takes a text of its own; the first to have written one makes it the fault.
        """
        if self._ints[_FAULT]:
            return
        taken = self._ints[_TAKEN]
        while not self._ints.swap(_TAKEN, taken, taken + 1):
            taken = self._ints[_TAKEN]
        number = min(taken, len(_REASONS) - 1)  # a fault is never lost, even if its text might be
        self._block.set_text(_REASONS[number], reason)
        self._ints.swap(_FAULT, 0, 1 + number)

    # Read by all.

    @property
    def time_scaling(self) -> TimeScaling:
        """Current time scaling.

        Raises:
            LinkError: It is written faster than it can be read.
        """
        for _ in range(_TRIES):
            before = self._ints[_SEQUENCE]
            if before == self._read[0]:
                return self._read[1]
            values = self._scalings[before % _SCALINGS].tolist()
            # A reader may stall for long: the row is complete until its next write begins.
            if self._ints[_SEQUENCE] - before < _SCALINGS - 1:
                self._read = before, TimeScaling(*values)
                return self._read[1]
        raise LinkError("the time scaling is written faster than it can be read: check what writes it")

    @property
    def largest_scaling(self) -> float:
        """Largest time scaling at the distances ahead."""
        return self._floats[_PROXIMITY]

    @property
    def begin_s(self) -> float:
        """Start of control period 0; 0: not set yet."""
        return self._floats[_BEGIN_S] if self._ints[_BEGUN] else 0.0

    @property
    def supervisor_beat_s(self) -> float:
        """Time of the supervisor's last sign of life; 0: none yet."""
        return self._floats[_SUPERVISOR_S]

    @property
    def supervisor(self) -> int:
        """Process id of the supervisor; 0: unknown."""
        return self._ints[_SUPERVISOR]

    @property
    def ready(self) -> bool:
        """True once the supervisor receives the states of both arms."""
        return bool(self._ints[_READY])

    @property
    def ending(self) -> bool:
        """True once the program announced its end."""
        return bool(self._ints[_CLOSING])

    @property
    def allow_reduced(self) -> bool:
        """True if arms may continue in reduced mode."""
        return bool(self._ints[_REDUCED])

    @property
    def coupled(self) -> bool:
        """True while both arms hold one object between them."""
        return bool(self._ints[_COUPLED])

    @property
    def fresh(self) -> float:
        """Number after that of the policy's last target."""
        return self._floats[_FRESH]

    @property
    def live(self) -> bool:
        """True while the policy owes targets."""
        return bool(self._ints[_LIVE])

    @property
    def fault(self) -> str:
        """Reason of the latched stop; "": there is none."""
        number = self._ints[_FAULT]
        return self._block.text(_REASONS[number - 1]) if number else ""

    def close(self) -> None:
        """Release the memory. May be called twice."""
        self._block.close()
        self._view()
