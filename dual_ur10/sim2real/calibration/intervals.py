"""Confidence intervals of a pose whose noise was estimated from the same residuals."""

from __future__ import annotations

import importlib
import math
from functools import cached_property
from typing import Any, Final

import numpy as np

from dual_ur10.errors import MissingExtraError
from ur_core.types import Array

LEVEL: Final = 0.95
"""Confidence of all stated intervals."""


def scipy_module(name: str) -> Any:
    """Return a module of scipy. It is imported late, because that takes a second.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        return importlib.import_module(f"scipy.{name}")
    except ImportError:
        raise MissingExtraError("scipy", "calibration", "a calibration") from None


class PoseInterval:
    """Intervals of a pose with a covariance, right for few observations, too.

    Attributes:
        covariance: (6, 6) of its shift (m) and its rotation (rad).
        degrees_of_freedom: Of the noise's scale.
    """

    covariance: Array
    degrees_of_freedom: int

    @cached_property
    def half_widths(self) -> Array:
        """(6,) half widths of the 95 % interval of each component: three of position (m), three of rotation (rad)."""
        quantile = scipy_module("stats").t.ppf(0.5 + LEVEL / 2, self.degrees_of_freedom)
        widths: Array = quantile * np.sqrt(np.diag(self.covariance))
        return widths

    @cached_property
    def position_bound_m(self) -> float:
        """Radius of a ball that holds the 95 % region of the position."""
        return self._bound(slice(0, 3))

    @cached_property
    def rotation_bound_rad(self) -> float:
        """Radius of a ball that holds the 95 % region of the rotation vector."""
        return self._bound(slice(3, 6))

    def _bound(self, part: slice) -> float:
        largest = float(np.linalg.eigvalsh(self.covariance[part, part])[-1])
        return math.sqrt(3 * scipy_module("stats").f.ppf(LEVEL, 3, self.degrees_of_freedom) * largest)
