"""Attendance at the live page: arms of controllers do not move on after everybody has closed it."""

from __future__ import annotations

from typing import Final

from dual_ur10.envs.rendering.live.arms_view import ArmsView
from dual_ur10.envs.rendering.live.memory import LiveMemory
from ur_core.processes.clock import Clock

UNATTENDED_S: Final = 3.0
"""Time without an open page after which moving arms have a latched stop. A page is reloaded sooner."""

UNATTENDED: Final = (
    f"no live page has been open for {UNATTENDED_S:g} s: nobody could press its button to stop both arms"
)
"""Reason of that stop."""


class Attendance:
    """Watch over the number of open pages, in the process that serves them.

    Args:
        memory: Memory of the page.
        clock: Clock.
        required: A page commands these arms, and nobody has allowed them to move unattended.
    """

    def __init__(self, memory: LiveMemory, clock: Clock, *, required: bool) -> None:
        self._memory, self._clock, self._required = memory, clock, required
        self._open_s = clock.now_s()  # last time at which a page was open

    def poll(self, arms: ArmsView | None) -> None:
        """Latch a stop of both arms if they move, and nobody has had a page open for `UNATTENDED_S`."""
        now_s = self._clock.now_s()
        if self._memory.pages or not self._required:
            self._open_s = now_s
        elif arms is not None and arms.owe_motion and now_s - self._open_s > UNATTENDED_S:
            arms.stop(UNATTENDED)
