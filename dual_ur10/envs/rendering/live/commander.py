"""The one open page that may command, and what it drags."""

from __future__ import annotations

import threading
from typing import Final

import numpy as np

from dual_ur10.envs.rendering.live.memory import Handles, LiveMemory
from ur_core.processes.clock import Clock
from ur_core.types import Array

GRIP_S: Final = 0.4
"""Time for which a press of a gripper's button counts, and holds the clutch of an arm that is not dragged."""


class Commander:
    """Commands of all pages. Only those of one of them count; all others watch, and may stop both arms.

    Args:
        memory: Memory that the commands are written to.
        clock: Clock of the program.
        asks: A page that opens when none is open commands only once it has taken the controls, except for the first.

    Attributes:
        client: Number of the page that commands; None: no page does.
    """

    def __init__(self, memory: LiveMemory, clock: Clock, *, asks: bool = False) -> None:
        self._memory, self._clock, self._asks = memory, clock, asks
        self._lock = threading.Lock()
        self.client: int | None = None
        self._pages: set[int] = set()
        self._had_pages = False
        self._poses: Array = np.zeros((2, 7))
        self._clutch = np.zeros(2, dtype=bool)
        self._gripper: Array = np.full(2, np.nan)
        self._grip_until_s: Array = np.zeros(2)  # 0: no press counts
        self._dragged = np.zeros(2, dtype=bool)

    def enter(self, client: int) -> bool:
        """Let a page enter. Return True if it commands from now on, because no other page was open."""
        with self._lock:
            commands = not self._pages and not (self._asks and self._had_pages)
            self._pages.add(client)
            self._had_pages = True
            self._memory.note_pages(len(self._pages))
            if commands:
                self.client = client
            return commands

    def leave(self, client: int) -> bool:
        """Let a page leave, and release the clutch if it commanded. Return True if it did."""
        with self._lock:
            self._pages.discard(client)
            self._memory.note_pages(len(self._pages))
            if client != self.client:
                return False
            self.client = None
            self._release()
            return True

    def take(self, client: int) -> bool:
        """Let a page command if no other one does. Return True if it does."""
        with self._lock:
            if self.client is None and client in self._pages:
                self.client = client
            return self.client == client

    def give_up(self, client: int) -> bool:
        """Let the page that commands watch again. Return True if it did command."""
        with self._lock:
            if client != self.client:
                return False
            self.client = None
            self._release()
            return True

    def stop(self) -> None:
        """Forward a press of "stop", of any page."""
        with self._lock:
            self._memory.press("stop")

    def press(self, client: int, button: str) -> bool:
        """Forward a press of another button. Return False if it does not count, because another page commands."""
        with self._lock:
            if client != self.client:
                return False
            self._memory.press(button)
            return True

    def drag(self, client: int, arm: int, pose: Array, *, held: bool) -> bool:
        """Forward a handle: its pose, (7,), while it is `held`. Return False if it does not count."""
        with self._lock:
            if client != self.client:
                return False
            self._poses[arm], self._clutch[arm], self._dragged[arm] = pose, held, held
            self._put()
            return True

    def grip(self, client: int, arm: int, opening: float, pose: Array) -> bool:
        """Command a gripper, 0 closed to 1 open, of an arm that stays at its pose, (7,), unless it is dragged."""
        with self._lock:
            if client != self.client:
                return False
            self._gripper[arm], self._grip_until_s[arm] = opening, self._clock.now_s() + GRIP_S
            if not self._dragged[arm]:
                self._poses[arm], self._clutch[arm] = pose, True
            self._put()
            return True

    def poll(self) -> None:
        """Forget presses of grippers' buttons that have counted for long enough, and release what they held."""
        with self._lock:
            over = (self._grip_until_s > 0.0) & (self._clock.now_s() > self._grip_until_s)
            if over.any():
                self._gripper[over], self._grip_until_s[over] = np.nan, 0.0
                self._clutch[over] = self._dragged[over]
                self._put()

    def dragged(self, arm: int) -> bool:
        """Return True while a person drags the handle of an arm."""
        return bool(self._dragged[arm])

    def _release(self) -> None:
        self._clutch[:], self._dragged[:], self._gripper[:], self._grip_until_s[:] = False, False, np.nan, 0.0
        self._put()

    def _put(self) -> None:
        handles = Handles(self._poses, self._clutch, self._gripper, self._clock.now_s())
        self._memory.put_handles(handles)
