"""Video of an episode, and key frames of it."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.evaluation.rollout import Info, rollout
from dual_ur10.policies.policy import Policy

FPS, WIDTH, HEIGHT = 25, 960, 540
_PICTURE, _SHOWN = (480, 270), (160, 80, 843, 464)  # size of a key frame, and the part of a frame in it
_INK, _PAPER = (38, 50, 56), (255, 255, 255)

Picture = NDArray[np.uint8]


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
class Film:
    """Video of an episode.

    Attributes:
        path: The file.
        text: Description.
        speedup: Speed of the video over that of the episode.
        frames: Key frames.
    """

    path: Path
    text: str
    speedup: float
    frames: tuple[KeyFrame, ...] = ()


@dataclass(frozen=True)
class Script:
    """Contents of a film.

    Attributes:
        text: Description.
        caption: The line at the foot of a frame, from the time and `info`.
        keys: Title and text of a key frame from the time and `info`, or None; called at every step.
    """

    text: str
    caption: Callable[[float, Info], str]
    keys: Callable[[float, Info], tuple[str, str] | None] = lambda *_: None


def shoot(
    path: Path,
    env: Any,
    policy: Policy,
    script: Script,
    *,
    every: int = 1,
    seed: int = 0,
    on_step: Callable[[int], None] = lambda _: None,
) -> Film:
    """Draw one episode, write the video, and close the environment.

    Args:
        path: Path of the video.
        env: An environment with `render_mode="rgb_array"`.
        policy: The acting policy.
        script: Contents.
        every: Steps from one frame to the next.
        seed: Seed of the episode.
        on_step: Called with the number of steps after each.

    Raises:
        RenderError: No OpenGL backend was found; there is no file then.
        DualUR10Error: The episode was cut short, or the file cannot be written; there is no file then.
    """
    import imageio.v2 as imageio

    period_s = env.unwrapped.core.timing.period_s
    writer: Any = None
    pictures: list[KeyFrame] = []
    steps = 0

    def draw(info: Info) -> None:
        nonlocal writer, steps
        steps += 1
        on_step(steps)
        time_s, found = steps * period_s, script.keys(steps * period_s, info)
        due = (steps - 1) % every == 0
        if not due and found is None:
            return
        image = env.render()
        if found is not None:
            pictures.append(KeyFrame(*found, as_address(image)))
        if due:
            if writer is None:
                writer = imageio.get_writer(
                    path, fps=FPS, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
                )
            writer.append_data(captioned(image, script.caption(time_s, info)))

    try:
        record = rollout(env, policy, seed=seed, on_step=draw)
        if record.ended_by:
            raise DualUR10Error(f"the filmed episode ended after {record.time_s[-1]:g} s: {record.ended_by}")
    except BaseException as error:
        if writer is not None:
            writer.close()
            path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise DualUR10Error(f"cannot write {path}: {error}") from error
        raise
    finally:
        env.close()
    writer.close()
    return Film(path, script.text, every * period_s * FPS, tuple(pictures))


def captioned(image: Picture, text: str) -> Picture:
    """Return the image with a line of text at its foot."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, HEIGHT - 34, WIDTH, HEIGHT), fill=_INK)
    draw.text((16, HEIGHT - 17), text, fill=_PAPER, font=ImageFont.load_default(17), anchor="lm")
    return np.asarray(picture)


def as_address(image: Picture) -> str:
    """Return the middle of the image, smaller, as a `data:` URI."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).crop(_SHOWN).resize(_PICTURE, Image.Resampling.LANCZOS).save(buffer, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
