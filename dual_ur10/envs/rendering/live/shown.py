"""Environment whose resets and steps a live page shows."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.envs.rendering.live.memory import COMMANDERS
from dual_ur10.envs.rendering.marks import describe
from ur_core.kinematics.ur10 import ARMS


class Shown(gym.Wrapper[Any, Any, Any, Any]):
    """Wrapper that writes the state after each reset and step for a page. It changes nothing else.

    Args:
        env: Environment of one cell.
        page: The page.
        other: Who leads an arm that no person commands, of `COMMANDERS`.

    Attributes:
        words: Lines of the page that the program adds.
        stopped: Reason why simulated arms rest; "": they do not. The page reads the latch of controllers itself.
        state: Addition to the line of the episode, such as "paused".
        waiting: What the program waits for, such as "press Record to begin an episode"; a reset forgets it.
        late_s: Delay of the next step that the program knows of; NaN: unknown.
        episode: Number of the running episode, from 0; -1: none has begun.
        steps: Steps taken in it.
    """

    def __init__(self, env: Any, page: LivePage, other: str = "policy") -> None:
        super().__init__(env)
        self._page, self._core, self._other = page, env.unwrapped.core, other
        config = self._core.config
        self.words = {
            "task": self._core.setup.env_id,
            "arms": f"{config.kind} cell, commanded" if config.controllers else "simulation",
        }
        if view := getattr(self._core.cell, "live_view", None):
            page.attach(view)
        self.stopped = self.state = self.waiting = ""
        self.late_s = np.nan
        self.episode, self.steps = -1, 0
        self._return = 0.0
        self._gate = ""
        self._info: dict[str, Any] = {}
        self._seed: int | None = None
        self._is_over, self._ended, self._succeeded = False, 0, 0

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`."""
        observation, info = self.env.reset(**arguments)
        self.episode, self.steps, self._return = self.episode + 1, 0, 0.0
        self._gate = "releases all" if self._core.config.controllers else ""
        self._info, self._seed = info, arguments.get("seed")
        self._is_over, self.waiting = False, ""
        self._show({})
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one policy period; see `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps, self._return, self._info = self.steps + 1, self._return + float(reward), info
        if "safety" in info:
            self._gate = f"REFUSED at step {self.steps}: {info['safety']}"
        if (terminated or truncated) and not self._is_over:  # who leads in a simulation may go on
            self._is_over = True
            self._ended, self._succeeded = self._ended + 1, self._succeeded + bool(info["is_success"])
        self._show({"gated": "safety" in info, "reward": float(reward), "success": bool(info["is_success"])})
        return observation, reward, terminated, truncated, info

    def _show(self, scalars: dict[str, float]) -> None:
        """Write the record of a reset or a step."""
        left, right = map(COMMANDERS.index, self._leaders)
        found = {
            "gated": False,
            "reward": 0.0,
            "success": False,
            **scalars,
            "time_s": self.steps * self._core.timing.period_s,
            "episode": self.episode,
            "step": self.steps,
            "late_s": self.late_s,
            "left_commander": left,
            "right_commander": right,
        }
        self._page.show(self._core, self._info["q_rad"], found)
        self.say()

    @property
    def _leaders(self) -> list[str]:
        return ["operator" if person else self._other for person in self._core.commander.tolist()]

    def say(self) -> None:
        """Write the state in words."""
        info = self._info
        seed = "" if self._seed is None else f", seed {self._seed}"
        state = f", {self.state}" if self.state else ""
        found = {"next": self.waiting, **self.words} if self.waiting else dict(self.words)
        if self.episode < 0:
            self._page.say(found)
            return
        found["episode"] = f"{self.episode}, step {self.steps}{seed}{state}"
        if stage := describe(self._core.task.stages, info):
            found["progress"] = stage
        terms = [f"{name.partition('/')[2]} {value:.2f}" for name, value in info.items() if name.startswith("reward/")]
        found["reward"] = f"return {self._return:.2f}{': ' if terms else ''}{', '.join(terms)}".replace("_", " ")
        success = "yes" if info.get("is_success", False) else "not yet"
        found["success"] = f"{success}; {self._succeeded} of {self._ended} episodes"
        for arm, who in zip(ARMS, self._leaders, strict=True):
            found[f"{arm} arm"] = f"led by {'the ' * (who != 'nobody')}{who}"
        led = "leads along what is in the way" if info.get("led", False) else ""
        if gate := ", ".join(filter(None, (self._gate, led))):
            found["gate"] = gate
        if self.stopped:
            found["stop"] = self.stopped
        self._page.say(found)
