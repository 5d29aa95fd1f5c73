"""Observations of n cells: numbers, images, or both."""

from __future__ import annotations

import math
import numbers
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.visuals import cameras
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.rendering.images import Canvas, Renderer
from dual_ur10.errors import RateError, UnknownNameError
from dual_ur10.sim2real.cell.cell import SeenImages
from ur_core.types import Array, Rows

Images = dict[str, NDArray[np.uint8]]


class _Painter:
    """Model, data and canvas with which one thread draws observed images."""

    def __init__(self, core: Core) -> None:
        import mujoco

        from dual_ur10.envs.rendering.look import Look  # an environment of numbers needs none

        options, self._core = core.options, core
        self._model = build_model(core.config.scene)
        self._data = mujoco.MjData(self._model)
        self._look = Look(self._model, core.setup.randomization) if core.setup.randomization.visual else None
        self.canvas = Canvas(self._model, options.width, options.height, shadows=options.shadows)
        self.canvas.release()

    def paint(self, rows: Rows, images: Images) -> None:
        """Draw the images of some cells, for each camera."""
        import mujoco

        try:
            for row in rows.tolist():
                self._core.copy_state(row, self._model, self._data)
                if self._look is not None:
                    self._look.apply(float(self._core.visual_seed[row]))
                mujoco.mj_kinematics(self._model, self._data)
                mujoco.mj_camlight(self._model, self._data)
                for camera, image in images.items():
                    self.canvas.image(self._data, camera, image[row])
        finally:
            self.canvas.release()


