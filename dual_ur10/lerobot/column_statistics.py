"""Statistics of features, by which learners normalise: of episodes, and of a whole dataset."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ur_core.types import Array

QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Statistics = Mapping[str, Array]
"""min, max, mean, std, the quantiles, each of the shape of a frame's value, and count (1,)."""

_SIDE: Final = 150  # pixels of an image that statistics are taken of, about
_LARGE: Final = 300
_LEVELS: Final = 256


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Return the statistics of the values of a feature over frames, (m, size) or (m,)."""
    table = values.reshape(len(values), -1).astype(np.float64)
    found = dict(zip(QUANTILES, np.quantile(table, [*QUANTILES.values()], axis=0), strict=True))
    return {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
        "count": np.array([len(table)]),
        **found,
    }


def combined(parts: Iterable[Statistics]) -> Statistics:
    """Return the statistics of all frames together. Quantiles are means of those of the parts, by their counts.

    LeRobot combines quantiles in the same way, so that a dataset that it extends or merges stays consistent.
    """
    found = list(parts)
    count = np.array([each["count"][0] for each in found], dtype=np.float64)
    stacked = {name: np.stack([each[name] for each in found]) for name in found[0] if name != "count"}

    def mean(values: Array) -> Array:
        result: Array = np.tensordot(count / count.sum(), values, axes=1)
        return result

    centre = mean(stacked["mean"])
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": centre,
        "std": np.sqrt(mean(stacked["std"] ** 2 + (stacked["mean"] - centre) ** 2)),
        "count": np.array([int(count.sum())]),
        **{name: mean(stacked[name]) for name in QUANTILES},
    }


def sampled(count: int) -> NDArray[np.intp]:
    """Return the indices of those of `count` frames whose images statistics are taken of, as LeRobot chooses them."""
    size = max(min(count, 100), min(int(count**0.75), 10_000))
    return np.round(np.linspace(0, count - 1, size)).astype(np.intp)


def small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return every k-th pixel of an image, (h, w, 3)."""
    side = max(image.shape[:2])
    step = 1 if side < _LARGE else side // _SIDE
    return image[::step, ::step]


class ImageStatistics:
    """Statistics of the channels of images, in 0..1, in memory that does not grow with their number."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, _LEVELS), dtype=np.int64)  # of pixels, of each channel and level
        self._images = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take an image, (h, w, 3), in."""
        self._counts += [np.bincount(channel.ravel(), minlength=_LEVELS) for channel in np.moveaxis(image, 2, 0)]
        self._images += 1

    def result(self) -> Statistics:
        """Return the statistics, (3, 1, 1) each; the count is of images."""
        below = self._counts.cumsum(axis=1)
        pixels = int(below[0, -1])

        def level(rank: int) -> Array:
            """Return the level of each channel that has this place among its pixels, in order."""
            found: Array = (below <= rank).sum(axis=1).astype(np.float64)
            return found

        def quantile(share: float) -> Array:
            rank = share * (pixels - 1)
            lower, upper = level(math.floor(rank)), level(math.ceil(rank))
            return lower + (rank - math.floor(rank)) * (upper - lower)

        levels = np.arange(_LEVELS)
        mean = self._counts @ levels / pixels
        found = {
            "min": level(0),
            "max": level(pixels - 1),
            "mean": mean,
            "std": np.sqrt((self._counts * (levels - mean[:, None]) ** 2).sum(axis=1) / pixels),
            **{name: quantile(share) for name, share in QUANTILES.items()},
        }
        result = {name: (value / (_LEVELS - 1)).reshape(3, 1, 1) for name, value in found.items()}
        return {**result, "count": np.array([self._images])}
