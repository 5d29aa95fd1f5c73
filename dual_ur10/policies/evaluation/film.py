"""Film of an episode: its poses are kept first and drawn afterwards, so that no arm waits for a picture."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.visuals import cameras as cameras_of
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.ends import early_end
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.envs.rendering.images import Canvas, check_size
from dual_ur10.envs.rendering.marks import ARM_RGB, Marks, describe
from dual_ur10.envs.rendering.video_file import VideoFile
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies.evaluation.rollout import Info, act
from dual_ur10.policies.policy import Policy, as_policy
from dual_ur10.policies.registry import executed
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

Picture = NDArray[np.uint8]

_INK, _PAPER, _DIM, _GOOD, _BAD = (38, 50, 56), (255, 255, 255), (120, 138, 148), (120, 214, 150), (255, 167, 100)
LEAST_PIXELS: Final = 32
"""Smallest width and height of a picture with a caption."""

_HOLD_S: Final = 1.0  # of the last frame, which shows the end
_LABEL_M: Final = np.array([0.0, 0.0, -0.1])  # from a base to the name of its arm, which covers the pedestal


class Take:
    """Poses of a cell and `info` over an episode, from its reset on.

    Args:
        core: Core of an environment of one cell, before its reset; it may move emulated or real arms.

    Attributes:
        model: MuJoCo's model of the scene.
        period_s: Time between two instants.
        stages: Names of the task's stages.
        infos: `info` of each instant.
    """

    def __init__(self, core: Core) -> None:
        import mujoco

        self._core, self.model = core, build_model(core.config.scene)
        core.keeps_start = True
        self.period_s, self.stages = core.timing.period_s, core.task.stages
        self.mounts_m = np.array([core.config.left.position_m, core.config.right.position_m])
        self.cameras = cameras_of(core.config.scene)
        self.infos: list[Info] = []
        self._qpos: list[Array] = []
        self._mocap: list[tuple[Array, Array]] = []
        self._data = mujoco.MjData(self.model)

    def __call__(self, info: Info) -> None:
        """Keep the state after a step, whose `info` this is; before the first one, also that after the reset."""
        self.infos.append(dict(info))
        self._core.copy_state(0, self.model, self._data)
        self._qpos.append(self._data.qpos.copy())
        self._mocap.append((self._data.mocap_pos.copy(), self._data.mocap_quat.copy()))

    def begin(self, info: Info) -> None:
        """Keep the state after the reset, whose `info` this is."""
        self({**info, **{name: value[0] for name, value in self._core.initial_info().items()}})

    @property
    def duration_s(self) -> float:
        """Time from the first instant to the last one."""
        return self.period_s * (len(self.infos) - 1)

    @property
    def success(self) -> bool:
        """True if the last step ended the episode with success."""
        return bool(self.infos[-1].get("is_success", False))

    @property
    def over(self) -> bool:
        """True if the last step ended the episode."""
        return "end_reason" in self.infos[-1]

    @property
    def ended_by(self) -> str:
        """Reason of an early end; "" if there was none."""
        return early_end(self.infos[-1])

    def instant(self, time_s: float) -> int:
        """Return the number of the last instant at this time."""
        return min(int(time_s / self.period_s + 1e-6), len(self.infos) - 1)

    def pose(self, time_s: float) -> Any:
        """Return MuJoCo's data at this time, the same object at every call. Between two instants it interpolates."""
        import mujoco

        before = self.instant(time_s)
        after = min(before + 1, len(self.infos) - 1)
        ratio = min(max(time_s / self.period_s - before, 0.0), 1.0)
        data, step = self._data, np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, step, 1.0, self._qpos[before], self._qpos[after])
        data.qpos[:] = self._qpos[before]
        mujoco.mj_integratePos(self.model, data.qpos, step, ratio)
        data.mocap_pos[:], data.mocap_quat[:] = self._mocap[before]
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)
        return data


def take(
    env: Any,
    policy: Policy | Callable[[Any], Any],
    *,
    seed: int | None = None,
    seconds: float = math.inf,
    on_step: Callable[[Info], None] = lambda _: None,
) -> Take:
    """Run one episode and keep its poses. On a cell of two controllers this moves both arms to where it begins.

    Args:
        env: Environment made by `gym.make`, with any `render_mode`.
        policy: Policy, which is reset first; or a plain function of the observation.
        seed: Seed of the environment's reset.
        seconds: Time after which it ends, even if the episode does not.
        on_step: Callback with `info` after every step.

    Raises:
        PolicyError: The policy is neither.
        DualUR10Error: The environment failed.
    """
    policy, kept = as_policy(executed(policy, lambda: env.unwrapped.core.setup)), Take(env.unwrapped.core)
    observation, info = env.reset(seed=seed, options={MOVE_TO_START: True})
    policy.reset()
    kept.begin(info)
    over = False
    while not over and kept.duration_s < seconds - 1e-9:
        action = act(policy, observation, env, env.action_space.dtype)
        observation, _, terminated, truncated, info = env.step(action)
        kept(info)
        on_step(info)
        over = terminated or truncated
    return kept