class Observer:
    """Observer of n cells, by the options `observation`, `cameras` and `pixels_rate_hz` of their core.

    Images are drawn with the first observation, never before; with "state" they never are. Those of a cell of
    controllers with cameras are the newest that its cameras took.

    Attributes:
        renderer: Renderer of the images and views of `render`.
        space: Observation space of one cell.

    Args:
        core: Task, pipeline and cell.

    Raises:
        UnknownNameError: The scene has no such camera.
        RateError: `pixels_rate_hz` is not the policy's rate divided by a whole number.
        SettingsError: A size is not possible.
    """

    def __init__(self, core: Core) -> None:
        options, known = core.options, cameras(core.config.scene)
        for camera in options.camera_names:
            if camera not in known:
                raise UnknownNameError("camera", camera, list(known))
        self.core = core
        self.renderer = Renderer(options.render_camera, options.width, options.height, options.shadows, cameras=known)
        self._every = _periods(1 / core.timing.period_s, options.pixels_rate_hz)
        self._kind = options.observation if options.pictured else "state"
        self._age = np.zeros(core.n, dtype=np.int64)  # periods since the episode began
        self._images: Images = {}
        self._painters: list[_Painter] = []
        self._pool: ThreadPoolExecutor | None = None  # one thread for each painter, if there are several
        self._taken: SeenImages | None = getattr(core.cell, "images", None) if options.pictured else None
        self._exposed_s: dict[str, float] = {}
        self.space: spaces.Space[Any] = core.observation_space
        if self._kind != "state":
            shape = (options.height, options.width, 3)
            pixels: dict[str, spaces.Space[Any]] = {
                camera: spaces.Box(0, 255, shape, np.uint8) for camera in options.camera_names
            }
            nested = {"state": core.observation_space, "pixels": spaces.Dict(pixels)}
            self.space = spaces.Dict(nested if self._kind == "both" else self._flat(core.observation_space, pixels))

    def begin(self, state: Array, rows: Rows) -> Any:
        """Return the observation after a reset of `rows`, which get new images; the others keep theirs.

        Args:
            state: (n, size) numbers of the core.
            rows: Cells that were reset.

        Returns:
            `state` itself; a dict of images, (n, height, width, 3), by camera, with "flat" also of `state`; or
            `{"state": state, "pixels": images}`. Images are copies.

        Raises:
            RenderError: Images are observed, and no OpenGL backend was found.
        """
        self._age[rows] = 0
        return self._observe(state, rows)

    def advance(self, state: Array, rows: Rows | None = None) -> Any:
        """Return the observation after a policy period of `rows`, which get new images where they are due.

        Args:
            state: (n, size) numbers of the core.
            rows: Cells that were stepped; None: all.

        Returns:
            As `begin`.

        Raises:
            RenderError: Images are observed, and no OpenGL backend was found.
        """
        if self._kind == "state":
            return state
        rows = np.arange(self.core.n) if rows is None else rows
        self._age[rows] += 1
        return self._observe(state, rows[self._age[rows] % self._every == 0])

    def _observe(self, state: Array, rows: Rows) -> Any:
        if self._kind == "state":
            return state
        self._draw(rows)
        images = {camera: image.copy() for camera, image in self._images.items()}
        return {"state": state, "pixels": images} if self._kind == "both" else self._flat(state, images)

    def _flat(self, state: Any, images: dict[str, Any]) -> dict[str, Any]:
        return {"state": state, **images} if self._kind == "flat" else images

    @property
    def ages(self) -> dict[str, Array]:
        """Ages of the observed images, (1,) s by `image_age_s/<camera>`; empty unless cameras of a cell took them."""
        if self._taken is None:
            return {}
        now_s = self._taken.looked_s
        return {f"image_age_s/{name}": np.array([now_s - at_s]) for name, at_s in self._exposed_s.items()}

    def _draw(self, rows: Rows) -> None:
        if self._taken is not None:
            if len(rows):
                for camera, (image, exposed_s) in self._taken.seen.items():
                    self._images[camera], self._exposed_s[camera] = image[None], exposed_s
            return
        if not self._painters:
            self._begin_painting()
        if self._pool is None:
            self._painters[0].paint(rows, self._images)
            return
        parts = np.array_split(rows, len(self._painters))
        for _ in self._pool.map(lambda painter, part: painter.paint(part, self._images), self._painters, parts):
            pass  # an exception in a thread is raised here

    def _begin_painting(self) -> None:
        options, core = self.core.options, self.core
        self._painters = [_Painter(core)]
        if core.threads > 1 and self._painters[0].canvas.parallel:
            self._painters += [_Painter(core) for _ in range(1, core.threads)]
            self._pool = ThreadPoolExecutor(core.threads, "painter")
        shape = (core.n, options.height, options.width, 3)
        self._images = self._images or {camera: np.zeros(shape, dtype=np.uint8) for camera in options.camera_names}

    def close(self) -> None:
        """Release renderer, painters and viewer. May be called twice."""
        if self._pool is not None:
            self._pool.shutdown()
        for painter in self._painters:
            painter.canvas.close()
        self._pool, self._painters = None, []
        self.renderer.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_painters": [], "_pool": None}


def row_of(observation: Any, row: int) -> Any:
    """Return one cell's part of an observation or info of n cells, as views of its arrays."""
    if isinstance(observation, dict):
        return {name: row_of(value, row) for name, value in observation.items()}
    return observation[row]


def _periods(policy_rate_hz: float, pixels_rate_hz: object) -> int:
    """Return the number of policy periods from one image to the next.

    Raises:
        RateError: It is not whole; the message names the nearest legal rates.
    """
    if pixels_rate_hz is None:
        return 1
    rate = float(pixels_rate_hz) if isinstance(pixels_rate_hz, numbers.Real) else math.nan
    if not 0 < rate <= policy_rate_hz * (1 + 1e-6):
        raise RateError(
            f"pixels_rate_hz is {pixels_rate_hz!r}: it must be a number above 0, the policy's {policy_rate_hz:g} Hz at "
            "most, or None"
        )
    periods = policy_rate_hz / rate
    whole = round(periods)
    if abs(periods - whole) > 1e-6 * periods:
        below, above = math.floor(periods), math.ceil(periods)
        raise RateError(
            f"pixels_rate_hz is {rate:g}: it must be the policy's {policy_rate_hz:g} Hz divided by a whole number, "
            f"found {periods:.4g}. The neighbours are {policy_rate_hz / above:.6g} Hz (every {above} observations) and "
            f"{policy_rate_hz / below:.6g} Hz (every {below})"
        )
    return whole
