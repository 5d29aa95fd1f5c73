"""Memory that all processes of a cell share: how fast time passes, what is expected of the policy, and a fault."""

from __future__ import annotations

from dataclasses import astuple
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import LinkError
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.processes.shared_memory import Layout, SharedBlock

_TEXT: Final = 2048
_SCALINGS: Final = 4  # kept, so that one is whole while the next is written
_TRIES: Final = 1000
_SEQUENCE, _FAULT, _LIVE, _CLOSING, _READY, _REDUCED = range(6)
_SUPERVISOR_S, _FRESH, _BEGIN_S = range(3)
_LAYOUT: Final[Layout] = {
    "ints": (np.int64, (8,)),
    "floats": (np.float64, (8,)),
    "scalings": (np.float64, (_SCALINGS, 7)),
    "text": (np.uint8, (_TEXT,)),
}


class CellMemory:
    """The memory of a cell.

    Args:
        name: Of memory that exists; None: it is made, and belongs to this object.

    Attributes:
        name: By which another process finds it.
    """

    def __init__(self, name: str | None = None) -> None:
        self._block = SharedBlock(_LAYOUT, name)
        self.name = self._block.name
        self._view()
        if name is None:
            self.set_time_scaling(TimeScaling())

    def _view(self) -> None:
        self._ints: NDArray[np.int64] = self._block["ints"]
        self._floats: NDArray[np.float64] = self._block["floats"]
        self._scalings: NDArray[np.float64] = self._block["scalings"]

    # Written by the program.

    def permit_reduced_mode(self) -> None:
        """Arms may go on in reduced mode."""
        self._ints[_REDUCED] = 1

    def begin(self, at_s: float) -> None:
        """Control period 0 begins at this time of the monotonic clock."""
        self._floats[_BEGIN_S] = at_s

    def expect(self, fresh: float, *, live: bool) -> None:
        """Targets up to number `fresh` are the policy's; `live`: it owes those that follow."""
        if live:  # else whoever has just seen that it was would take a wrong number for it
            self._floats[_FRESH] = fresh
        self._ints[_LIVE] = live

    def end(self) -> None:
        """From now on arms that stop are no fault, and the supervisor ends with them."""
        self._ints[_CLOSING] = 1

    # Written by the supervisor.

    def enter_ready(self) -> None:
        """The supervisor sees both arms."""
        self._ints[_READY] = 1

    def set_time_scaling(self, scaling: TimeScaling) -> None:
        """From a control period on that is still to come, time passes like this."""
        following = int(self._ints[_SEQUENCE]) + 1
        self._scalings[following % _SCALINGS] = astuple(scaling)
        self._ints[_SEQUENCE] = following

    def note_supervisor(self, now_s: float) -> None:
        """The supervisor lives."""
        self._floats[_SUPERVISOR_S] = now_s

    # Written by whoever is first.

    def enter_fault(self, reason: str) -> None:
        """Both arms are to stop for good. The first reason stays."""
        if not self._ints[_FAULT]:
            self._block.set_text("text", reason)
            self._ints[_FAULT] = 1

    # Read by all.

    @property
    def time_scaling(self) -> TimeScaling:
        """How time passes.

        Raises:
            LinkError: It is written faster than it can be read.
        """
        for _ in range(_TRIES):
            before = int(self._ints[_SEQUENCE])
            values = self._scalings[before % _SCALINGS].tolist()
            # A reader may stand still for long: the row is whole as long as nobody has begun to write it again.
            if int(self._ints[_SEQUENCE]) - before < _SCALINGS - 1:
                return TimeScaling(*values)
        raise LinkError("how fast time passes is written faster than it can be read: look at what writes it")

    @property
    def begin_s(self) -> float:
        """When control period 0 begins; 0: not yet."""
        return float(self._floats[_BEGIN_S])

    @property
    def supervisor_beat_s(self) -> float:
        """When the supervisor last showed that it lives; 0: not yet."""
        return float(self._floats[_SUPERVISOR_S])

    @property
    def ready(self) -> bool:
        """Whether the supervisor sees both arms."""
        return bool(self._ints[_READY])

    @property
    def ending(self) -> bool:
        """Whether the program is about to end in order."""
        return bool(self._ints[_CLOSING])

    @property
    def allow_reduced(self) -> bool:
        """Whether arms may go on in reduced mode."""
        return bool(self._ints[_REDUCED])

    @property
    def fresh(self) -> float:
        """Number behind the last target that the policy gave."""
        return float(self._floats[_FRESH])

    @property
    def live(self) -> bool:
        """Whether the policy owes targets."""
        return bool(self._ints[_LIVE])

    @property
    def fault(self) -> str:
        """Why both arms were stopped for good; "": they were not."""
        return self._block.text("text") if self._ints[_FAULT] else ""

    def close(self) -> None:
        """Let go of the memory. May be called twice."""
        self._block.close()
        self._view()
