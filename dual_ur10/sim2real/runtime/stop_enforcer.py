"""Ends the programs of arms whose processes do not: one that hangs is ended itself, and the dashboard stops its arm."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
import time
from collections.abc import Sequence
from typing import Final

from dual_ur10.errors import DualUR10Error, LinkError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.links.dashboard_link import DashboardLink
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S

log = logging.getLogger(__name__)

STOPPED_S: Final = 1.0
"""How long an arm's process has until its program has ended: longer than the ramp from the greatest speed, 0.65 s."""

_CONNECT_S: Final = 2.0


class StopEnforcer:
    """Sees that both arms stop.

    Args:
        arms: Memories of both arms' processes.
        hosts: Addresses of both controllers.

    Attributes:
        unended: What is to be told of programs that had not ended although the arm's process had ended them.

    Raises:
        LinkError: A dashboard server cannot be reached.
    """

    def __init__(self, arms: Sequence[ArmMemory], hosts: Sequence[str]) -> None:
        self._arms, self._hosts = arms, hosts
        self._dashboards = [DashboardLink(host, _CONNECT_S, name=name) for name, host in zip(ARMS, hosts, strict=True)]
        self._processes: list[int | None] = [None for _ in arms]
        self._left = set(range(len(arms)))
        self._begun_s = 0.0
        self._asking: list[threading.Thread] = []
        self.unended: list[str] = []

    @property
    def files(self) -> list[int]:
        """Readable when a connection is not as it should be any more: see `check`."""
        return [each.fileno() for each in self._dashboards]

    def check(self) -> None:
        """See that this stop can still be made.

        Raises:
            LinkError: A dashboard server is lost.
        """
        for arm, link in enumerate(self._dashboards):
            link.check()
            pid = self._arms[arm].process
            if self._processes[arm] is None and pid:
                with contextlib.suppress(OSError):  # it has ended, which others see
                    self._processes[arm] = os.pidfd_open(pid)

    def begin(self) -> None:
        """Both arms were told to stop just now."""
        self._begun_s = time.monotonic()

    @property
    def waits(self) -> bool:
        """Whether an arm may still stop by itself."""
        return bool(self._left)

    def look(self, ended: Sequence[bool]) -> float:
        """End what should have stopped by now, and what hangs, as `ur_rtde` may: it must not wake and go on.

        Args:
            ended: Whether each controller says that its program has ended. A program that is only paused, as by a
                protective stop, is ended by the dashboard: it could go on to where it was sent last.

        Returns:
            Time since the beginning, s.
        """
        now = time.monotonic()
        passed = now - self._begun_s
        for arm in sorted(self._left):
            memory = self._arms[arm]
            phase = memory.phase
            hangs = phase < Phase.STOPPING and now - memory.beat_s > STALE_S
            if phase == Phase.STOPPED and (ended[arm] or passed > STOPPED_S):
                self._left.discard(arm)
                if not ended[arm]:
                    self._ask_dashboard(arm)
                    text = f"{ARMS[arm]}: its program had not ended after {STOPPED_S:g} s, so its dashboard was asked"
                    self.unended.append(text)
                    log.error("%s", text)  # last: who reads it may keep it waiting
            elif phase == Phase.STOPPED:
                continue
            elif phase == Phase.FAULTED or hangs or passed > STOPPED_S:
                self._left.discard(arm)
                self._end(arm)
        return passed

    def close(self) -> None:
        """Wait for the dashboards' answers."""
        for thread in self._asking:
            thread.join(2 * _CONNECT_S)

    def _end(self, arm: int) -> None:
        process = self._processes[arm]
        if process is not None:
            with contextlib.suppress(OSError):  # it has ended
                signal.pidfd_send_signal(process, signal.SIGKILL)
        self._arms[arm].enter(
            Phase.FAULTED, f"{ARMS[arm]}: its process did not stop its program by itself, and was ended"
        )
        self._ask_dashboard(arm)

    def _ask_dashboard(self, arm: int) -> None:
        # One that is silent must not keep the other arm's waiting.
        thread = threading.Thread(target=self._ask, args=(arm,), daemon=True)
        thread.start()
        self._asking.append(thread)

    def _ask(self, arm: int) -> None:
        try:
            try:
                self._dashboards[arm].stop()
            except LinkError:
                with DashboardLink(self._hosts[arm], _CONNECT_S, name=ARMS[arm]) as link:
                    link.stop()
        except DualUR10Error as error:
            log.error("%s: the dashboard did not stop its program (%s): its watchdog does", ARMS[arm], error)
