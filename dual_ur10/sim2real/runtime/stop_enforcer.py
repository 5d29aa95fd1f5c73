"""Backup stop: kill an arm's process that does not end its program, and have the dashboard stop that program."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Final

from dual_ur10.errors import DualUR10Error, LinkError
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import STALE_S
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.dashboard_link import DashboardLink
from ur_core.processes.system import LOCAL, System, Thread

log = logging.getLogger(__name__)

STOPPED_S: Final = 1.0
"""Time for an arm's process to end its program: longer than the ramp from the largest speed, 0.65 s."""

_CONNECT_S: Final = 2.0


class StopEnforcer:
    """Enforces the stop of both arms.

    Args:
        arms: Memories of both arms' processes.
        hosts: Addresses of both controllers.
        system: Clock, network and processes.

    Attributes:
        unended: Reports of programs that had not ended although the arm's process had ended them.

    Raises:
        LinkError: A dashboard server cannot be reached.
    """

    def __init__(self, arms: Sequence[ArmMemory], hosts: Sequence[str], *, system: System = LOCAL) -> None:
        self._arms, self._hosts, self._system = arms, hosts, system
        self._dashboards = [self._connect(arm) for arm in range(len(arms))]
        self._killers: list[Callable[[], None] | None] = [None for _ in arms]
        self._pending = set(range(len(arms)))
        self._asked: set[int] = set()
        self._begun_s = 0.0
        self._requests: list[Thread] = []
        self.unended: list[str] = []

    def _connect(self, arm: int) -> DashboardLink:
        return DashboardLink(self._hosts[arm], _CONNECT_S, name=ARMS[arm], system=self._system)

    @property
    def files(self) -> list[int]:
        """File numbers of connections that become readable when they fail: see `check`."""
        return [each.fileno() for each in self._dashboards]

    def check(self) -> None:
        """Check that the backup stop is available.

        Raises:
            LinkError: A dashboard server is lost.
        """
        for arm, link in enumerate(self._dashboards):
            link.check()
            if self._killers[arm] is None and (pid := self._arms[arm].process):
                self._killers[arm] = self._system.killer(pid)

    def is_lost(self, arm: int) -> bool:
        """Return True if the dashboard of an arm is lost."""
        try:
            self._dashboards[arm].check()
        except LinkError:
            return True
        return False

    def begin(self) -> None:
        """Start the timeouts: both arms have just been told to stop."""
        self._begun_s = self._system.clock.now_s()

    @property
    def waits(self) -> bool:
        """True while an arm may still stop by itself."""
        return bool(self._pending)

    def poll(self, ended: Sequence[bool]) -> None:
        """Enforce the stop of arms that are overdue or whose process hangs, as `ur_rtde` may: it must not continue.

        Args:
            ended: Flags of both programs that have ended. A paused program, as after a protective stop, is ended by the
                dashboard: it could continue to its last target.
        """
        now = self._system.clock.now_s()
        passed = now - self._begun_s
        for arm in sorted(self._pending):
            memory = self._arms[arm]
            phase = memory.phase
            hangs = phase < Phase.STOPPING and now - memory.beat_s > STALE_S
            if memory.deaf and arm not in self._asked:
                self._request_stop(arm)  # at once: its process cannot stop it
            if phase == Phase.STOPPED and (ended[arm] or passed > STOPPED_S):
                self._pending.discard(arm)
                if not ended[arm]:
                    self._request_stop(arm)
                    text = f"{ARMS[arm]}: its program had not ended after {STOPPED_S:g} s, so its dashboard was asked"
                    self.unended.append(text)
                    log.error("%s", text)  # last: a slow reader may block it
            elif phase == Phase.STOPPED:
                continue
            elif phase == Phase.FAULTED or hangs or passed > STOPPED_S:
                self._pending.discard(arm)
                self._end(arm)

    def close(self) -> None:
        """Wait for the dashboards' answers."""
        for thread in self._requests:
            thread.join(2 * _CONNECT_S)

    def _end(self, arm: int) -> None:
        kill = self._killers[arm]
        if kill is not None:
            kill()
        self._arms[arm].enter(Phase.FAULTED, f"{ARMS[arm]}: its process did not stop its program and was killed")
        self._request_stop(arm)

    def _request_stop(self, arm: int) -> None:
        self._asked.add(arm)
        # A silent dashboard must not delay that of the other arm.
        self._requests.append(self._system.thread(lambda: self._send_stop(arm), f"{ARMS[arm]} stop"))

    def _send_stop(self, arm: int) -> None:
        try:
            try:
                self._dashboards[arm].stop()
            except LinkError:
                with self._connect(arm) as link:
                    link.stop()
        except DualUR10Error as error:
            log.error("%s: the dashboard did not stop its program (%s): its watchdog does", ARMS[arm], error)