@dataclass(frozen=True)
class Film:
    """A video.

    Attributes:
        path: The file.
        duration_s: Length of the video.
        size: (width, height) in pixels.
    """

    path: Path
    duration_s: float
    size: tuple[int, int]


def film(
    path: str | Path,
    shown: Take,
    *,
    title: str = "",
    cameras: Sequence[str] = ("front",),
    width: int = 640,
    height: int = 480,
    speed: float = 1.0,
    zoom: float = 1.0,
    shadows: bool = False,
    marks: bool = True,
    on_ratio: Callable[[float], None] = lambda _: None,
) -> Film:
    """Draw an episode, and write the video: MP4 or GIF by the suffix.

    Args:
        path: The file.
        shown: The episode.
        title: Beginning of the line at the foot of each frame.
        cameras: Names of cameras, side by side; four in two rows.
        width: Width of each camera's picture in pixels.
        height: Its height.
        speed: Seconds of the episode in a second of the video.
        zoom: Factor by which the middle of each picture is enlarged.
        shadows: Draw shadows.
        marks: Draw references, traces and the names of both arms.
        on_ratio: Called with the ratio of frames drawn.

    Raises:
        UnknownNameError: The scene has no such camera.
        SettingsError: Another value is not possible.
        RenderError: No OpenGL backend was found; there is no new file then.
        DualUR10Error: The file cannot be written.
    """
    check_view(cameras, shown.cameras, width=width, height=height, zoom=zoom, speed=speed)
    studio = _Studio(shown, cameras, (width, height), zoom, shadows, marks)
    pace = "" if math.isclose(speed, 1.0) else f", {speed:g}x real time"

    def frame_at(time_s: float) -> Picture:
        return studio.captioned(studio.picture(time_s), time_s, title, pace)

    with contextlib.closing(studio), VideoFile(path) as file:
        count = math.floor(shown.duration_s / speed * file.fps + 1e-6) + 1
        for number in range(count):
            file.append(frame_at(number * speed / file.fps))
            on_ratio((number + 1) / count)
        frame = frame_at(shown.duration_s)
        for _ in range(round(_HOLD_S * file.fps)):
            file.append(frame)
    return Film(Path(path), file.frames / file.fps, (frame.shape[1], frame.shape[0]))


def stills(
    shown: Take,
    times_s: Sequence[float],
    *,
    cameras: Sequence[str] = ("front",),
    width: int = 640,
    height: int = 480,
    zoom: float = 1.0,
    shadows: bool = False,
    marks: bool = True,
) -> list[Picture]:
    """Draw pictures of an episode at some times, without the line at the foot; see `film`."""
    check_view(cameras, shown.cameras, width=width, height=height, zoom=zoom)
    with contextlib.closing(_Studio(shown, cameras, (width, height), zoom, shadows, marks)) as studio:
        return [np.asarray(studio.picture(time_s)) for time_s in times_s]


def check_view(
    cameras: Sequence[str],
    known: Sequence[str],
    *,
    width: int = 640,
    height: int = 480,
    zoom: float = 1.0,
    speed: float = 1.0,
) -> None:
    """Check the arguments of `film` before the episode is run.

    Args:
        cameras: Names of cameras.
        known: Names of the cameras of the scene.
        width: Width of each camera's picture in pixels.
        height: Its height.
        zoom: Factor by which the middle of each picture is enlarged.
        speed: Seconds of the episode in a second of the video.

    Raises:
        UnknownNameError: The scene has no such camera.
        SettingsError: Another value is not possible.
    """
    for camera in cameras:
        if camera not in known:
            raise UnknownNameError("camera", camera, list(known))
    if not 1 <= len(cameras) <= 9:
        raise SettingsError(f"{len(cameras)} cameras: name 1 to 9")
    check_size(width, height)
    if min(width, height) < LEAST_PIXELS:
        raise SettingsError(f"pictures of {width} × {height} pixels: the caption needs {LEAST_PIXELS} each way or more")
    if not 1.0 <= zoom <= 10.0:
        raise SettingsError(f"zoom is {zoom:g}: it must be 1 to 10")
    if not 0.01 <= speed <= 100.0:
        raise SettingsError(f"speed is {speed:g}: it must be 0.01 to 100 seconds of the episode in one of the video")


