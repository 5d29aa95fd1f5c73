"""Keeps two arms in step although their controllers' clocks do not go alike."""

from __future__ import annotations

from typing import Final

APART_S: Final = 0.002
"""How far a controller's time may be off before its targets are shifted. Estimates of its clock scatter by less."""

_BACK_S: Final = 0.0005  # how far it is off then
_PER_PERIOD: Final = 1e-3  # by which share of a period a target is shifted in a period: no speed changes by more


class Drift:
    """By how many control periods an arm's targets are shifted, so that they keep to the time of this machine.

    The clocks of two controllers drift apart by some milliseconds in a minute. Where they are less than `APART_S` off,
    nothing is shifted, and an arm is sent its targets bit for bit.

    Args:
        tick_s: The control period.
        offset_s: This machine's clock minus the controller's, as it was at the beginning.
    """

    def __init__(self, tick_s: float, offset_s: float) -> None:
        self._tick_s, self._offset_s = tick_s, offset_s
        self._shift = 0.0
        self._shifting = False

    def __call__(self, offset_s: float, periods: int = 1) -> float:
        """The shift in control periods.

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
