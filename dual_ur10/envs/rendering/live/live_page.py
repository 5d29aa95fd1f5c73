"""Live page seen from the program that moves the arms."""

from __future__ import annotations

import importlib.util
import secrets
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.assets.scene import build_model
from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.guard import PORT
from dual_ur10.envs.rendering.live.memory import Handles, LiveMemory
from dual_ur10.envs.rendering.live.page import main
from dual_ur10.envs.rendering.live.scene import arm_rows
from dual_ur10.errors import MissingExtraError, RenderError, SettingsError
from ur_core.processes.system import LOCAL, Process, System
from ur_core.types import Array

START_S: Final = 30.0
HANGS_S: Final = 10.0
"""Time without a sign of life after which a page that commands controllers is lost. A first picture takes 1 s, and up
to 5 s on a busy machine."""

_END_S: Final = 3.0
_POLL_S: Final = 0.01


class LivePage:
    """Page in a process of its own, which starts at once. Nothing here waits for it but `wait_until_ready`.

    Args:
        about: What the page shows.
        port: Port of the loopback interface; 0: any free one.
        system: Clock and processes.

    Raises:
        MissingExtraError: viser is not installed.

    Attributes:
        url: Address with its token, for a browser on this machine; "": not ready yet.
        memory: Memory shared with the page's process.
    """

    def __init__(self, about: About, *, port: int = PORT, system: System = LOCAL) -> None:
        import mujoco

        if importlib.util.find_spec("viser") is None:
            raise MissingExtraError("viser", "live", "the live page")
        self._clock, self._about = system.clock, about
        self._model = build_model(about.scene, visuals=False)
        self._data = mujoco.MjData(self._model)
        shape = self._model.nq, self._model.nmocap
        self.memory = LiveMemory(*shape)
        self.url = ""
        self._pressed = self._stops = 0
        token = secrets.token_urlsafe(24)
        self._process: Process = system.spawn(
            main, self.memory.name, shape, about, port, token, system.pid, name="live page", output=_forget
        )

    def wait_until_ready(self, within_s: float = START_S) -> str:
        """Wait for the page, and return its address.

        Raises:
            SettingsError: The port is busy or not allowed.
            RenderError: It did not start.
        """
        end_s = self._clock.now_s() + within_s
        while not (answer := self.memory.answer):
            if not self._process.is_alive or self._clock.now_s() > end_s:
                reason = "its process has ended" if not self._process.is_alive else f"not ready in {within_s:g} s"
                self.close()
                raise RenderError(f"the live page did not start: {reason}. Try again, or leave the page out")
            self._clock.sleep(_POLL_S)
        if "error" in answer:
            self.close()
            raise (SettingsError if answer["kind"] == SettingsError.__name__ else RenderError)(answer["error"])
        self.url = answer["url"]
        return self.url

    def wait_until_open(self) -> None:
        """Wait until a browser has opened the page, however long that takes.

        Raises:
            RenderError: The page's process has ended.
        """
        while not self.memory.pages:
            if not self._process.is_alive:
                raise RenderError("the live page has ended before it was opened: start the program again")
            self._clock.sleep(_POLL_S)

    def attach(self, view: Sequence[str]) -> None:
        """Let the page read and stop arms of controllers.

        Args:
            view: Path of an `ArmsView`, and the strings to make it of.
        """
        self.memory.attach(view)

    def show(self, core: Any, q_rad: Array, scalars: Mapping[str, float]) -> None:
        """Write the state after a reset or a step of the first cell of a core.

        Args:
            core: `dual_ur10.envs.core.core.Core`.
            q_rad: (2, 6) measured joint positions.
            scalars: Numbers by names in `dual_ur10.envs.rendering.live.memory.SCALARS`.
        """
        core.copy_state(0, self._model, self._data)
        pipeline, data = core.pipeline, self._data
        found = {
            "at_s": self._clock.now_s(),
            "spare_m": float(pipeline.gate.spare_m[0].min(initial=np.inf)),
            **scalars,
        }
        mocap = np.hstack([data.mocap_pos, data.mocap_quat])
        self.memory.put(found, q_rad, pipeline.adapter.commanded_q_rad[0], data.qpos, mocap)

    def show_measured(self, q_rad: Array, commanded_rad: Array, scalars: Mapping[str, float]) -> None:
        """Write joints, (2, 6) each, of arms that this program only watches; props stay where they begin."""
        data = self._data
        data.qpos[arm_rows(self._model)] = q_rad.reshape(12)
        mocap = np.hstack([data.mocap_pos, data.mocap_quat])
        self.memory.put({"at_s": self._clock.now_s(), **scalars}, q_rad, commanded_rad, data.qpos, mocap)

    def say(self, words: Mapping[str, str]) -> None:
        """Show the state in words, by line."""
        self.memory.say(words)

    def handles(self) -> Handles:
        """Return the handles; see `LiveMemory.handles`."""
        return self.memory.handles(self._clock.now_s())

    def pressed(self) -> list[str]:
        """Return the buttons pressed since the last call."""
        names, self._pressed = self.memory.pressed(self._pressed)
        stops, self._stops = self._stops, self.memory.stops
        return names if stops == self._stops else ["stop", *names]

    @property
    def lost(self) -> str:
        """Reason why nobody can press a button of the page any more; "": somebody can."""
        if not self._process.is_alive:
            return "its process has ended"
        beat_s = self.memory.beat_s
        if beat_s and self._about.attended and self._clock.now_s() - beat_s > HANGS_S:
            return f"its process has shown no sign of life for {HANGS_S:g} s"
        return ""

    @property
    def pid(self) -> int:
        """Number of the page's process."""
        return self._process.pid

    def close(self) -> None:
        """End the page. May be called twice."""
        self.memory.end()
        if not self._process.wait(_END_S):
            self._process.kill()
        self.memory.close()


def _forget(line: str) -> None:
    """Drop what viser prints: the address that counts is the one with the token."""
