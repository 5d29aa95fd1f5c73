"""Loop of `replay --page`: it shows a recorded episode as it was, with the images of its cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.errors import RecordingError, RenderError
from dual_ur10.sim2real.cameras.camera_memory import CameraMemory, described
from dual_ur10.sim2real.cameras.camera_source import Exposure
from dual_ur10.sim2real.recording.recorded_images import RecordedImages, cameras_in, observed_s
from dual_ur10.sim2real.recording.run import Episode, Run
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array, Closing

_VIEW: Final = "dual_ur10.sim2real.cameras.images_view:ImagesView"
_PAUSE_S: Final = 1.0
_DARK: Final = 40


class PlaybackSession(Closing):
    """Loop that shows the states of an episode and the images of its cameras at their times, again and again.

    Args:
        run: The recording.
        episode: An episode of it.
        folder: Folder of the run.
        report: Called with the reason why a camera is left out.
        system: Clock.

    Attributes:
        cameras: Names of the cameras that have images.

    Raises:
        RecordingError: The times of the episode are not known.
    """

    def __init__(
        self, run: Run, episode: Episode, folder: Path, report: Callable[[str], None], *, system: System = LOCAL
    ) -> None:
        self._folder, self._episode, self._clock = folder, episode, system.clock
        self._times_s = _times_of(run, episode)
        sizes: dict[str, tuple[int, int]] = {}
        for name in cameras_in(folder):
            try:
                sizes |= RecordedImages(folder, [name]).sizes
            except RecordingError as error:
                report(str(error))
        self.cameras = tuple(sizes)
        self._memories = {name: CameraMemory(size) for name, size in sizes.items()}

    def run(self, page: LivePage, seconds: float | None) -> None:
        """Show the episode until the time is over, or Ctrl-C.

        Raises:
            RenderError: The page's process has ended.
            RecordingError: A video is damaged.
        """
        page.attach((_VIEW, *(described(name, memory) for name, memory in self._memories.items())))
        begin_s = self._clock.now_s()
        end_s = np.inf if seconds is None else begin_s + seconds
        while begin_s < end_s:
            images = RecordedImages(self._folder, self.cameras)
            for step, time_s in enumerate(self._times_s.tolist()):
                due_s = begin_s + time_s - self._times_s[0]
                if due_s > end_s:
                    return
                self._clock.sleep(max(0.0, due_s - self._clock.now_s()))
                self._show(page, images, step, time_s)
            begin_s = self._clock.now_s() + _PAUSE_S

    def _show(self, page: LivePage, images: RecordedImages, step: int, time_s: float) -> None:
        if lost := page.lost:
            raise RenderError(f"the live page is gone: {lost}: start the program again")
        found, now_s = images.at(time_s), self._clock.now_s()
        for name, memory in self._memories.items():
            image = found.get(name, np.full((*memory.size, 3), _DARK, np.uint8))
            memory.put(Exposure(image, now_s))
        each = self._episode
        commanded = each.targets_rad[max(0, step - 1), -1] if step else each.q_rad[0]
        words = {"record": f"episode {each.number}, step {step} of {len(each.reward)}, {time_s:.2f} s of the run"}
        if missing := [name for name in self.cameras if name not in found]:
            words["without image"] = ", ".join(missing)
        page.say(words)
        page.show_measured(
            each.q_rad[step], commanded, {"time_s": time_s - self._times_s[0], "episode": each.number, "step": step}
        )

    def close(self) -> None:
        """Release the images. May be called twice."""
        for each in self._memories.values():
            each.close()


def _times_of(run: Run, episode: Episode) -> Array:
    """Return the times on the run's clock of the reset and of the ends of the m steps, (m + 1,)."""
    header = run.header
    step_s = header.period_ticks * header.tick_s
    if header.source == "mujoco":
        steps: Array = np.arange(len(episode.q_rad), dtype=np.float64)
        return episode.begin_s + step_s * steps
    begins = observed_s(run, episode)
    return np.concatenate([begins, [begins[-1] + step_s / header.speed_factor]])
