"""Requests to an emulated cell: injected faults, and records of what its controllers received."""

from __future__ import annotations

from typing import Any, Final

from ur_core.errors import ClosedError, EmulatorError, LinkError, OperationRefusedError
from ur_core.links.json_link import JsonLink
from ur_core.processes.clock import Clock
from ur_core.types import Closing

_POLL_S: Final = 0.01


class CellRequests(Closing):
    """Emulated cell to which this program is connected.

    Attributes:
        clock: Clock of the program.
    """

    clock: Clock
    _injection: JsonLink | None = None
    _closed = False

    def ask(self, do: str, **values: Any) -> Any:
        """Send one fault-injection request, such as `ask("stop", arm="left", mode=3)`.

        Returns:
            The value of the answer.

        Raises:
            ClosedError: The cell was closed.
            EmulatorError: The request was refused, or there was no answer.
        """
        if self._injection is None or self._closed:
            raise ClosedError("this emulated cell was closed: start another")
        try:
            return self._injection.ask(do, **values)
        except (LinkError, OperationRefusedError) as error:
            raise EmulatorError(str(error)) from error

    def setpoints(self, arm: str, since: int = 0) -> list[Any]:
        """Return the executed servoj targets of a controller from number `since` on, as far as it keeps them.

        Returns:
            For each: tick, target (6), t, lookahead, gain.
        """
        return self._pages("setpoints", "setpoints", arm, since)

    def packages(self, arm: str, since: int = 0) -> list[Any]:
        """Return the received RTDE packages with motion commands from number `since` on, as far as they are kept.

        Returns:
            For each: tick, `ur_rtde`'s number of the command, the first six numbers that belong to it.
        """
        return self._pages("received", "packages", arm, since)

    def _pages(self, do: str, name: str, arm: str, since: int) -> list[Any]:
        found: list[Any] = []
        while True:
            answer = self.ask(do, arm=arm, since=since)
            found += answer[name]
            since = answer["first"] + len(answer[name])
            if since >= answer["count"]:
                return found

    def wait_until(self, arm: str, name: str, value: Any, within_s: float = 10.0) -> None:
        """Wait until a controller reports this value of a variable, by RTDE name.

        Raises:
            EmulatorError: It did not in time.
        """
        end = self.clock.now_s() + within_s
        found = None
        while self.clock.now_s() < end:
            found = self.ask("state", arm=arm, names=[name])[name]
            if found == value:
                return
            self.clock.sleep(_POLL_S)
        raise EmulatorError(f"{name} of the {arm} controller is {found!r} after {within_s:g} s, and not {value!r}")