class _Studio:
    """Canvas and texts of a film."""

    def __init__(
        self,
        shown: Take,
        cameras: Sequence[str],
        size: tuple[int, int],
        zoom: float,
        shadows: bool,
        marks: bool,
    ) -> None:
        self._take, self._cameras, self._size = shown, cameras, size
        self._marks = Marks(shown.infos, shown.period_s) if marks else None
        self._canvas = Canvas(shown.model, *size, shadows=shadows)
        self._fovy = shown.model.cam_fovy.copy()
        shown.model.cam_fovy[:] = 2.0 * np.degrees(np.arctan(np.tan(np.radians(self._fovy) / 2.0) / zoom))
        count = len(cameras)
        self._columns = 2 if count == 4 else min(count, 3)
        self._text = max(9, round(size[1] / 26))  # height in pixels

    def picture(self, time_s: float) -> Any:
        """Return an image of one time, with its marks."""
        from PIL import Image, ImageDraw

        data, (width, height) = self._take.pose(time_s), self._size
        rows = -(-len(self._cameras) // self._columns)
        whole: Picture = np.zeros((rows * height, self._columns * width, 3), np.uint8)
        mark = None if self._marks is None else self._marks.at(time_s)
        corners = [(number // self._columns, number % self._columns) for number in range(len(self._cameras))]
        for (row, column), camera in zip(corners, self._cameras, strict=True):
            tile = whole[row * height : (row + 1) * height, column * width : (column + 1) * width]
            tile[...] = self._canvas.image(data, camera, mark=mark)
        picture = Image.fromarray(whole)
        draw, size = ImageDraw.Draw(picture), self._text
        for (row, column), camera in zip(corners, self._cameras, strict=True):
            at = column * width, row * height
            if mark is not None and "/" not in camera:
                self._name_arms(draw, data, camera, at, size)
            if len(self._cameras) > 1:
                draw.text((at[0] + size, at[1] + size), camera, fill=_PAPER, font=_font(size), anchor="lm")
        return picture

    def _name_arms(self, draw: Any, data: Any, camera: str, at: tuple[int, int], size: int) -> None:
        """Write L and R on both pedestals, where the camera sees them."""
        width, height = self._size
        eye, model = data.camera(camera), self._take.model
        focal = 0.5 * height / math.tan(0.5 * math.radians(float(model.camera(camera).fovy[0])))
        for mount, name, rgb in zip(self._take.mounts_m, ARMS, ARM_RGB, strict=True):
            x, y, z = eye.xmat.reshape(3, 3).T @ (mount + _LABEL_M - eye.xpos)
            if z > -0.1:
                continue
            px, py = at[0] + width / 2 - focal * x / z, at[1] + height / 2 + focal * y / z
            radius = 0.8 * size
            if not (radius < px - at[0] < width - radius and radius < py - at[1] < height - radius):
                continue
            draw.ellipse((px - radius, py - radius, px + radius, py + radius), fill=rgb, outline=_PAPER)
            draw.text((px, py), name[0].upper(), fill=_PAPER, font=_font(size), anchor="mm")

    def captioned(self, picture: Any, time_s: float, title: str, pace: str) -> Picture:
        """Return an image with a line at its foot: title, stage and time; above it a bar of the stages passed."""
        from PIL import ImageDraw

        shown, instant = self._take, self._take.instant(time_s)
        info, last = shown.infos[instant], instant == len(shown.infos) - 1
        draw, size, (width, height) = ImageDraw.Draw(picture), self._text, picture.size
        text, rgb = describe(shown.stages, info), _PAPER
        if last and shown.over:
            text, rgb = ("success", _GOOD) if shown.success else (shown.ended_by or "no success", _BAD)
        clock, tall, gap = f"{time_s:.1f} s{pace}", 2 * size, size // 2 + 4
        draw.rectangle((0, height - tall, width, height), fill=_INK)
        count = len(shown.stages)
        for number in range(count if "stage" in info else 0):
            passed = number < int(info["stage"])
            left = width * number / count
            right = max(left, left + width / count - 2)  # of many stages one is narrow
            top = height - tall - max(3, size // 4)
            draw.rectangle((left, top, right, height - tall - 1), fill=_GOOD if passed else _DIM)
        font, parts = _font(size), [each for each in (title, text, clock) if each]
        while size > 7 and sum(font.getlength(each) for each in parts) + gap * (len(parts) + 1) > width:
            size -= 1
            font = _font(size)
        middle = height - tall / 2
        draw.text((gap, middle), title, fill=_PAPER, font=font, anchor="lm")
        draw.text((width - gap, middle), clock, fill=_PAPER, font=font, anchor="rm")
        begin, end = gap + font.getlength(title), width - gap - font.getlength(clock)
        draw.text(((begin + end) / 2, middle), text, fill=rgb, font=font, anchor="mm")
        return np.asarray(picture)

    def close(self) -> None:
        self._take.model.cam_fovy[:] = self._fovy
        self._canvas.close()


_FONTS: dict[int, Any] = {}


def _font(size: int) -> Any:
    from PIL import ImageFont

    if size not in _FONTS:
        _FONTS[size] = ImageFont.load_default(size)
    return _FONTS[size]
