"""When a controller's states were, on the clock of the run."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.recording.run import ArmLog
from dual_ur10.types import Array

_WINDOW_S: Final = 1.0  # the quickest packet of so long shows how the clocks stand to each other
_LEAST: Final = 25  # samples, of which one is hardly ever all late
_LOST_TICKS: Final = 2.0  # within a window: no quartz is off by that


def times_of(log: ArmLog) -> Array:
    """(j,) when states were, on the run's clock: by the controller's own clock, which no network delays.

    Where that clock stands still for a while, as an emulated controller's does on a machine that stands still, states
    before and behind are each taken by what the clock says there.
    """
    offset_s = _offset(log)
    return log.state["arrival_s"] if offset_s is None else log.state["timestamp_s"] + offset_s


def uneven_s(log: ArmLog, tick_s: float) -> float:
    """By how much a controller's clock and that of the run went apart, where no two quartzes do so; else 0."""
    offset_s = _offset(log)
    if offset_s is None:
        return 0.0
    stamps_s = log.state["timestamp_s"]
    later = np.minimum(np.searchsorted(stamps_s, stamps_s + _WINDOW_S), len(stamps_s) - 1)
    apart = bool((np.abs(offset_s[later] - offset_s) > _LOST_TICKS * tick_s).any())
    return float(np.ptp(offset_s)) if apart else 0.0


def _offset(log: ArmLog) -> Array | None:
    """(j,) what is to be added to the controller's time; None: it tells none that could be used."""
    arrival_s = log.state["arrival_s"]
    stamps_s = log.state.get("timestamp_s")
    if stamps_s is None or len(arrival_s) < 2 or not np.isfinite(stamps_s).all() or (np.diff(stamps_s) <= 0).any():
        return None
    away_s = arrival_s - stamps_s
    count = max(_LEAST, round(_WINDOW_S / float(np.median(np.diff(stamps_s)))))
    # A packet that was delayed is above the quickest of both sides; a clock that jumped is so on one side alone.
    result: Array = np.maximum(_least_of_next(away_s, count), _least_of_next(away_s[::-1], count)[::-1])
    return result


def _least_of_next(values: Array, count: int) -> Array:
    """(k,) the least of each value and the `count` - 1 that follow it; near the end, of the last `_LEAST`."""
    least, width = np.concatenate([values, np.full(count, np.inf)]), 1
    while width < count:  # twice as many with each round
        step = min(width, count - width)
        least, width = np.minimum(least[:-step], least[step:]), width + step
    result: Array = least[: len(values)].copy()
    result[-_LEAST:] = values[-_LEAST:].min()
    return result
