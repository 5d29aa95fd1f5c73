"""A controller's clock as seen from this machine: estimated period starts, and compensation of the drift."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from ur_core.errors import LinkError

WINDOW_S: Final = 2.0
"""Time for which the quickest packet decides: among so many, some packet arrives without delay."""

SLEW: Final = 5e-4
"""Largest change of a settled estimate per second: clocks of computers drift by at most 1e-4."""

_SETTLED: Final = 25  # packets, at least
_AGREEING: Final = 3  # packets that are equally quick: not by chance, so no better ones are awaited
_AGREE_S: Final = 0.0005
_JUMP_S: Final = 1.0  # no clock drifts so far between two packets


class ControllerClock:
    """Estimator of the offset of a controller's clock, from the arrival times of its packets.

    A packet may be late and cannot be early. So the offset is that of the quickest packets of the last seconds. The
    latency that all packets share cannot be observed, and is part of the estimate.

    Args:
        tick_s: Control period of the controller.
        round_trip_s: Round-trip time of a request. A target that is sent so much earlier arrives in time: one half
            is in the estimate, and the other half is the latency of the target.
    """

    def __init__(self, tick_s: float, round_trip_s: float = 0.0) -> None:
        self.tick_s, self.round_trip_s = tick_s, round_trip_s
        self._offsets: deque[tuple[float, float]] = deque()  # arrival and offset, offsets rising: the first is least
        self._offset_s = math.nan
        self._last: tuple[float, float] | None = None
        self._count = 0
        self._quickest: list[float] = []
        self._first_arrival_s = math.nan
        self._listened_s = 0.0
        self._first_s: float | None = None

    @property
    def is_settled(self) -> bool:
        """True once the packets suffice for a useful estimate.

        On a busy machine that takes more packets: arms that start with a wrong estimate are out of step at first.
        """
        agree = len(self._quickest) == _AGREEING and self._quickest[-1] - self._quickest[0] < _AGREE_S
        return self._count >= _SETTLED and (agree or self._listened_s > WINDOW_S)

    @property
    def offset_s(self) -> float:
        """This machine's clock minus the controller's; NaN before the first packet."""
        return self._offset_s

    def note(self, timestamp_s: float, arrival_s: float) -> None:
        """Add the arrival of a packet of the controller's time `timestamp_s`.

        Raises:
            LinkError: The controller's clock jumped: it was restarted.
        """
        offset = arrival_s - timestamp_s
        before = self._last
        self._last = (timestamp_s, arrival_s)
        if before is not None and (timestamp_s < before[0] or offset < self._offset_s - _JUMP_S):
            raise LinkError(
                f"the controller's clock went from {before[0]:.3f} to {timestamp_s:.3f} s within "
                f"{arrival_s - before[1]:.3f} s: it was restarted; connect again"
            )
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((arrival_s, offset))
        while self._offsets[0][0] < arrival_s - WINDOW_S:
            self._offsets.popleft()
        least = self._offsets[0][1]
        if before is None or arrival_s > before[1]:
            self._count += 1  # packets that waited to be read together count as one
            if not self.is_settled:
                self._quickest = sorted([*self._quickest, offset])[:_AGREEING]
        if self._first_s is None:
            self._first_s, self._first_arrival_s = timestamp_s, arrival_s
        self._listened_s = arrival_s - self._first_arrival_s
        if before is None or not self.is_settled:
            self._offset_s = least
            return
        most = SLEW * (arrival_s - before[1])
        self._offset_s += min(max(least - self._offset_s, -most), most)

    def next_period(self, now_s: float, phase: float) -> tuple[int, float]:
        """Return the next control period that a packet sent now reaches before `phase`.

        Args:
            now_s: This machine's clock.
            phase: Fraction of the period, 0 to 1, at which a target is to arrive.

        Returns:
            The period's number, counted from that of the first packet, and the time to send, by this machine's clock.

        Raises:
            LinkError: There was no packet yet.
        """
        number = math.floor((now_s + self.round_trip_s - self._origin()) / self.tick_s)
        at = self.moment(number, phase)
        while at <= now_s:  # twice, where rounding put the present a period back
            number, at = number + 1, self.moment(number + 1, phase)
        return number, at

    def moment(self, number: int, phase: float) -> float:
        """Return the time to send a target that is to arrive at `phase` of a control period, by this machine's clock.

        Raises:
            LinkError: There was no packet yet.
        """
        return self._origin() + (number + phase) * self.tick_s - self.round_trip_s

    def _origin(self) -> float:
        """Beginning of period 0, that of the first packet, by this machine's clock."""
        if self._first_s is None:
            raise LinkError("the controller's clock is unknown before its first packet: wait for it")
        return self._first_s + self._offset_s


APART_S: Final = 0.002
"""Clock error below which targets are not shifted. Estimates of a controller's clock scatter by less."""

_BACK_S: Final = 0.0005  # clock error at which a shift that has begun ends
_PER_PERIOD: Final = 1e-3  # largest shift per period, in periods: no speed changes by a larger fraction


class DriftCompensation:
    """Shift of an arm's targets, in control periods, that keeps them on this machine's time.

    The clocks of two controllers drift apart by some milliseconds in a minute. While the error is below `APART_S`,
    nothing is shifted and the arm receives its targets bit for bit.

    Args:
        tick_s: Control period.
        offset_s: This machine's clock minus the controller's at the beginning.
    """

    def __init__(self, tick_s: float, offset_s: float) -> None:
        self._tick_s, self._offset_s = tick_s, offset_s
        self._shift = 0.0
        self._shifting = False

    def __call__(self, offset_s: float, periods: int = 1) -> float:
        """Return the shift in control periods.

        Args:
            offset_s: This machine's clock minus the controller's, now.
            periods: Control periods since the last call.
        """
        off = (offset_s - self._offset_s) / self._tick_s - self._shift
        limit = (_BACK_S if self._shifting else APART_S) / self._tick_s
        self._shifting = abs(off) > limit
        if self._shifting:
            most = _PER_PERIOD * periods
            self._shift += min(max(off, -most), most)
        return self._shift
