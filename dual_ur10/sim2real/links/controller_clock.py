"""A controller's clock as seen from this machine: estimated period starts, and compensation of the drift."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dual_ur10.errors import LinkError

WINDOW_S: Final = 2.0
"""For how long the quickest packet decides: some packet of so many comes without a wait on its way."""

SLEW: Final = 5e-4
"""By how much the estimate may move per second, once it is settled: clocks of computers drift by at most 1e-4."""

_SETTLED: Final = 25  # packets, at least
_AGREEING: Final = 3  # packets that are as quick as each other: no chance, and so no better ones are waited for
_AGREE_S: Final = 0.0005
_JUMP_S: Final = 1.0  # by which no clock drifts between two packets


class ControllerClock:
    """Estimates the offset of a controller's clock from the times at which its packets arrive.

    A packet may be late and cannot be early. So the offset is that of the quickest packets of the last seconds; what
    the network adds to every packet cannot be seen, and is in the estimate.

    Args:
        tick_s: The controller's period.
        round_trip_s: How long an answer of the controller takes. What is sent so much earlier arrives in time: the
            way of the packets is in the estimate, and the way back is still to come.
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
        """Whether enough packets have come for the estimate to be of use.

        On a busy machine that takes some more of them: arms that begin by a wrong estimate are out of step at first.
        """
        agree = len(self._quickest) == _AGREEING and self._quickest[-1] - self._quickest[0] < _AGREE_S
        return self._count >= _SETTLED and (agree or self._listened_s > WINDOW_S)

    @property
    def offset_s(self) -> float:
        """This machine's clock minus the controller's; NaN before the first packet."""
        return self._offset_s

    def note(self, timestamp_s: float, arrival_s: float) -> None:
        """A packet of the controller's time `timestamp_s` has arrived.

        Raises:
            LinkError: The controller's clock jumped: it was started anew.
        """
        offset = arrival_s - timestamp_s
        before = self._last
        self._last = (timestamp_s, arrival_s)
        if before is not None and (timestamp_s < before[0] or offset < self._offset_s - _JUMP_S):
            raise LinkError(
                f"the controller's clock went from {before[0]:.3f} to {timestamp_s:.3f} s within "
                f"{arrival_s - before[1]:.3f} s: it was started anew; connect again"
            )
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((arrival_s, offset))
        while self._offsets[0][0] < arrival_s - WINDOW_S:
            self._offsets.popleft()
        least = self._offsets[0][1]
        if before is None or arrival_s > before[1]:
            self._count += 1  # those that had waited to be read together are as good as one
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

    def local_s(self, timestamp_s: float) -> float:
        """When the controller's clock shows this time, by this machine's clock."""
        return timestamp_s + self._offset_s

    def next_period(self, now_s: float, share: float) -> tuple[int, float]:
        """The next control period of which `share` will not have passed when something that is sent now arrives.

        Args:
            now_s: This machine's clock.
            share: 0 to 1: where in the period a target is to arrive.

        Returns:
            The period's number, counted from that of the first packet, and when to send, by this machine's clock.

        Raises:
            LinkError: Nothing is known of the controller's clock yet.
        """
        number = math.floor((now_s + self.round_trip_s - self._origin()) / self.tick_s)
        at = self.moment(number, share)
        while at <= now_s:  # twice, where rounding has put the present a period back
            number, at = number + 1, self.moment(number + 1, share)
        return number, at

    def moment(self, number: int, share: float) -> float:
        """When to send what is to arrive as `share` of a control period has passed, by this machine's clock.

        Raises:
            LinkError: Nothing is known of the controller's clock yet.
        """
        return self._origin() + (number + share) * self.tick_s - self.round_trip_s

    def _origin(self) -> float:
        """When period 0 began: that of the first packet."""
        if self._first_s is None:
            raise LinkError("nothing is known of the controller's clock before its first packet: wait for it")
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
