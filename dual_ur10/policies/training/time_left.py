"""How long a training by rounds of gathering and fitting takes yet."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


class TimeLeft:
    """Reckons from what gathering and fits have taken so far.

    Args:
        clock: Seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._step_s = self._fit_s = 0.0
        self._fits_since: float | None = None

    def gathered(self, steps: int, seconds: float) -> None:
        """So many steps of this round took so long."""
        self._step_s = seconds / max(1, steps)

    def fit_begins(self) -> None:
        """A fit begins."""
        self._fits_since = self._clock()

    def fit_ends(self) -> None:
        """It has ended, and the look at it, too."""
        if self._fits_since is not None:
            self._fit_s, self._fits_since = self._clock() - self._fits_since, None

    def __call__(self, steps: int, round_steps: float, *, refits: bool) -> float | None:
        """Seconds; None: there was no fit yet.

        Args:
            steps: That are to be gathered yet.
            round_steps: Of a round.
            refits: Whether each round begins with a fit. In any case there is one after the last.
        """
        if not self._fit_s:
            return None
        fits = math.ceil(steps / round_steps) if refits else 0
        if self._fits_since is None:
            return steps * self._step_s + max(1, fits) * self._fit_s
        rest_s = max(0.0, self._fit_s - (self._clock() - self._fits_since))
        return steps * self._step_s + fits * self._fit_s + rest_s
