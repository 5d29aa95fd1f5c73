"""Video files: the only place where one is written."""

from __future__ import annotations

import secrets
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DualUR10Error, MissingExtraError, SettingsError
from ur_core.files import check_target

FPS: Final = {".mp4": 25.0, ".gif": 12.5}
"""Frames per second of each kind of file, by its suffix. GIF has hundredths of a second, and no motion prediction."""

# H.264 of 8 bits with halved colour, and the index first: what every browser plays, also while it loads.
# The preset takes a third of the time of the encoder's default, for files larger by a tenth.
_H264: Final = ("-crf", "21", "-preset", "veryfast", "-movflags", "+faststart")

# One palette for the whole film. Dithering would make every frame differ from the one before.
_PALETTE: Final = (
    "-filter_complex",
    "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none:diff_mode=rectangle",
)


def check_video(path: str | Path) -> Path:
    """Check that a video can be written, before the work whose result it will hold.

    Args:
        path: The file. Its suffix names its kind.

    Returns:
        The path without links.

    Raises:
        SettingsError: The suffix is none of `FPS`.
        MissingExtraError: The package that encodes is not installed.
        DualUR10Error: The file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in FPS:
        raise SettingsError(
            f"{path} names no kind of video{f': {suffix} is unknown' if suffix else ''}: use {' or '.join(FPS)}"
        )
    target = check_target(path)
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", "plot", "writing a video") from None
    return target


class VideoFile:
    """MP4 (H.264, for browsers) or GIF, by the suffix. A context: it appears, or replaces an old file, at its end.

    If the block raises, there is no new file, and an old one is unchanged.

    Args:
        path: The file.

    Attributes:
        fps: Frames per second.
        frames: Frames written.

    Raises:
        DualUR10Error: As `check_video`, or while writing, if the encoder failed.
    """

    def __init__(self, path: str | Path) -> None:
        self._path, self._target = path, check_video(path)
        suffix = self._target.suffix.lower()
        self.fps, self.frames = FPS[suffix], 0
        # In the same folder: a file can be renamed within one file system only. ffmpeg reads the kind from the suffix.
        self._part = self._target.with_name(f".{self._target.stem[:100]}.{secrets.token_hex(8)}.part{suffix}")
        self._encoder: Any = None

    def append(self, frame: NDArray[np.uint8]) -> None:
        """Write a frame, (height, width, 3), all of one size."""
        try:
            if self._encoder is None:
                self._encoder = self._begun(frame)
            self._encoder.send(np.ascontiguousarray(frame))
        except OSError as error:
            raise DualUR10Error(f"cannot write {self._path}: {error}") from error
        self.frames += 1

    def _begun(self, frame: NDArray[np.uint8]) -> Any:
        import imageio_ffmpeg

        height, width = frame.shape[:2]
        moving = self._target.suffix.lower() == ".mp4"
        encoder = imageio_ffmpeg.write_frames(
            str(self._part),
            (width, height),
            fps=self.fps,
            codec="libx264" if moving else "gif",
            pix_fmt_out="yuv420p" if moving else "pal8",
            quality=None,
            macro_block_size=2 if moving else 1,  # halved colour needs even sizes
            ffmpeg_log_level="error",
            output_params=list(_H264 if moving else _PALETTE),
        )
        encoder.send(None)
        return encoder

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        encoder, self._encoder = self._encoder, None
        try:
            if encoder is not None:
                encoder.close()  # waits for the encoder to end
            if kind is None:
                self._part.replace(self._target)
        except OSError as failure:
            raise DualUR10Error(f"cannot write {self._path}: {failure}") from failure
        finally:
            self._part.unlink(missing_ok=True)
