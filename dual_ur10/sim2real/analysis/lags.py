"""By how much one motion is behind another: the peak of their cross-correlation."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.policies.evaluation.cross_correlation import cross_correlation, peak_delay
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
    values = cross_correlation(late, early, most, constant=0.0)
    peak = int(values.argmax())
    if values[peak] < LEAST_CORRELATION:
        return none(f"the motions are not alike: their correlation is {values[peak]:.2f} at most")
    if peak in (0, 2 * most):
        return none(f"the correlation has no peak within {most * step_s:.2g} s")
    return Value(peak_delay(values) * step_s)
