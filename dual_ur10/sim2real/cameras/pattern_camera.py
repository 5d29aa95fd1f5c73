"""Camera of test images that show the time of their exposure, by which delays are measured."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, CameraSource, Exposure
from dual_ur10.sim2real.cell_file.tables import PatternCameraEntry

_BITS: Final = 48  # microseconds: nine years
_COLUMNS: Final = 8
_ROWS: Final = _BITS // _COLUMNS
_LEAST: Final = 2  # pixels of a square
_DARK, _LIGHT = 24, 231


class PatternCamera(CameraSource):
    """Camera whose images show a clock: 48 squares, the bits of a number of microseconds, and a moving bar.

    Images are due at whole multiples of its period on the system's clock.

    Args:
        request: The request.

    Raises:
        SettingsError: The images are too small for it.
    """

    def __init__(self, request: CameraRequest) -> None:
        if not isinstance(request.entry, PatternCameraEntry):
            raise SettingsError(f"{request.where} is no camera of this kind")
        self._clock, self._period_s, self._size = request.system.clock, 1.0 / request.entry.rate_hz, request.size
        if min(request.size[0] // (_ROWS + 1), request.size[1] // _COLUMNS) < _LEAST:
            raise SettingsError(
                f"{request.where}: images of {request.size[1]} x {request.size[0]} pixels are too small for a clock: "
                f"ask for {_LEAST * _COLUMNS} x {_LEAST * (_ROWS + 1)} or more"
            )
        self._number = math.floor(self._clock.now_s() / self._period_s)

    def read(self) -> Exposure:
        """See `CameraSource`. An image that is a period late is left out."""
        now_s = self._clock.now_s()
        self._number = max(self._number + 1, math.floor(now_s / self._period_s))
        exposed_s = self._number * self._period_s
        self._clock.sleep(exposed_s - now_s)
        return Exposure(pattern(exposed_s, self._size), exposed_s)


def pattern(time_s: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the image of a time, to 1 microsecond, at a size (height, width)."""
    height, width = size
    image = np.full((height, width, 3), _DARK, np.uint8)
    down, across = height // (_ROWS + 1), width // _COLUMNS
    micros = round(1e6 * time_s)
    bits = [(micros >> number) & 1 for number in range(_BITS)]
    squares = np.array(bits, np.uint8).reshape(_ROWS, _COLUMNS).repeat(down, axis=0).repeat(across, axis=1)
    image[: _ROWS * down, : _COLUMNS * across] = (_DARK + (_LIGHT - _DARK) * squares)[..., None]
    bar = round((time_s % 1.0) * (width - 1))
    image[_ROWS * down :, max(0, bar - across // 4) : bar + across // 4 + 1] = (_LIGHT, _LIGHT, _DARK)
    return image


def pattern_time_s(image: NDArray[np.uint8]) -> float:
    """Return the time that an image of this camera shows, also after a lossy compression."""
    height, width = image.shape[:2]
    down, across = height // (_ROWS + 1), width // _COLUMNS
    middle = np.mean(image[down // 2 : _ROWS * down : down, across // 2 : _COLUMNS * across : across], axis=-1)
    bits = (middle > (_DARK + _LIGHT) / 2).reshape(-1)
    return 1e-6 * sum(1 << number for number, bit in enumerate(bits.tolist()) if bit)
