"""The Gymnasium environment: a batch of one."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.core import DEFAULT_RATE_HZ, PHYSICS_ERROR, Core
from dual_ur10.envs.rendering import RENDER_MODES, Renderer
from dual_ur10.envs.viewer import Viewer
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.adapter import ActionMode

Array = NDArray[np.float64]


class DualArmEnv(gym.Env[Array, Array]):
    """Two UR10s and a task, for one agent that commands both.

    Each task documents its spaces, rewards and episodes: `dual_ur10.envs.sine_tracking.SineTracking`.

    Args:
        task: Name of the task; set by the id.
        render_mode: None, "rgb_array" or "human". Without it, no OpenGL is needed.
        cell: "mujoco" or a `dual_ur10.sim2real.cell.CellConfig`.
        policy_rate_hz: Actions per second. The period must be a whole number of controller ticks (8 ms on a CB3).
        action_mode: "joint_delta", "joint_position" or "tcp_delta"; see `dual_ur10.sim2real.adapter.ServojAdapter`.
        action_latency_ticks: Ticks from an observation to the first target of its action. 0 is an ideal machine;
            a policy meant for real arms should be developed with the latency it will have.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.
        camera, width, height, shadows: How `render` draws; see `dual_ur10.envs.rendering.Renderer`.
        **settings: Keywords of the task.

    `reset` takes no options. `info` of `reset` and `step` holds `q_rad` (2, 6) and `flange_m` (2, 3); that of `step`
    also the task's values, `is_success`, `reward/<term>`, and, when an episode was ended by them, `safety` (a
    `dual_ur10.sim2real.gate.Verdict`) or `physics_error` (a message).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as Gymnasium declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": round(DEFAULT_RATE_HZ),
    }

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        cell: object = "mujoco",
        policy_rate_hz: float = DEFAULT_RATE_HZ,
        action_mode: ActionMode = "joint_delta",
        action_latency_ticks: int = 0,
        compensate_lag: bool = True,
        camera: str = "perspective",
        width: int = 640,
        height: int = 480,
        shadows: bool = False,
        **settings: Any,
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render mode", str(render_mode), [*RENDER_MODES, "None"])
        self.render_mode = render_mode
        self._renderer = Renderer(camera, width, height, shadows)
        self.core = Core(
            task,
            settings,
            cell=cell,
            policy_rate_hz=policy_rate_hz,
            action_mode=action_mode,
            action_latency_ticks=action_latency_ticks,
            compensate_lag=compensate_lag,
        )
        self.action_space: Any = self.core.action_space
        self.observation_space: Any = self.core.observation_space
        # A class attribute in Gymnasium; an environment with another rate gets its own.
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.core.timing.period_s)}

    @property
    def task(self) -> Any:
        """The task object."""
        return self.core.task

    @property
    def viewer(self) -> Viewer:
        """What `render_mode="human"` shows: a window, or a page at `viewer.url` where there is no display."""
        return self._renderer.viewer

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`."""
        if options:
            raise SettingsError(f"reset takes no options, found {sorted(options)}: set keywords at gym.make")
        super().reset(seed=seed)
        observation, info = self.core.reset([self.np_random])
        if self.render_mode == "human":
            self.render()
        return observation[0], {name: value[0] for name, value in info.items()}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control period; see `gymnasium.Env.step`.

        Raises:
            ActionError: The action has the wrong shape or type, or holds NaN or infinity. Nothing has moved.
        """
        step = self.core.step(action)
        info: dict[str, Any] = {name: value[0] for name, value in step.info.items()}
        info["is_success"] = bool(info["is_success"])
        if step.verdicts:
            info["safety"] = step.verdicts[0]
        if step.diverged[0]:
            info["physics_error"] = PHYSICS_ERROR
        if self.render_mode == "human":
            self.render()
        return step.observation[0], float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """An image, (height, width, 3), with "rgb_array"; None with "human", which shows a viewer.

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
        self._renderer.close()
        self.core.close()
