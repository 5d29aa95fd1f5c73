"""Memory of one camera, which its process writes and a program reads. Nobody waits in it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.cameras.camera_source import Exposure
from ur_core.processes.shared_memory import Layout, SharedBlock
from ur_core.types import Array

SLOTS: Final = 8
"""Images kept. The oldest may be being overwritten."""

_TEXT: Final = 2048
_TRIES: Final = 8
_COUNT, _LOST, _ENDING, _VIDEO, _FAILED = range(5)


class CameraMemory:
    """Ring of the newest images.

    Args:
        size: Height and width of the images.
        name: Name of existing memory; None: create it.

    Attributes:
        size: As given.
        name: Name by which another process opens it.
    """

    def __init__(self, size: tuple[int, int], name: str | None = None) -> None:
        layout: Layout = {
            "ints": (np.int64, (5,)),
            "times": (np.float64, (SLOTS,)),
            "images": (np.uint8, (SLOTS, *size, 3)),
            "text": (np.uint8, (_TEXT,)),
            "video": (np.uint8, (_TEXT,)),
            "begin": (np.float64, (1,)),
            "failure": (np.uint8, (_TEXT,)),
        }
        self.size = size
        self._block = SharedBlock(layout, name)
        self.name = self._block.name
        self._view()

    def _view(self) -> None:
        self._ints = self._block.counters("ints")
        self._times: Array = self._block["times"]
        self._images: NDArray[np.uint8] = self._block["images"]

    # Written by the camera's process.

    def put(self, exposure: Exposure) -> None:
        """Write an image."""
        count = self._ints[_COUNT]
        self._images[count % SLOTS] = exposure.image
        self._times[count % SLOTS] = exposure.exposed_s
        self._ints[_COUNT] = count + 1

    def lose(self, reason: str) -> None:
        """Note that no more images come, and why."""
        self._block.set_text("text", reason)
        self._ints[_LOST] = 1

    def fail(self, reason: str) -> None:
        """Note that the video is not written any more, and why."""
        self._block.set_text("failure", reason)
        self._ints[_FAILED] = 1

    # Written by the program.

    def record(self, path: str, begin_s: float) -> None:
        """Ask for a video, once.

        Args:
            path: File to make.
            begin_s: Zero of the run's clock on the system's clock.
        """
        self._block["begin"][0] = begin_s
        self._block.set_text("video", path)
        self._ints[_VIDEO] = 1

    def end(self) -> None:
        """Ask the camera's process to end."""
        self._ints[_ENDING] = 1

    # Read by both.

    @property
    def count(self) -> int:
        """Number of images so far."""
        return self._ints[_COUNT]

    @property
    def lost(self) -> str:
        """Reason why no more images come; "": they do."""
        return self._block.text("text") if self._ints[_LOST] else ""

    @property
    def video(self) -> tuple[str, float] | None:
        """Path of the video and zero of the run's clock; None: there is to be none."""
        return (self._block.text("video"), float(self._block["begin"][0])) if self._ints[_VIDEO] else None

    @property
    def failure(self) -> str:
        """Reason why the video is not written any more; "": it is, or is not wanted."""
        return self._block.text("failure") if self._ints[_FAILED] else ""

    @property
    def ending(self) -> bool:
        """True once the program asked the process to end."""
        return bool(self._ints[_ENDING])

    @property
    def times_s(self) -> list[float]:
        """Times of exposure of the images that are kept, the newest last."""
        count = self._ints[_COUNT]
        return [float(self._times[number % SLOTS]) for number in range(max(0, count - SLOTS + 1), count)]

    def newest(self, until_s: float) -> Exposure | None:
        """Return a copy of the newest image that is not newer than a time; None: there is none."""
        for _ in range(_TRIES):  # again only where the writer overtook this reader by seven images
            count = self._ints[_COUNT]
            kept = range(count - 1, max(0, count - SLOTS + 1) - 1, -1)
            number = next((each for each in kept if self._times[each % SLOTS] <= until_s), None)
            if number is None:
                return None
            found = Exposure(self._images[number % SLOTS].copy(), float(self._times[number % SLOTS]))
            if self._ints[_COUNT] - number < SLOTS:
                return found
        return None

    def close(self) -> None:
        """Release the memory. May be called twice."""
        self._block.close()
        self._view()


def newest_images(memories: Mapping[str, CameraMemory], now_s: float) -> dict[str, NDArray[np.uint8]]:
    """Return copies of the newest images by camera, without those of cameras that have none."""
    found = {name: memory.newest(now_s) for name, memory in memories.items()}
    return {name: each.image for name, each in found.items() if each is not None}


def described(camera: str, memory: CameraMemory) -> str:
    """Return a text from which another process opens the memory of a camera."""
    return json.dumps([camera, memory.name, *memory.size])


def opened(texts: Iterable[str]) -> dict[str, CameraMemory]:
    """Return the memories of cameras by their names, as `described` has them."""
    found = {}
    for text in texts:
        camera, name, height, width = json.loads(text)
        found[camera] = CameraMemory((height, width), name)
    return found
