"""By how much one motion is behind another: the peak of their cross-correlation."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.analysis.series import Value, none
from dual_ur10.types import Array

MOST_S: Final = 0.5
"""Largest lag that is looked for: shorter than half a period of the slowest sine that the tasks know by default."""

STILL_RAD: Final = 1e-3
"""An arm none of whose joints moves farther stands still: noise has a peak, too."""

LEAST_CORRELATION: Final = 0.7
"""Below it, two motions are not one motion at two times."""

_LEAST_SAMPLES: Final = 24


def lag(late: Array, early: Array, step_s: float) -> Value:
    """Time by which `late` is behind `early`, by a parabola through the peak and its neighbours.

    Args:
        late: (k, d) signals, `step_s` apart.
        early: (k, d) the same motion.
        step_s: Time between two samples.

    Returns:
        In s; negative if `late` comes first. None if there is too little motion to tell.
    """
    count = len(early)
    if count < _LEAST_SAMPLES:
        return none(f"too short: {count} samples, {_LEAST_SAMPLES} are needed")
    for values in (late, early):
        moved = float(np.ptp(values, axis=0).max())
        if moved < STILL_RAD:
            return none(f"the arm stood still: no joint moved by more than {moved:.1g} rad")
    most = min(round(MOST_S / step_s), count // 4)
    # Each signal is moved against the other in turn: the ends then count alike on both sides.
    values = (_moved(late, early, most) + _moved(early, late, most)[::-1]) / 2
    peak = int(values.argmax())
    if values[peak] < LEAST_CORRELATION:
        return none(f"the motions are not alike: their correlation is {values[peak]:.2f} at most")
    if peak in (0, 2 * most):
        return none(f"the correlation has no peak within {most * step_s:.2g} s")
    before, top, after = values[peak - 1 : peak + 2]
    bend = before - 2 * top + after
    return Value(float((peak - most + (0.5 * (before - after) / bend if bend < 0 else 0.0)) * step_s))


def _moved(moved: Array, still: Array, most: int) -> Array:
    """(2 most + 1,) correlation of the middle of one signal with the other, moved by -most to most samples."""
    core = still[most : len(still) - most]
    core = core - core.mean(axis=0)
    result = np.zeros(2 * most + 1)
    for k in range(2 * most + 1):
        window = moved[k : k + len(core)]
        window = window - window.mean(axis=0)
        scale = float(np.linalg.norm(core) * np.linalg.norm(window))
        result[k] = float((core * window).sum()) / scale if scale > 0 else 0.0
    return result
