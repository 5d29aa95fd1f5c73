"""Images of another size: the middle of what a camera sees, averaged."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError

_FLAT = 1e-2  # relative deviation of an aspect ratio that is none


def check_fits(own: tuple[int, int], wanted: tuple[int, int], where: str) -> None:
    """Check that images of one size can be made of those of another.

    A simulated camera keeps its vertical field of view in narrower images. So narrower ones are cut out of the middle;
    wider ones would show what the camera did not see.

    Args:
        own: Height and width of the camera's images.
        wanted: Height and width.
        where: The camera, for the message.

    Raises:
        SettingsError: They are wider in proportion, or have more pixels.
    """
    (height, width), (high, wide) = own, wanted
    if wide * height > width * high * (1 + _FLAT) or high > height:
        raise SettingsError(
            f"{where}: its images are {width} x {height} pixels, and {wide} x {high} are asked for: choose a width and "
            f"height that are not larger, and at most {width / height:.3g} times as wide as high"
        )


def resized(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the middle of an image, (h, w, 3), at a size (height, width) for which `check_fits` holds."""
    height, width = image.shape[:2]
    if (height, width) == size:
        return image
    cut = min(width, round(height * size[1] / size[0]))
    left = (width - cut) // 2
    middle = image[:, left : left + cut]
    down, across = height // size[0], cut // size[1]
    if (down * size[0], across * size[1]) == (height, cut):
        blocks = middle.reshape(size[0], down, size[1], across, 3)
        summed = blocks.sum(axis=(1, 3), dtype=np.uint32)
        means: NDArray[np.uint8] = ((summed + down * across // 2) // (down * across)).astype(np.uint8)
        return means
    rows = _weights(height, size[0]) @ middle.reshape(height, -1).astype(np.float32)
    turned = rows.reshape(size[0], cut, 3).transpose(1, 0, 2).reshape(cut, -1)
    found = (_weights(cut, size[1]) @ turned).reshape(size[1], size[0], 3).transpose(1, 0, 2)
    rounded: NDArray[np.uint8] = np.rint(found).clip(0, 255).astype(np.uint8)
    return rounded


@lru_cache(maxsize=16)
def _weights(have: int, want: int) -> NDArray[np.float32]:
    """Return (want, have) weights of the mean over each of `want` equal parts of `have` pixels."""
    edges = np.linspace(0.0, have, want + 1)
    low, high = edges[:-1, None], edges[1:, None]
    at = np.arange(have)[None]
    part = np.clip(np.minimum(high, at + 1) - np.maximum(low, at), 0.0, 1.0)
    weights: NDArray[np.float32] = (part / part.sum(axis=1, keepdims=True)).astype(np.float32)
    return weights
