"""Images that cameras of a cell of controllers recorded, one for each observation of an episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import RecordingError, SettingsError
from dual_ur10.sim2real.cameras.image_size import check_fits, resized
from dual_ur10.sim2real.cameras.video_record import camera_of, read_video, video_name
from dual_ur10.sim2real.recording.run import LATE, Episode, Run
from ur_core.types import Array

_STALE_S: Final = 1.0
_STALE_PERIODS: Final = 3.0
_SLACK_S: Final = 1e-6


class RecordedImages:
    """Videos of a run, which are read once, from its first episode to its last.

    Args:
        folder: Folder of the run.
        cameras: Names of cameras.
        size: Height and width of the images; None: those of each camera's own.

    Raises:
        RecordingError: The run has no video of a camera, or one that has no image or does not fit the size.
    """

    def __init__(self, folder: Path, cameras: Sequence[str], size: tuple[int, int] | None = None) -> None:
        self._videos = {each: _Playback(folder / video_name(each), size) for each in cameras}

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Height and width of the images, by camera."""
        return {name: video.size for name, video in self._videos.items()}

    def at(self, time_s: float) -> dict[str, NDArray[np.uint8]]:
        """Return the newest images that are not newer than a time of the run's clock, of cameras that have one.

        Times may not go back.
        """
        found = {name: video.at(time_s) for name, video in self._videos.items()}
        return {name: image for name, image in found.items() if image is not None}

    def images(self, run: Run, episode: Episode) -> Iterator[dict[str, NDArray[np.uint8]]]:
        """Yield the images by camera for the observation before each step.

        Episodes have to come in the order of the run.

        Raises:
            RecordingError: A video has no image of that time, or the run no times of its targets.
        """
        for at_s in observed_s(run, episode).tolist():
            found = self.at(at_s)
            for name, video in self._videos.items():
                if name not in found:
                    raise RecordingError(
                        f"{video.path} has no image just before {at_s:.2f} s, when a step began: the camera was not "
                        "recorded then. Leave it out of --cameras, or leave out the run"
                    )
            yield found


class _Playback:
    """Images of one video in order."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        if not path.is_file():
            raise RecordingError(
                f"there is no {path}: the run was recorded without images of that camera. Name it in the "
                "cell file, or observe it, when you record; or leave it out of --cameras"
            )
        self.path, self._frames = path, read_video(path)
        self._now: tuple[float, NDArray[np.uint8]] | None = None
        self._next = next(self._frames, None)
        if self._next is None:
            raise RecordingError(f"{path} has no image: the recording was cut off. Leave the camera out of --cameras")
        height, width, _ = self._next[1].shape
        self.size = (height, width) if size is None else size
        try:
            check_fits((height, width), self.size, str(path))
        except SettingsError as error:
            raise RecordingError(str(error)) from None
        self._made: NDArray[np.uint8] | None = None
        self._allowed_s = _STALE_S

    def at(self, time_s: float) -> NDArray[np.uint8] | None:
        """Return the newest image that is not newer than a time; None: there is none, or it is too old."""
        while self._next is not None and self._next[0] <= time_s + _SLACK_S:
            before = self._now
            self._now, self._next, self._made = self._next, next(self._frames, None), None
            one, other = (self._now, self._next) if before is None else (before, self._now)
            if other is not None:  # the period of the first image is that to the second one
                self._allowed_s = max(_STALE_S, _STALE_PERIODS * (other[0] - one[0]))
        if self._now is None or time_s - self._now[0] > self._allowed_s:
            return None
        if self._made is None:
            self._made = resized(self._now[1], self.size)
        return self._made


def cameras_in(folder: Path) -> list[str]:
    """Return the names of the cameras that have a video in the folder of a run."""
    return sorted(camera_of(each.name) for each in folder.glob(video_name("*")))


def observed_s(run: Run, episode: Episode) -> Array:
    """Return the times on the run's clock of the observations before the m steps of an episode, (m,).

    The first is that of the reset. The others follow from when the first target of each step was sent, and the latency
    of actions: they are the ends of control periods, up to a period before the states arrived.

    Raises:
        RecordingError: Too few targets are known.
    """
    header, sent = run.header, run.arms[0].sent
    first = np.asarray(episode.first_target, dtype=np.float64)
    steps = np.arange(len(first))
    known = (first != LATE) & (first >= sent["index"].min(initial=np.inf)) & (first <= sent["index"].max(initial=-1.0))
    if np.count_nonzero(known) < min(2, len(first)) or not len(first) or not header.speed_factor:
        raise RecordingError(f"episode {episode.number} has no times of its targets: leave --cameras out")
    order = np.argsort(sent["index"], kind="stable")
    sent_s = np.interp(first[known], sent["index"][order], sent["sent_s"][order])
    latency_s = header.latency_ticks * header.tick_s / header.speed_factor
    step_s = header.period_ticks * header.tick_s / header.speed_factor
    begins = np.interp(steps, steps[known], sent_s - step_s * steps[known]) + step_s * steps
    found: Array = begins - latency_s
    if not episode.first_step:
        found[0] = episode.begin_s
    return found
