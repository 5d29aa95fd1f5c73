"""Faults that can be injected into the connections of an emulated controller."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Annotated, Final

from pydantic import Field

MAX_LATE_S: Final = 60.0
"""Longest injected delay of packets and programs, which are queued meanwhile."""

_Seconds = Annotated[float, Field(ge=0.0, le=MAX_LATE_S)]
_Count = Annotated[int, Field(ge=0)]


@dataclass
class LinkFaults:
    """Faults of the connections of one port. All are off at first.

    Attributes:
        mute: Nothing is sent.
        frozen: Nothing is read.
        half_open: New connections are accepted, but neither read nor answered.
        delay_s: Delay of all traffic, in both directions.
        jitter_s: Largest additional random delay. Order is kept.
        lose: Number of the next packets of the data stream to lose.
        corrupt: Number of the next packets to change one byte in.
        short, long: Number of the next RTDE packages of the data stream to shorten or lengthen by one byte.
        foreign: Number of them to give the number of another recipe.
    """

    mute: bool = False
    frozen: bool = False
    half_open: bool = False
    delay_s: _Seconds = 0.0
    jitter_s: _Seconds = 0.0
    lose: _Count = 0
    corrupt: _Count = 0
    short: _Count = 0
    long: _Count = 0
    foreign: _Count = 0

    def damage(self, package: bytes) -> bytes:
        """Apply the faults of RTDE packages to one of the data stream."""
        size = int.from_bytes(package[:2], "big")
        if self.short > 0:
            self.short -= 1
            return (size - 1).to_bytes(2, "big") + package[2:-1]
        if self.long > 0:
            self.long -= 1
            return (size + 1).to_bytes(2, "big") + package[2:] + b"\0"
        if self.foreign > 0:
            self.foreign -= 1
            return package[:3] + bytes([package[3] ^ 0xFF]) + package[4:]
        return package


@dataclass
class DelayLine:
    """Delayed bytes, in order, each with its time of arrival and whether it may be dropped."""

    waiting: deque[tuple[float, bytes, bool]] = field(default_factory=deque)
    last_s: float = 0.0

    def put(self, due_s: float, data: bytes, droppable: bool = False) -> None:
        """Queue bytes, which never overtake earlier ones."""
        self.last_s = max(due_s, self.last_s)
        self.waiting.append((self.last_s, data, droppable))

    @property
    def next_s(self) -> float:
        """Arrival time of the next bytes; infinite if there are none."""
        return self.waiting[0][0] if self.waiting else math.inf

    def due(self, now_s: float) -> list[tuple[bytes, bool]]:
        """Remove and return the bytes that have arrived."""
        ready = []
        while self.waiting and self.waiting[0][0] <= now_s:
            _, data, droppable = self.waiting.popleft()
            ready.append((data, droppable))
        return ready
