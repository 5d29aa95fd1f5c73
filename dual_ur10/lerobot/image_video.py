"""Videos of a dataset: H.264 at a constant rate, with a key frame at every second frame."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DatasetError, MissingExtraError

CODEC, PIXELS, GROUP, QUALITY, PRESET = "h264", "yuv420p", 2, 23, "veryfast"
_ENCODER: Final = "libx264"


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise MissingExtraError("PyAV", "lerobot", "the videos of a LeRobot dataset") from None
    return av


class ImageVideo:
    """Writer of the video of a camera over an episode. A context.

    Args:
        path: File to make.
        fps: Frames per second.
        size: Height and width, both even.

    Raises:
        DatasetError: It cannot be written, or a size is odd.
    """

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        av = _av()
        height, width = size
        if height % 2 or width % 2:
            raise DatasetError(f"images of {width} x {height} pixels: H.264 takes even sizes. Choose other ones")
        self._av, self._count = av, 0
        try:
            self._file = av.open(str(path), "w")
        except (OSError, ValueError) as error:
            raise DatasetError(f"cannot write {path}: {error}") from error
        options = {"crf": str(QUALITY), "preset": PRESET, "g": str(GROUP)}
        self._stream: Any = self._file.add_stream(_ENCODER, rate=fps, options=options)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, PIXELS
        self._stream.time_base = self._stream.codec_context.time_base = Fraction(1, fps)

    def __enter__(self) -> ImageVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._file.mux(self._stream.encode(None))
        finally:
            self._file.close()

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append an image, (h, w, 3)."""
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, self._count = self._count, self._count + 1
        self._file.mux(self._stream.encode(frame))


def video_info(fps: int, size: tuple[int, int]) -> dict[str, Any]:
    """Return the properties of such a video, as `meta/info.json` has them."""
    return {
        "video.height": size[0],
        "video.width": size[1],
        "video.codec": CODEC,
        "video.pix_fmt": PIXELS,
        "video.fps": fps,
        "video.channels": 3,
        "video.g": GROUP,
        "video.crf": QUALITY,
        "video.preset": PRESET,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {},
        "has_audio": False,
        "is_depth_map": False,
    }


def check_video(path: Path, frames: int) -> None:
    """Make sure that a video has at least a number of frames, as its container states them.

    Raises:
        DatasetError: It has fewer, or cannot be read.
    """
    av = _av()
    try:
        with av.open(str(path), format="mp4") as file:  # no list of other files
            stream = file.streams.video[0]
            found = stream.frames or sum(1 for packet in file.demux(stream) if packet.size)
    except (OSError, ValueError, IndexError) as error:  # PyAV's errors are of these kinds
        raise DatasetError(f"cannot read the video {path}: {error}") from error
    if found < frames:
        raise DatasetError(f"the video {path} has {found} frames where {frames} are needed: it was cut off")
