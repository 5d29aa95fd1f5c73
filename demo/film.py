"""Videos of the demonstration, with a poster and key frames each."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from demo.case import Key
from dual_ur10.policies.evaluation.film import Picture, Take, film, stills

WIDTH, HEIGHT = 640, 360
_ZOOM = 1.3  # the camera shows more sky and floor than these tasks need


@dataclass(frozen=True)
class KeyFrame:
    """One picture of an episode.

    Attributes:
        title: Event that it shows.
        text: Time and measured values.
        address: The picture as a `data:` URI.
    """

    title: str
    text: str
    address: str


@dataclass(frozen=True)
class EpisodeVideo:
    """Video of an episode.

    Attributes:
        path: The file.
        text: Description.
        speed: Speed of the video over that of the episode.
        poster: Picture that is shown before it plays, as a `data:` URI.
        frames: Key frames.
    """

    path: Path
    text: str
    speed: float
    poster: str
    frames: tuple[KeyFrame, ...] = ()


def shoot(
    path: Path,
    shown: Take,
    title: str,
    text: str,
    *,
    speed: float = 1.0,
    keys: Sequence[Key] = (),
    on_ratio: Callable[[float], None] = lambda _: None,
) -> EpisodeVideo:
    """Draw an episode and write the video.

    Args:
        path: Path of the video.
        shown: The episode.
        title: Beginning of the line at the foot of each frame.
        text: Description.
        speed: Speed of the video over that of the episode.
        keys: Key frames.
        on_ratio: Called with the ratio of frames drawn.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
        DualUR10Error: The file cannot be written.
    """
    film(path, shown, title=title, width=WIDTH, height=HEIGHT, zoom=_ZOOM, speed=speed, on_ratio=on_ratio)
    times_s = [0.5 * shown.duration_s, *(number * shown.period_s for number, _, _ in keys)]
    poster, *pictures = map(as_address, stills(shown, times_s, width=WIDTH, height=HEIGHT, zoom=_ZOOM))
    frames = [KeyFrame(title, words, each) for (_, title, words), each in zip(keys, pictures, strict=True)]
    return EpisodeVideo(path, text, speed, poster, tuple(frames))


def as_address(image: Picture) -> str:
    """Return the image as a `data:` URI."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=85)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
