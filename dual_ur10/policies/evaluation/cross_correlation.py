"""Lag between two recordings of one motion: the peak of their normalised cross-correlation."""

from __future__ import annotations

import math

import numpy as np

from ur_core.types import Array


def cross_correlation(late: Array, early: Array, most: int, *, constant: float = math.nan) -> Array:
    """Return the normalised cross-correlation of two signals at delays of -`most` to `most` samples.

    Args:
        late: (k,) or (k, d) signals, k above 2 `most`.
        early: Signals of the same shape.
        most: Largest delay.
        constant: Result where one of the signals does not change.

    Returns:
        (2 most + 1,).
    """
    # Each signal is shifted against the other once: the ends of the windows then have the same weight on both sides, so
    # that equal signals have their peak exactly at zero.
    return (_moved(late, early, most, constant) + _moved(early, late, most, constant)[::-1]) / 2


def _moved(moved: Array, still: Array, most: int, constant: float) -> Array:
    core = still[most : len(still) - most]
    core = core - core.mean(axis=0)
    size = np.linalg.norm(core)
    result = np.empty(2 * most + 1)
    for k in range(len(result)):
        window = moved[k : k + len(core)]
        window = window - window.mean(axis=0)
        scale = float(size * np.linalg.norm(window))
        result[k] = float((core * window).sum()) / scale if scale > 0 else constant
    return result


def peak_delay(values: Array) -> float:
    """Return the delay of the peak of a cross-correlation in samples, by a parabola through its neighbours."""
    peak = int(np.clip(values.argmax(), 1, len(values) - 2))
    before, top, after = values[peak - 1 : peak + 2]
    bend = before - 2 * top + after
    return float(peak - len(values) // 2 + (0.5 * (before - after) / bend if bend < 0 else 0.0))
