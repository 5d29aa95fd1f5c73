"""Loop of `live --watch`: it shows two controllers and commands nothing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.errors import RenderError
from ur_core.links.arm_status import mode_name, stop_reason
from ur_core.protocol.modes import RobotMode, SafetyMode

if TYPE_CHECKING:
    from dual_ur10.cli.status_view import StatusView

_WATCH_S: Final = 0.04


class WatchSession:
    """Loop that shows two controllers without ever commanding them.

    Args:
        arms: Views of the left and the right arm.
        page: The page.
        words: Lines of the page that stay.
    """

    def __init__(self, arms: Sequence[StatusView], page: LivePage, words: dict[str, str]) -> None:
        self._arms, self._page, self._words = arms, page, words

    def run(self, seconds: float | None) -> None:
        """Run until the time is over, or Ctrl-C.

        Raises:
            RenderError: The page's process has ended.
        """
        begun_s = time.monotonic()
        step = 0
        while seconds is None or time.monotonic() < begun_s + seconds:
            if lost := self._page.lost:
                raise RenderError(f"the live page is gone: {lost}: start the program again")
            self.show(time.monotonic() - begun_s, step)
            step += 1
            time.sleep(_WATCH_S)

    def show(self, time_s: float, step: int) -> None:
        """Show the newest states, if both arms have sent one."""
        words = dict(self._words)
        for arm in self._arms:
            words[f"{arm.name} arm"] = f"LOST: {arm.dead}" if arm.dead else _state(arm)
            words[f"{arm.name} program"] = arm.program_fault or arm.program or "unknown"
        self._page.say(words)
        states = [arm.status for arm in self._arms]
        left, right = states
        if left is None or right is None:
            return
        q, target = (np.array([getattr(each, name) for each in (left, right)]) for name in ("q_rad", "target_q_rad"))
        self._page.show_measured(q, target, {"time_s": time_s, "episode": 0, "step": step})


def _state(arm: StatusView) -> str:
    status = arm.status
    if status is None:
        return "nothing heard yet"
    reason = stop_reason(status, playing=False)
    robot, safety = mode_name(RobotMode, status.robot_mode), mode_name(SafetyMode, status.safety_mode)
    return f"{robot}, safety {safety}, slider {100 * status.slider:.0f} %, {reason or 'could move'}"
