"""Packets of a cell in real time: those that a busy machine delivers early or late are allowed."""

import time

import numpy as np

from tests.virtual.faults import wire
from tests.virtual.faults.wire import ViolationError, demand

SPARE_TICKS = 2  # for packets in transit
_EARLY_S = 0.004  # by which a package may come early or late; less than a control period of a CB3
_ARRIVED_S = 0.5  # until what was noted as sent has come, however busy the machine is
_ON_THE_WAY = 4  # packages that a controller whose program ends does not take
_NEAR = 25  # packages that are compared with each other
_IN_STEP = 0.6  # of the packages come in the control period that they are for
_BUSY = "this machine is too busy"


class Wire(wire.Wire):
    """See `tests.virtual.faults.wire.Wire`."""

    def arrived(self, noted):
        """Return the number of noted targets that have come."""
        end = time.monotonic() + _ARRIVED_S
        while len(self.packages()[0]) < len(noted) and time.monotonic() < end:
            time.sleep(0.01)
        came = len(self.packages()[0])
        demand(len(noted) - came <= _ON_THE_WAY, f"{self.arm}: {len(noted)} targets were noted as sent, {came} came")
        return min(came, len(noted))

    def assert_in_step(self, offset, tick_s):
        """Check that most targets came in the control periods for which they were sent."""
        if not len(offset) or tick_s <= _EARLY_S:  # at 500 Hz no machine of this kind keeps step
            return
        # After a stall a controller's periods are offset for a while.
        late = [each - np.median(each) for each in np.array_split(offset, -(-len(offset) // _NEAR))]
        share = float((np.abs(np.concatenate(late)) * tick_s <= _EARLY_S).mean())
        assert share >= _IN_STEP, f"{self.arm}: {share:.2f} of the targets came in their periods: {_BUSY}"

    def assert_rested(self, tick, tick_s):
        """Check that the packets from a control period on stopped the arm."""
        try:
            super().assert_rested(tick, tick_s)
        except ViolationError:
            raise
        except AssertionError as error:
            raise AssertionError(f"{error}, or {_BUSY}") from None
