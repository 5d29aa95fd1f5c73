"""The Gymnasium environment: a batch of one."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from dual_ur10.envs.core.core import Core, Step
from dual_ur10.envs.core.options import DEFAULT_RATE_HZ, MOVE_TO_START, take_consent
from dual_ur10.envs.rendering.images import RENDER_MODES
from dual_ur10.envs.rendering.pixels import Observer, row_of
from dual_ur10.errors import ResetNeededError, SettingsError, UnknownNameError
from ur_core.types import Array
from ur_core.viewing.viewer import Viewer

_ROW = np.zeros(1, dtype=np.intp)  # the only row


class DualArmEnv(gym.Env[Any, Array]):
    """Two UR10s and a task, for one agent that commands both.

    Each task documents its spaces, rewards and episodes: `dual_ur10.envs.tasks.sine_tracking.task.SineTracking`.

    Args:
        task: Id of the environment, or a shorter name; `gym.make` sets it.
        render_mode: None, "rgb_array" or "human". Without it, and with `observation="state"`, no OpenGL is needed.
        **keywords: Keywords of every environment, `dual_ur10.envs.core.options.EnvOptions`, and of the task.

    Observations: with `observation="state"` (the default) the numbers of the task, (size,); with "goals" the few that
    lead to its goals, scaled to float32 between -1 and 1; with "pixels" a dict of images, (height, width, 3) uint8, by
    the names in `cameras`; with "both" `{"state": ..., "pixels": {...}}`; with "flat" the dict of images and `state`.
    `observation_dtype` is the type of the numbers.

    `reset` takes one option, `move_to_start`. On a cell of two controllers a reset moves both arms to where the episode
    begins. The first one needs the confirmation of an operator on real arms (`confirm`, or a question at the terminal);
    every later one needs `options={"move_to_start": True}` as well, unless `confirm` is given. A wrapper that resets by
    itself passes no options and is refused with `ResetRefusedError`. In simulation the option has no effect.

    `info` of `reset` and `step` holds `q_rad` (2, 6) and `flange_m` (2, 3), in a dry run (`cell="echo"`)
    `state_is_commanded`, true, since nothing is measured there, and where cameras of two controllers are observed
    `image_age_s/<camera>`, the time since the exposure; that of `step` also the task's values,
    `is_success` and `reward/<term>`. That of the last step holds `end_reason`: "success", "time", "refused/<limit>",
    such as "refused/distance", if the safety gate kept a limit, "physics", or a reason of the task, such as
    "bar_lost". A wrapper that truncates, such as `TimeLimit`, adds none. `safety` (a
    `dual_ur10.sim2real.control.gate.Verdict`) and `physics_error` (a message) hold the details of a refusal and of
    diverged physics.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": round(DEFAULT_RATE_HZ),
    }

    def __init__(self, task: str, *, render_mode: str | None = None, **keywords: Any) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render mode", str(render_mode), [*RENDER_MODES, "None"])
        self.render_mode = render_mode
        self.core = Core(task, keywords)
        try:
            self._observer = Observer(self.core)
        except BaseException:
            self.core.close()
            raise
        self._terminated = False
        self._spec: EnvSpec | None = None
        self._renderer = self._observer.renderer
        self.action_space: Any = self.core.action_space
        self.observation_space: Any = self._observer.space
        # A class attribute in Gymnasium; an environment with another rate gets its own.
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.core.timing.period_s)}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.core})"

    @property
    def spec(self) -> EnvSpec | None:
        """Spec as of `gym.make`. Its `max_episode_steps` is the horizon of the task with these settings."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec if spec is None else dataclasses.replace(spec, max_episode_steps=self.task.horizon)

    @property
    def task(self) -> Any:
        """Task object."""
        return self.core.task

    @property
    def viewer(self) -> Viewer:
        """Viewer of `render_mode="human"`: a window, or a page at `viewer.url` where there is no display."""
        return self._renderer.viewer

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`.

        Raises:
            SettingsError: There are other options than `move_to_start`.
            ResetRefusedError: On two controllers, a later reset was called without consent. Nothing has moved.
            RenderError: Images are observed, and no OpenGL backend was found.
        """
        others = dict(options or {})
        consent = take_consent(others)
        if others:
            raise SettingsError(
                f"reset takes the option {MOVE_TO_START!r} alone, found {sorted(others)}: set keywords at gym.make"
            )
        super().reset(seed=seed)
        state, info = self.core.reset([self.np_random], seed=seed, move_to_start=consent)
        self._terminated = False
        observation = self._observer.begin(state, _ROW)
        if self.render_mode == "human":
            self.render()
        return row_of(observation, 0), row_of({**info, **self._observer.ages}, 0)

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one policy period; see `gymnasium.Env.step`.

        Raises:
            ActionError: The action has the wrong shape or type, or holds NaN or infinity. Nothing has moved.
            ResetNeededError: There was no reset yet, or the episode was terminated.
        """
        step = self.advance(action)
        observation = row_of(self._observer.advance(step.observation), 0)
        info = {**info_of(step), **row_of(self._observer.ages, 0)}
        return observation, float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), info

    def advance(self, action: object) -> Step:
        """Advance one policy period as `step` does, and return the core's result, which has no images."""
        if self._terminated:
            raise ResetNeededError("step was called after `terminated`: the episode is over, call reset()")
        step = self.core.step(action)
        self._terminated = bool(step.terminated[0])
        if self.render_mode == "human":
            self.render()
        return step

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image, (height, width, 3), with "rgb_array"; show the viewer with "human" and return None.

        Raises:
            RenderError: No OpenGL backend was found, or for "human" neither a display nor MuJoCo's web viewer.
        """
        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: pass render_mode='rgb_array' or 'human' to gym.make")
            return None
        model, data = self.core.cell_data(0)
        return self._renderer.draw(self.render_mode, model, data)

    def close(self) -> None:
        """Release simulation and viewer. May be called twice."""
        self._observer.close()
        self.core.close()


def numbers_of(numbers: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the numbers in the info of one cell's step, which every step has."""
    info: dict[str, Any] = {name: value[0] for name, value in numbers.items()}
    info["is_success"] = bool(info["is_success"])
    return info


def info_of(step: Step) -> dict[str, Any]:
    """Return the info of one cell's step."""
    info = numbers_of(step.info)
    if step.verdicts or step.ends or step.led_by:
        info.update(step.details(0))
    return info
