"""Signals over time: interpolation, smoothing, lag and size."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import MissingExtraError
from dual_ur10.policies.evaluation.cross_correlation import cross_correlation, peak_delay
from ur_core.types import Array

MOST_S: Final = 0.5
"""Largest lag of the search: shorter than half a period of the tasks' slowest default sine."""

STILL_RAD: Final = 1e-3
"""Smallest motion of a joint for which a lag is estimated: noise has a correlation peak, too."""

LEAST_CORRELATION: Final = 0.7
"""Smallest correlation at which two signals count as one motion at two times."""

_LEAST_SAMPLES: Final = 24


class Value(NamedTuple):
    """A figure, or the reason why there is none.

    Attributes:
        value: The figure; NaN: none.
        reason: Reason; "" where there is a figure.
    """

    value: float
    reason: str = ""


def none(reason: str) -> Value:
    """Return a missing figure with its reason."""
    return Value(math.nan, reason)


class Magnitudes(NamedTuple):
    """Magnitudes of many numbers: root mean square, 99th percentile and maximum."""

    rms: float
    p99: float
    most: float


NO_MAGNITUDES = Magnitudes(math.nan, math.nan, math.nan)


def spread(values: Array) -> Magnitudes:
    """Return the magnitudes of numbers of any shape; NaN where there are none."""
    sizes = np.abs(values)
    if not sizes.size:
        return NO_MAGNITUDES
    return Magnitudes(float(np.sqrt((sizes * sizes).mean())), float(np.percentile(sizes, 99)), float(sizes.max()))


def lengths(vectors: Array) -> Array:
    """Return the lengths of (..., 3) vectors."""
    result: Array = np.linalg.norm(vectors, axis=-1)
    return result


def interpolate(times_s: Array, values: Array, when_s: Array) -> Array:
    """Interpolate samples by cubics whose slopes at each sample follow from its neighbours.

    Args:
        times_s: (k,) two or more times, strictly rising.
        values: (k, d) samples.
        when_s: (j,) times within `times_s`; outside, the first or last sample.

    Returns:
        (j, d); at a sample's time, the sample exactly.
    """
    try:
        from scipy.interpolate import CubicHermiteSpline
    except ImportError:
        raise MissingExtraError("scipy", "records", "comparing records") from None
    spline = CubicHermiteSpline(times_s, values, np.gradient(values, times_s, axis=0))
    result: Array = spline(np.clip(when_s, times_s[0], times_s[-1]))
    result[when_s >= times_s[-1]] = values[-1]
    return result


def rising(times_s: Array) -> NDArray[np.bool_]:
    """Return the (k,) mask of samples that are later than all before them, so that times strictly rise."""
    before = np.maximum.accumulate(np.concatenate([[-np.inf], times_s[:-1]]))
    result: NDArray[np.bool_] = times_s > before
    return result


def smoothed(values: Array, half: int) -> Array:
    """Return (k - 2 half, d) values of the cubics fitted to each value and `half` neighbours on both sides."""
    if len(values) <= 2 * half:
        return values[:0]
    places: Array = np.arange(-half, half + 1) / max(half, 1)
    weights = np.linalg.pinv(np.vander(places, 4))[-1]
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1, axis=0)
    result: Array = windows @ weights
    return result


def lag(late: Array, early: Array, step_s: float) -> Value:
    """Return the time by which `late` is behind `early`, from the peak of their cross-correlation.

    Args:
        late: (k, d) signals, `step_s` apart.
        early: (k, d) signals of the same motion.
        step_s: Time between two samples.

    Returns:
        Time in s; negative if `late` comes first. No figure if there is too little motion.
    """
    count = len(early)
    if count < _LEAST_SAMPLES:
        return none(f"too short: {count} samples, {_LEAST_SAMPLES} are needed")
    for values in (late, early):
        moved = float(np.ptp(values, axis=0).max())
        if moved < STILL_RAD:
            return none(f"the arm did not move: no joint moved by more than {moved:.1g} rad")
    most = min(round(MOST_S / step_s), count // 4)
    values = cross_correlation(late, early, most, constant=0.0)
    peak = int(values.argmax())
    if values[peak] < LEAST_CORRELATION:
        return none(f"the motions are not alike: their correlation is {values[peak]:.2f} at most")
    if peak in (0, 2 * most):
        return none(f"the correlation has no peak within {most * step_s:.2g} s")
    return Value(peak_delay(values) * step_s)
