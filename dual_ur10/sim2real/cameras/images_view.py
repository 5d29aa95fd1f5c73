"""View of a recorded run, as the process of a live page reads it: images alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.cameras.camera_memory import newest_images, opened


class ImagesView:
    """`ArmsView` of arms that are only shown: nothing moves, so that there is nothing to stop.

    Args:
        cameras: Memories of the images, as `described` has them.
    """

    owe_motion = False

    def __init__(self, *cameras: str) -> None:
        self._cameras = opened(cameras)

    def words(self, now_s: float) -> dict[str, str]:
        """Return nothing: the program has all words."""
        return {}

    def sending(self) -> tuple[float, float]:
        """Return NaN: nothing is sent."""
        return math.nan, math.nan

    def images(self, now_s: float) -> dict[str, NDArray[np.uint8]]:
        """Return the newest images, (height, width, 3), by camera."""
        return newest_images(self._cameras, now_s)

    def stop(self, reason: str) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Release the memories."""
        for each in self._cameras.values():
            each.close()
