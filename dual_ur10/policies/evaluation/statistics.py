"""What can be said of a rate from a number of trials."""

from __future__ import annotations

import math
from statistics import NormalDist

from dual_ur10.errors import SettingsError


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", Journal of the American
    Statistical Association 22 (1927), pages 209 to 212. It keeps its coverage for few trials and for rates near 0 and
    1, where the interval of the normal approximation shrinks to a point.

    Args:
        successes: Number of successes, 0 to `trials`.
        trials: Number of trials, 0 or more.
        confidence: How often intervals like this one hold the true rate, between 0 and 1.

    Returns:
        The lower and the upper end, both in [0, 1]; (0, 1) without any trial.

    Raises:
        SettingsError: A number is out of its range.
    """
    if not 0 <= successes <= trials:
        raise SettingsError(f"{successes} successes in {trials} trials: there can be from 0 to as many as trials")
    if not 0.0 < confidence < 1.0:
        raise SettingsError(f"confidence is {confidence!r}: it must be between 0 and 1")
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    z = NormalDist().inv_cdf((1.0 + confidence) / 2.0)
    share = z * z / trials
    center = rate + share / 2.0
    half = math.sqrt(share * (rate * (1.0 - rate) + share / 4.0))
    # The interval always holds the rate that was found; rounding must not take it out.
    low = min(rate, max(0.0, (center - half) / (1.0 + share)))
    high = max(rate, min(1.0, (center + half) / (1.0 + share)))
    return (0.0 if successes == 0 else low), (1.0 if successes == trials else high)
