"""Videos of cameras beside a record: H.264 with the true time of each image."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.cameras.camera_source import Exposure
from dual_ur10.sim2real.cameras.pyav import pyav

log = logging.getLogger(__name__)

_USE: Final = "the record of a camera"
_PER_S: Final = 1_000_000  # of the time base
_OPTIONS: Final = {"preset": "ultrafast", "tune": "zerolatency", "crf": "23", "threads": "1"}
_KEY_S: Final = 0.5  # a fragment is written with the next key frame, at most a second after its first image
# Readable up to the last second where its process was killed, or without the last image of a slow camera.
_CONTAINER: Final = {
    "movflags": "frag_keyframe+delay_moov+default_base_moof",  # with the time of the first image
    "flush_packets": "1",
    "video_track_timescale": str(_PER_S),
    "movie_timescale": str(_PER_S),
}


def video_name(camera: str) -> str:
    """Return the name of the video of a camera in the folder of a run, another one for each camera."""
    return f"camera_{file_name(camera)}.mp4"


def camera_of(video: str) -> str:
    """Return the name of the camera of a video; see `video_name`."""
    return video.removeprefix("camera_").removesuffix(".mp4").replace("-", "/")


def file_name(camera: str) -> str:
    """Return the name of a camera as a part of the name of a file. Cameras have no "-" in theirs."""
    return camera.replace("/", "-")


class VideoRecord:
    """Writer of the video of one camera.

    Args:
        path: File to make.
        size: Height and width of its images. Odd ones lose a row or column, as H.264 takes even sizes.
        begin_s: Zero of the run's clock on the system's clock. Earlier images are left out.

    Raises:
        MissingExtraError: PyAV is not installed.
        RecordingError: It cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], begin_s: float) -> None:
        self._av, self._path, self._begin_s = pyav(_USE), path, begin_s
        self._size = size[0] // 2 * 2, size[1] // 2 * 2
        self._key_s = -math.inf
        self._errors = (self._av.FFmpegError, OSError, ValueError)
        try:
            self._file = self._av.open(str(path), "w", options=_CONTAINER)
            self._stream: Any = self._file.add_stream("libx264", options=_OPTIONS)
        except self._errors as error:
            raise RecordingError(f"cannot write {path}: {error}") from error
        self._stream.height, self._stream.width = self._size
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = self._stream.codec_context.time_base = Fraction(1, _PER_S)

    def add(self, exposure: Exposure) -> None:
        """Append an image.

        Raises:
            RecordingError: It cannot be written.
        """
        at = round(_PER_S * (exposure.exposed_s - self._begin_s))
        if at < 0:
            return
        image = np.ascontiguousarray(exposure.image[: self._size[0], : self._size[1]])
        frame = self._av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = at, Fraction(1, _PER_S)
        if exposure.exposed_s - self._key_s >= _KEY_S:
            self._key_s, frame.pict_type = exposure.exposed_s, self._av.video.frame.PictureType.I
        try:
            self._file.mux(self._stream.encode(frame))
        except self._errors as error:
            raise RecordingError(f"cannot write {self._path}: {error}") from error

    def close(self) -> None:
        """Complete the file.

        Raises:
            RecordingError: It cannot be written.
        """
        try:
            self._file.mux(self._stream.encode(None))
            self._file.close()
        except self._errors as error:
            raise RecordingError(f"cannot complete {self._path}: {error}") from error


def read_video(path: Path) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yield the images of a recorded camera, (height, width, 3), with their times on the run's clock, to 1 µs.

    One that was cut off within an image, as by a full disk, ends before it.

    Raises:
        MissingExtraError: PyAV is not installed.
        RecordingError: It is no such video.
    """
    av, begun = pyav(_USE), False
    try:
        with av.open(f"file:{path}", options={"protocol_whitelist": "file"}) as file:
            for frame in file.decode(video=0):
                yield float(frame.pts * frame.time_base), frame.to_ndarray(format="rgb24")
                begun = True
    except (av.FFmpegError, OSError, ValueError, IndexError, TypeError) as error:
        if begun and isinstance(error, av.FFmpegError):
            log.warning("%s is read as far as it is whole: %s", path, error)
            return
        raise RecordingError(f"{path} is no video of a camera: {error}") from error
