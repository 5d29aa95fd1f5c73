"""Cameras that PyAV opens: a video file, and Linux's cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, CameraSource, Exposure
from dual_ur10.sim2real.cameras.pyav import pyav
from dual_ur10.sim2real.cell_file.tables import FileCameraEntry, V4l2CameraEntry

_USE: Final = "a camera or a video file"
_OPEN_S, _READ_S = 5.0, 5.0
_CLOCK_S: Final = 1.0  # from a driver's time stamp to now, on the same clock
_LATE: Final = 2.0  # periods
_MOST_LATE: Final = 250  # frames left out in a row: a machine that is too slow for a video shows late ones


class FileCamera(CameraSource):
    """Video file, played once or again and again, at the times of its frames.

    Args:
        request: The request. A relative path is relative to the folder of the program.

    Raises:
        MissingExtraError: PyAV is not installed.
        LinkError: There is no such file, or it is no video.
    """

    def __init__(self, request: CameraRequest) -> None:
        av, entry = pyav(_USE), request.entry
        if not isinstance(entry, FileCameraEntry):
            raise SettingsError(f"{request.where} is no camera of this kind")
        path = Path(entry.file)
        if not path.is_file():
            raise LinkError(f"{request.where}: there is no video file {path}: correct `file` in the cell file")
        self._where, self._clock, self._repeat = request.where, request.system.clock, entry.repeat
        self._errors = (av.FFmpegError, OSError, ValueError, IndexError)
        try:
            # No other protocol: a playlist could name addresses.
            self._file = av.open(f"file:{path.resolve()}", options={"protocol_whitelist": "file"})
            self._stream = self._file.streams.video[0]
        except self._errors as error:
            raise LinkError(f"{request.where}: {path} is no video: {error}: name another file") from error
        rate = self._stream.average_rate or self._stream.guessed_rate
        self._period_s = float(1 / rate) if rate else 1.0 / 30.0
        self._begin_s = self._clock.now_s()
        self._frames = self._decoded()

    def _decoded(self) -> Iterator[tuple[Any, float]]:
        """Yield the frames with their times since the first one began."""
        offset_s = end_s = 0.0
        while True:
            first: float | None = None
            for frame in self._file.decode(self._stream):
                at_s = float(frame.time) if frame.time is not None else end_s
                first = at_s if first is None else first
                end_s = offset_s + (at_s - first) + self._period_s
                yield frame, offset_s + (at_s - first)
            if not self._repeat or first is None:
                return
            offset_s = end_s
            self._file.seek(0)

    def read(self) -> Exposure:
        """See `CameraSource`. Frames that are late by a period are left out."""
        try:
            for number, (frame, at_s) in enumerate(self._frames):
                exposed_s = self._begin_s + at_s
                now_s = self._clock.now_s()
                if exposed_s < now_s - self._period_s and number < _MOST_LATE:
                    continue
                self._clock.sleep(exposed_s - now_s)
                return Exposure(frame.to_ndarray(format="rgb24"), exposed_s)
        except self._errors as error:
            raise LinkError(f"{self._where}: the video cannot be read on: {error}: name another file") from error
        raise LinkError(f"{self._where}: the video has ended: name a longer one, or set repeat = true")

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its images."""
        return self._stream.codec_context.height, self._stream.codec_context.width

    def close(self) -> None:
        """See `CameraSource`."""
        self._file.close()


class V4l2Camera(CameraSource):
    """Camera of Linux, such as one at USB.

    Times are those that the driver stamps on its buffers, mostly at the end of the exposure, on Linux's monotonic
    clock. Where a driver stamps another clock, they are those of arrival. Images are decoded one at a time: those that
    waited for two periods are left out.

    Args:
        request: The request.

    Raises:
        MissingExtraError: PyAV is not installed.
        LinkError: The device is absent or busy, or takes no such size.
    """

    def __init__(self, request: CameraRequest) -> None:
        av, entry = pyav(_USE), request.entry
        if not isinstance(entry, V4l2CameraEntry):
            raise SettingsError(f"{request.where} is no camera of this kind")
        self._entry, self._clock, self._where = entry, request.system.clock, f"{request.where} at {entry.device}"
        self._errors = (av.FFmpegError, OSError, ValueError, IndexError)
        options = {
            "video_size": f"{entry.width}x{entry.height}",
            "framerate": f"{entry.rate_hz:g}",
            "input_format": entry.format,
            "timestamps": "default",  # the kernel's, as they are
        }
        try:
            self._file = av.open(entry.device, format="v4l2", options=options, timeout=(_OPEN_S, _READ_S))
            self._stream = self._file.streams.video[0]
            self._packets = self._file.demux(self._stream)
        except self._errors as error:
            raise LinkError(
                f"{self._where} cannot be opened at {entry.width} x {entry.height} as {entry.format}: {error}: check "
                "that it is connected, that no other program has it open, and with `v4l2-ctl --list-formats-ext` what "
                "it offers"
            ) from error
        found = self._stream.codec_context.height, self._stream.codec_context.width
        if found != (entry.height, entry.width):
            self._file.close()
            raise LinkError(
                f"{self._where} gives {found[1]} x {found[0]} pixels, and {entry.width} x {entry.height} are in the "
                "cell file: write what it gives"
            )

    def read(self) -> Exposure:
        """See `CameraSource`."""
        try:
            for packet in self._packets:
                arrived_s = self._clock.now_s()
                exposed_s = self._exposed_s(packet, arrived_s)
                if arrived_s - exposed_s > self._entry.delay_s + _LATE / self._entry.rate_hz:
                    continue
                for frame in packet.decode():
                    return Exposure(frame.to_ndarray(format="rgb24"), exposed_s)
        except self._errors as error:
            raise LinkError(f"{self._where} was lost: {error}: check its cable") from error
        raise LinkError(f"{self._where} sends no more images: check its cable")

    def _exposed_s(self, packet: Any, arrived_s: float) -> float:
        stamped_s = math.nan if packet.pts is None else float(packet.pts * packet.time_base)
        on_clock = -1e-3 <= arrived_s - stamped_s <= _CLOCK_S
        return (stamped_s if on_clock else arrived_s) - self._entry.delay_s

    def close(self) -> None:
        """See `CameraSource`."""
        self._file.close()
