"""Stalls of this machine: how a process notices them, and the one text about all that they cause."""

from __future__ import annotations

import math
from typing import Final

SHORT_S: Final = 0.05
"""Shortest interruption that counts as a stall: half of what stops both arms. Every loop here wakes each control
period, and every emulated controller sends in each."""

DRIFT: Final = 1e-3
"""Largest relative deviation of a controller's clock. What comes later than it explains is behind."""

RECENT_S: Final = 0.5
"""Time for which a stall explains what follows: the limits of all watchdogs, and the time to end a program."""


_BUSY: Final = "this machine is too busy to move arms in real time"


def too_busy(found: str) -> str:
    """Return the text about a stall of this machine.

    Args:
        found: Observation that shows it.
    """
    return (
        f"{_BUSY} ({found}): end other programs on it, which `uptime` counts, or allow `rt_priority` in the cell file"
    )


def is_too_busy(text: str) -> bool:
    """Return True for a text, also of another process, about a stall of this machine."""
    return _BUSY in text


class StallWatch:
    """Memory of this machine's last stall, by which a process explains its consequences on an emulated cell.

    An emulated controller runs on this machine, too. If that stalls, controllers fall silent, watchdogs end programs
    and other processes do not respond, in any order. On real controllers the same observations have other causes.

    Args:
        emulated: The controllers are emulated.
    """

    def __init__(self, emulated: bool) -> None:
        self._emulated = emulated
        self._beat_s = math.inf
        self._own_s = -math.inf  # end of the last stall of this process itself
        self._last_s = -math.inf
        self._longest_s = 0.0
        self._quickest: dict[int, tuple[float, float]] = {}  # arrival and offset of each controller's clock

    def beat(self, now_s: float) -> None:
        """Note that this process runs. A long time since the last call is a stall."""
        if now_s - self._beat_s > SHORT_S:
            self._own_s = now_s
        self.note(now_s - self._beat_s, now_s)
        self._beat_s = now_s

    def note(self, silent_s: float, now_s: float) -> None:
        """Note for how long something that runs on this machine has been silent until now."""
        if silent_s > SHORT_S:
            self._longest_s = silent_s if now_s - self._last_s > RECENT_S else max(silent_s, self._longest_s)
            self._last_s = now_s

    def packet(self, arm: int, timestamp_s: float, arrival_s: float) -> None:
        """Note the arrival of a controller's state. Emulated controllers that are behind run their periods later."""
        offset_s = arrival_s - timestamp_s
        before_s, least_s = self._quickest.get(arm, (arrival_s, offset_s))
        least_s = min(offset_s, least_s + DRIFT * (arrival_s - before_s))
        self._quickest[arm] = arrival_s, least_s
        self.note(offset_s - least_s, arrival_s)

    def controller_silent(self, age_s: float, other_s: float, now_s: float) -> str:
        """Return the text about a controller whose time has not advanced for `age_s`.

        One process of this machine emulates both controllers: while this machine is on time, the silence of one alone
        has a cause of its own, as on real controllers.

        Args:
            age_s: Age of its newest state.
            other_s: Age of the newest state of the other controller.
            now_s: Time now.
        """
        found = f"the controller's clock has stalled for {1e3 * age_s:.0f} ms"
        on_time = other_s <= SHORT_S and now_s - self._own_s > RECENT_S
        return too_busy(found) if self._emulated and not on_time else f"{found}; look at its network"

    def process_silent(self, process: str, *, runs: bool, more: str = "") -> str:
        """Return the text about a process that does not respond.

        Args:
            process: Name of it, such as "the supervisor".
            runs: It still exists: nothing but this machine keeps it from responding. On real controllers the network
                may do so. One that has ended is no sign of a busy machine.
            more: Further observation.
        """
        if not runs:
            return f"{process} has ended"
        found = f"{process} no longer responds{more}"
        return too_busy(found) if self._emulated else found

    def explained(self, reason: str, now_s: float) -> str:
        """Return the reason of a stop; on an emulated cell after a stall, the text about that, without other causes."""
        if self._emulated and now_s - self._last_s <= RECENT_S:
            return too_busy(f"{reason.partition(': ')[0]}; it stalled for {1e3 * self._longest_s:.0f} ms")
        return reason
